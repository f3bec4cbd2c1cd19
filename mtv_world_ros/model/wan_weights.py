"""Converts public Wan 2.1 weights into a checkpoint folder, with every tensor accounted for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
import json
from math import isqrt
from pathlib import Path
from typing import Any

from safetensors.torch import save_file
import torch

from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.core.files import copy_folder, whole_folder
from mtv_world_ros.model import wan_keys
from mtv_world_ros.model.card import CheckpointCard, ROBOT_FOLDER
from mtv_world_ros.model.parts import build_autoencoder, build_scheduler
from mtv_world_ros.model.tensor_files import (
    disk_errors,
    import_transformers,
    INDEX,
    open_tensors,
    pickle_error,
    PICKLES,
    StoredTensor,
)
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from mtv_world_ros.model.wan_keys import KeyMap
from mtv_world_ros.robot.file import save_robot

#: bytes of tensors that are gathered before they are written
SHARD_BYTES = 2 * 2**30
#: heads of CLIP's ViT-H/14, which show in no tensor
_CLIP_HEADS = 16


def describe_encoder(
    part: str, source: Path, tensors: Mapping[str, StoredTensor], keys: KeyMap
) -> tuple[dict[str, Any], dict[str, tuple[int, ...]]]:
    """Return the configuration of `text_encoder` or `image_encoder`, and its tensors' shapes.

    Raises:
        CheckpointError: the tensors are not those of umT5, or of CLIP's image side.
        ConfigError: transformers is not installed.
    """
    transformers = import_transformers()
    kind = transformers.UMT5Config if part == 'text_encoder' else transformers.CLIPVisionConfig
    file = source / 'config.json'
    if file.is_file():
        try:
            values = dict(read_json(file))
        except (OSError, ValueError, TypeError) as error:
            raise CheckpointError(f"'{file}' cannot be read: {error}") from error
        if values.get('model_type') != kind.model_type:
            raise CheckpointError(
                f"'{file}' is of a {values.get('model_type')}, expected {kind.model_type}"
            )
        config = kind.from_dict(values)
    else:
        shapes = {n: tensors[t.source].shape for n, t in keys.takes.items()}
        read = _umt5 if part == 'text_encoder' else _clip
        try:
            config = kind(**read(shapes))
        except KeyError as error:
            expected = 'the encoder of umT5-XXL' if part == 'text_encoder' else "CLIP's ViT-H/14"
            raise CheckpointError(
                f"{part} '{source}' lacks tensor {error}; expected {expected}"
            ) from error
    with torch.device('meta'):
        if part == 'text_encoder':
            model = transformers.UMT5EncoderModel(config)
        else:
            model = transformers.CLIPVisionModel(config)
    shapes = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    shapes.pop('encoder.embed_tokens.weight', None)  # the same as shared.weight
    return {**config.to_dict(), 'architectures': [type(model).__name__]}, shapes


def check_width(part: str, source: Path, config: Mapping[str, Any], expected: int) -> None:
    """Check that an encoder's tokens are as wide as the transformer takes them.

    Raises:
        CheckpointError: the encoder has another width.
    """
    width = config['d_model' if part == 'text_encoder' else 'hidden_size']
    if width != expected:
        raise CheckpointError(
            f"{part} '{source}' gives tokens of width {width}, the transformer takes {expected}; "
            'Wan 2.1 goes with umT5-XXL (4096) and CLIP ViT-H/14 (1280)'
        )


def _num_layers(shapes: Mapping[str, Any], prefix: str) -> int:
    return len({name[len(prefix) :].split('.')[0] for name in shapes if name.startswith(prefix)})


def _umt5(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
    first = 'encoder.block.0.layer'
    buckets, heads = shapes[f'{first}.0.SelfAttention.relative_attention_bias.weight']
    vocab, width = shapes['shared.weight']
    return {
        'vocab_size': vocab,
        'd_model': width,
        'd_kv': shapes[f'{first}.0.SelfAttention.q.weight'][0] // heads,
        'd_ff': shapes[f'{first}.1.DenseReluDense.wi_0.weight'][0],
        'num_layers': _num_layers(shapes, 'encoder.block.'),
        'num_heads': heads,
        'relative_attention_num_buckets': buckets,
        'feed_forward_proj': 'gated-gelu',
    }


def _clip(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
    width, _, patch, _ = shapes['embeddings.patch_embedding.weight']
    positions = shapes['embeddings.position_embedding.weight'][-2]
    return {
        'hidden_size': width,
        'intermediate_size': shapes['encoder.layers.0.mlp.fc1.weight'][0],
        'num_hidden_layers': _num_layers(shapes, 'encoder.layers.'),
        'num_attention_heads': _CLIP_HEADS,
        'image_size': isqrt(positions - 1) * patch,
        'patch_size': patch,
        'hidden_act': 'gelu',
    }


REPORT = 'import.json'
#: tensors that public checkpoints lack; they start at zero and so change nothing
NEW = ('view_embedding',)


@dataclass(frozen=True, slots=True)
class PartReport:
    """Result of importing one part: tensors written, new and left out.

    Attributes:
        part: name of the part, e.g. `transformer`.
        source: file or folder that the tensors came from.
        loaded: number of tensors written.
        parameters: number of values in these tensors.
        dtypes: number formats of the tensors.
        new: tensors that the source lacks, zero now.
        unused: tensors that were left out, and why.
    """

    part: str
    source: str
    loaded: int
    parameters: int
    dtypes: tuple[str, ...]
    new: tuple[str, ...]
    unused: Mapping[str, str]


def import_weights(
    path: Path,
    out: Path,
    *,
    transformer: Mapping[str, Any],
    autoencoder: Mapping[str, Any],
    scheduler: Mapping[str, Any],
    card: CheckpointCard,
    elsewhere: Mapping[str, Path | None] | None = None,
    robot: Path | None = None,
    shard_bytes: int = SHARD_BYTES,
) -> list[PartReport]:
    """Write a checkpoint folder from public weights, number formats kept.

    No more than one shard is in memory at a time.

    Args:
        path: folder in VideoX-Fun's or diffusers' layout, or the transformer's file.
        out: the checkpoint's folder; appears under its name only when it is whole.
        transformer: arguments of `MultiViewWanTransformer`.
        autoencoder: arguments of the autoencoder.
        scheduler: arguments of the noise schedule.
        card: card of the checkpoint.
        elsewhere: files or folders of parts that are not in `path`.
        robot: YAML of the robot that it will be trained on, to be carried by the checkpoint.
        shard_bytes: size at which a new file is begun.

    Raises:
        CheckpointError: a part, shard or tensor is missing, unknown, of another model or a pickle.
    """
    if out.exists():
        raise CheckpointError(f"'{out}' exists; give --out a folder that does not")
    sources = find_sources(Path(path), elsewhere or {})
    with whole_folder(out) as partial:
        reports = _import_parts(sources, partial, transformer, autoencoder, shard_bytes)
        copy_folder(sources['tokenizer'], partial / 'tokenizer')
        build_scheduler(scheduler).save_pretrained(partial / 'scheduler')
        if robot is not None:
            save_robot(robot, partial / ROBOT_FOLDER)
        card.write(partial)
        listed = [asdict(report) for report in reports]
        (partial / REPORT).write_text(json.dumps(listed, indent=2) + '\n')
    return reports


def _import_parts(
    sources: Mapping[str, Path],
    out: Path,
    transformer: Mapping[str, Any],
    autoencoder: Mapping[str, Any],
    shard_bytes: int,
) -> list[PartReport]:
    reports = [
        _import_transformer(sources['transformer'], out, transformer, shard_bytes),
        _import_autoencoder(sources['autoencoder'], out, autoencoder, shard_bytes),
    ]
    for part, width in (('text_encoder', 'text_dim'), ('image_encoder', 'image_dim')):
        reports.append(_import_encoder(part, sources[part], out, transformer[width], shard_bytes))
    return reports


def _import_transformer(
    source: Path, out: Path, config: Mapping[str, Any], shard_bytes: int
) -> PartReport:
    tensors = open_tensors(source, 'diffusion_pytorch_model' if source.is_dir() else '')
    keys = wan_keys.transformer_keys(tensors)
    with torch.device('meta'):
        model = MultiViewWanTransformer(**config)
    _check_architecture(source, tensors, keys, model)
    shapes = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    report = _write('transformer', source, tensors, keys, shapes, out, shard_bytes)
    model.save_config(out / 'transformer')
    return report


def _check_architecture(
    source: Path,
    tensors: Mapping[str, StoredTensor],
    keys: wan_keys.KeyMap,
    model: MultiViewWanTransformer,
) -> None:
    """Name the most common wrong checkpoints in the error."""
    config: Any = model.config
    patch = keys.takes.get('patch_embedding.weight')
    if patch is None or len(tensors[patch.source].shape) != 5:
        raise CheckpointError(
            f"'{source}' holds no Wan transformer (no 'patch_embedding.weight' of 5 axes); "
            'expected the transformer of Wan2.1-Fun-V1.1-Control'
        )
    width, channels = tensors[patch.source].shape[:2]
    expected = config['num_attention_heads'] * config['attention_head_dim']
    if width != expected:
        raise CheckpointError(
            f"'{source}' has width {width}, the preset {expected}; Wan 2.1 has 1536 (--preset "
            'wan-1.3b) or 5120 (--preset wan-14b)'
        )
    if channels != config['in_channels']:
        raise CheckpointError(
            f"'{source}' takes {channels} channels, expected {config['in_channels']} (noisy, "
            'control and start image, 16 each): Wan2.1-Fun-V1.1-Control has 48, its text-to-video '
            'and image-to-video siblings have 16 and 36'
        )
    if 'ref_conv.weight' not in keys.takes:
        raise CheckpointError(
            f"'{source}' has no 'ref_conv.weight', which takes the reference image: a Fun-Control "
            'checkpoint of V1.0? Expected V1.1'
        )
    _check_heads(source, config['num_attention_heads'])


def _check_heads(source: Path, expected: int) -> None:
    """Check the number of heads, which only the configuration file states, not a tensor shape."""
    file = (source if source.is_dir() else source.parent) / 'config.json'
    if not file.is_file():
        return
    try:
        config = read_json(file)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"'{file}' is not valid JSON: {error}") from error
    heads = config.get('num_heads', config.get('num_attention_heads', expected))
    if heads != expected:
        raise CheckpointError(f"'{file}' says {heads} attention heads, the preset {expected}")


def _import_autoencoder(
    source: Path, out: Path, config: Mapping[str, Any], shard_bytes: int
) -> PartReport:
    tensors = open_tensors(source, 'diffusion_pytorch_model' if source.is_dir() else '')
    with torch.device('meta'):
        model: Any = build_autoencoder(config)
    shapes = {name: tuple(value.shape) for name, value in model.vae.state_dict().items()}
    keys = wan_keys.autoencoder_keys(tensors)
    report = _write('autoencoder', source, tensors, keys, shapes, out, shard_bytes)
    model.vae.save_config(out / 'autoencoder')
    return report


def _import_encoder(
    part: str, source: Path, out: Path, width: int, shard_bytes: int
) -> PartReport:
    tensors = open_tensors(source, 'model' if source.is_dir() else '')
    find_keys = {
        'text_encoder': wan_keys.text_encoder_keys,
        'image_encoder': wan_keys.image_encoder_keys,
    }
    keys = find_keys[part](tensors)
    config, shapes = describe_encoder(part, source, tensors, keys)
    check_width(part, source, config, width)
    report = _write(part, source, tensors, keys, shapes, out, shard_bytes, stem='model')
    (out / part / 'config.json').write_text(json.dumps(config, indent=2) + '\n')
    return report


def _write(
    part: str,
    source: Path,
    tensors: Mapping[str, StoredTensor],
    keys: wan_keys.KeyMap,
    shapes: Mapping[str, tuple[int, ...]],
    out: Path,
    shard_bytes: int,
    stem: str = 'diffusion_pytorch_model',
) -> PartReport:
    """Write a part's tensors under our names; no tensor of source or target is left over."""
    unknown = sorted(set(keys.takes) - set(shapes))
    if unknown:
        names = [keys.takes[name].source for name in unknown]
        raise CheckpointError(
            f"{part} '{source}': {len(names)} tensors belong to another model: {_some(names)}"
        )
    missing = sorted(set(shapes) - set(keys.takes) - set(NEW))
    if missing:
        raise CheckpointError(
            f"{part} '{source}': {len(missing)} tensors are missing: {_some(missing)}"
        )
    new = tuple(name for name in NEW if name in shapes and name not in keys.takes)
    ours = {}
    for name, shape in shapes.items():
        if name in new:
            ours[name] = _zeros(shape)
        else:
            ours[name] = _taken(part, source, tensors, keys.takes[name], shape)
    write_tensors(ours, out / part, stem, shard_bytes=shard_bytes)
    taken = [ours[name] for name in shapes if name not in new]
    return PartReport(
        part=part,
        source=str(source),
        loaded=len(taken),
        parameters=sum(torch.Size(tensor.shape).numel() for tensor in taken),
        dtypes=tuple(sorted({tensor.dtype for tensor in taken})),
        new=new,
        unused=keys.unused,
    )


