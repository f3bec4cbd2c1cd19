"""What do import wan and a dry run take at the full size of a Wan preset?

    python experiments/wan_import.py --preset wan-1.3b --out experiments/results
    python experiments/wan_import.py --preset wan-14b --layers 8 --shards 3 --out out/wan

The files have the names, shapes and number formats of the published ones (VideoX-Fun's layout) and
no content: they are sparse, and take no space until they are read. The checkpoint that is made of
them is real, full of zeros, and is deleted again: 18 GB for `wan-1.3b`. Of `wan-14b` a few layers
are enough: one shard is in memory at a time, however many there are; umT5 and CLIP have two layers
then. Memory: the most that the command's process held (VmHWM), of it without mapped files (peak of
RssAnon, seen every 20 ms), since what safetensors maps can be dropped at any time.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
import json
from math import prod
from pathlib import Path
import shlex
import subprocess
import sys
import tempfile
import time

from page import parse_arguments, publish, ROOT, table
import torch
import yaml

sys.path.insert(0, str(ROOT))
from diffusers import AutoencoderKLWan

from mtv_world_ros.training.training_config import load_training_config
from test.support.wan_files import (
    clip_shapes,
    clip_text_shapes,
    Shapes,
    umt5_shapes,
    vae_original_name,
    write_tokenizer,
)
from test.support.wan_reference import video_tensors

_BYTES = {'BF16': 2, 'F16': 2, 'F32': 4}
_GIB = 2**30
_WATCH_S = 0.02


def write_sparse(file: Path, shapes: Shapes, dtype: str) -> None:
    """Write a safetensors file of zeros whose content takes no space on the disk."""
    header, end = {}, 0
    for name, shape in shapes.items():
        begin, end = end, end + prod(shape) * _BYTES[dtype]
        header[name] = {'dtype': dtype, 'shape': list(shape), 'data_offsets': [begin, end]}
    text = json.dumps(header).encode()
    text += b' ' * (-len(text) % 8)
    with file.open('wb') as stream:
        stream.write(len(text).to_bytes(8, 'little') + text)
        stream.truncate(8 + len(text) + end)


def write_transformer(folder: Path, shapes: Shapes, num_shards: int) -> None:
    """Write one file, or shards and their index."""
    stem, names = 'diffusion_pytorch_model', list(shapes)
    if num_shards == 1:
        write_sparse(folder / f'{stem}.safetensors', shapes, 'BF16')
        return
    places = {}
    for number in range(num_shards):
        share = names[number::num_shards]
        file = f'{stem}-{number + 1:05d}-of-{num_shards:05d}.safetensors'
        write_sparse(folder / file, {name: shapes[name] for name in share}, 'BF16')
        places |= dict.fromkeys(share, file)
    index = {'metadata': {}, 'weight_map': places}
    (folder / f'{stem}.safetensors.index.json').write_text(json.dumps(index))


def write_public(folder: Path, preset: str, options: argparse.Namespace) -> int:
    """Write a folder like the published one; return the numbers in it."""
    model = load_training_config(preset).transformer
    dim = model['num_attention_heads'] * model['attention_head_dim']
    transformer = video_tensors(
        dim=dim,
        ffn=model['ffn_dim'],
        layers=model['num_layers'],
        in_dim=model['in_channels'],
        text_dim=model['text_dim'],
        clip_dim=model['image_dim'],
    )
    whole = options.layers == 0
    umt5 = umt5_shapes(model['text_dim'], 256384, 10240, 24 if whole else 2, 64)
    clip = clip_shapes(model['image_dim'], 32 if whole else 2, side=16, patch=14, out=1024)
    clip |= clip_text_shapes() if whole else {}
    with torch.device('meta'):
        vae = AutoencoderKLWan().state_dict()
    decoder = {vae_original_name(name): tuple(value.shape) for name, value in vae.items()}
    folder.mkdir()
    write_transformer(folder, transformer, options.shards)
    write_sparse(folder / 'models_t5_umt5-xxl-enc-bf16.safetensors', umt5, 'BF16')
    name = 'models_clip_open-clip-xlm-roberta-large-vit-huge-14.safetensors'
    write_sparse(folder / name, clip, 'F16')
    write_sparse(folder / 'Wan2.1_VAE.safetensors', decoder, 'F32')
    write_tokenizer(folder / 'google' / 'umt5-xxl')
    return sum(prod(s) for part in (transformer, umt5, clip, decoder) for s in part.values())


def watched(command: list[str]) -> tuple[float, float, float]:
    """Run a command; return its seconds, and the most GiB that it held, and held unmapped."""
    begun, whole, own = time.perf_counter(), 0, 0
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    status = Path(f'/proc/{process.pid}/status')
    while process.poll() is None:
        lines = dict(line.split(':', 1) for line in status.read_text().splitlines())
        if 'VmHWM' in lines:  # gone once it has ended
            whole = max(whole, int(lines['VmHWM'].split()[0]))
            own = max(own, int(lines['RssAnon'].split()[0]))
        time.sleep(_WATCH_S)
    if process.returncode:
        raise SystemExit(f'{shlex.join(command)} ended with status {process.returncode}')
    return time.perf_counter() - begun, whole * 1024 / _GIB, own * 1024 / _GIB


def preset_file(preset: str, layers: int, folder: Path) -> str:
    """The preset, or a file of it with fewer layers."""
    if not layers:
        return preset
    file = ROOT / 'config' / 'models' / f'{preset}.yaml'
    values = yaml.safe_load(file.read_text())
    values['transformer']['num_layers'] = layers
    (folder / 'preset.yaml').write_text(yaml.safe_dump(values))
    return str(folder / 'preset.yaml')


def measure(options: argparse.Namespace) -> str:
    """The page's table."""
    rows = []
    with tempfile.TemporaryDirectory(dir=options.work, prefix='wan_import_') as name:
        work = Path(name)
        preset = preset_file(options.preset, options.layers, work)
        numbers = write_public(work / 'public', preset, options)
        mtv = [sys.executable, '-m', 'mtv_world_ros.cli']
        out = str(work / 'checkpoint')
        commands: Mapping[str, list[str]] = {
            'import-weights': ['import', 'wan', str(work / 'public'), '--out', out],
            'train --dry-run': ['train', '--dry-run'],
        }
        for title, command in commands.items():
            seconds, whole, own = watched([*mtv, *command, '--preset', preset])
            rows.append([title, f'{seconds:.0f}', f'{whole:.2f}', f'{own:.2f}'])
    layers = f'{options.layers} layers' if options.layers else 'all layers'
    return (
        f'Preset `{options.preset}`, {layers}, transformer in {options.shards} file(s); '
        f'{numbers / 1e9:.2f} G numbers in all files.\n\n'
        + table(['command', 'seconds', 'most memory [GiB]', 'without mapped files [GiB]'], rows)
    )


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add what other benchmarks do not have."""
    parser.add_argument('--preset', default='wan-1.3b')
    parser.add_argument('--layers', type=int, default=0, help='0 = all of the preset')
    parser.add_argument('--shards', type=int, default=1, help="the transformer's files")
    parser.add_argument('--work', type=Path, help='folder for temporary files')


def main() -> None:
    """Measure, and print the page."""
    options = parse_arguments(__doc__, repeats=1, more=add_options)
    kind = 'wan_import_' + options.preset.removeprefix('wan-').replace('.', '_')
    command = shlex.join(['python', *sys.argv])
    body = measure(options)
    publish(
        kind, f'Import of {options.preset}', command, body, options, f'torch {torch.__version__}'
    )


if __name__ == '__main__':
    main()