def write_tensors(
    tensors: dict[str, StoredTensor], folder: Path, stem: str, *, shard_bytes: int = SHARD_BYTES
) -> None:
    """Write tensors as diffusers and transformers do: one file, or shards and their index.

    Holds no more than one shard in memory.
    """
    folder.mkdir(parents=True, exist_ok=True)
    shards = _plan(tensors, shard_bytes)
    places = {}
    for number, names in enumerate(shards, start=1):
        many = f'-{number:05d}-of-{len(shards):05d}' if len(shards) > 1 else ''
        file = f'{stem}{many}.safetensors'
        values = {name: tensors[name].read().contiguous() for name in names}
        with disk_errors():
            save_file(values, folder / file, metadata={'format': 'pt'})
        del values  # before the next shard is read
        places |= dict.fromkeys(names, file)
    if len(shards) > 1:
        total = sum(tensor.num_bytes for tensor in tensors.values())
        index = {'metadata': {'total_size': total}, 'weight_map': places}
        (folder / f'{stem}{INDEX}').write_text(json.dumps(index, indent=2) + '\n')


def _plan(tensors: dict[str, StoredTensor], shard_bytes: int) -> list[list[str]]:
    shards: list[list[str]] = [[]]
    held = 0
    for name, tensor in tensors.items():
        if shards[-1] and held + tensor.num_bytes > shard_bytes:
            shards.append([])
            held = 0
        shards[-1].append(name)
        held += tensor.num_bytes
    return shards


def _taken(
    part: str,
    source: Path,
    tensors: Mapping[str, StoredTensor],
    take: wan_keys.TakenTensor,
    shape: tuple[int, ...],
) -> StoredTensor:
    stored = tensors[take.source]
    parts = (stored.shape[0] // take.num_parts, *stored.shape[1:]) if stored.shape else ()
    # only axes of length 1 may come or go
    if [n for n in parts if n != 1] != [n for n in shape if n != 1]:
        raise CheckpointError(
            f"{part} '{source}': tensor '{take.source}' has shape {list(stored.shape)}, expected "
            f'{[shape[0] * take.num_parts, *shape[1:]] if shape else []}'
        )

    def read() -> torch.Tensor:
        return stored.read().chunk(take.num_parts)[take.part].reshape(shape).clone()

    return StoredTensor(shape, stored.dtype, read)


def _zeros(shape: tuple[int, ...]) -> StoredTensor:
    return StoredTensor(shape, 'F32', lambda: torch.zeros(shape))


def _some(names: list[str]) -> str:
    """Return the first few names."""
    return ', '.join(names[:8]) + (', ...' if len(names) > 8 else '')


#: part: (folder in diffusers' layout, patterns of files in VideoX-Fun's layout, option, example)
PARTS = {
    'transformer': (
        ('transformer',),
        ('diffusion_pytorch_model*', '*Fun*Control*'),
        'PATH',
        'diffusion_pytorch_model.safetensors',
    ),
    'autoencoder': (
        ('autoencoder', 'vae'),
        ('*[Vv][Aa][Ee]*',),
        '--autoencoder',
        'Wan2.1_VAE.safetensors',
    ),
    'text_encoder': (
        ('text_encoder',),
        ('models_t5*', '*umt5*'),
        '--text-encoder',
        'models_t5_umt5-xxl-enc-bf16.safetensors',
    ),
    'image_encoder': (
        ('image_encoder',),
        ('models_clip*', '*clip*vit-h*', '*CLIP*'),
        '--image-encoder',
        'models_clip_open-clip-xlm-roberta-large-vit-huge-14.safetensors',
    ),
    'tokenizer': (('tokenizer', 'google/umt5-xxl'), (), '--tokenizer', 'google/umt5-xxl/'),
}


def find_sources(path: Path, given: Mapping[str, Path | None]) -> dict[str, Path]:
    """Return file or folder of every part.

    Args:
        path: a folder in VideoX-Fun's or diffusers' layout, or the transformer's file.
        given: parts that lie elsewhere; None = look in `path`.

    Raises:
        CheckpointError: a part is nowhere, or only as a pickle; says which and where to give it.
    """
    if not path.exists():
        raise CheckpointError(f"'{path}' does not exist; name a checkpoint's folder or file")
    found = {part: place for part, place in given.items() if place is not None}
    for part, place in found.items():
        if not place.exists():
            raise CheckpointError(f"{PARTS[part][2]} '{place}' does not exist")
    if path.is_file():
        found['transformer'] = path
    for part in PARTS:
        if part not in found:
            found[part] = _find(path if path.is_dir() else path.parent, part)
    return found


def _find(folder: Path, part: str) -> Path:
    folders, patterns, option, example = PARTS[part]
    for name in folders:
        if (folder / name).is_dir():
            return folder / name
    files = sorted({file for pattern in patterns for file in folder.glob(pattern)})
    files = [file for file in files if file.is_file()]
    for suffix in (INDEX, '.safetensors'):
        readable = [file for file in files if file.name.endswith(suffix)]
        if readable:
            # shards without an index are found again by their folder
            return folder if len(readable) > 1 and part == 'transformer' else readable[0]
    pickles = [file for file in files if file.suffix in PICKLES]
    if pickles:
        raise pickle_error(pickles)
    raise CheckpointError(
        f"'{folder}' holds no {part}: expected a folder {' or '.join(folders)}/, or a file like "
        f'{example}; name it with {option}'
    )
