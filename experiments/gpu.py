"""Runs everything that wants a GPU, in ten minutes at most, and prints one page.

    python experiments/gpu.py pack gpu.tar.xz      on a machine with a network and git
    tar xf gpu.tar.xz && python3 gpu/experiments/gpu.py run     on one with a GPU and PyTorch

The second machine needs no network: this tree and the packages that such a machine lacks are in
the file. What is run: the speed of `wan-1.3b`, compiled, at 4 and 16 steps beside diffusers' own
pipeline, and plain, offloaded and with a tiny autoencoder; its training, plain, compiled and
without recomputing blocks; the tests marked `gpu`; `wan-14b` for two steps. `run --tiny` runs the
same parts on a CPU with a small model, to see that they run. Only the standard library is used
here.

    python experiments/gpu.py pack gpu.tar.xz --data data/full
    python3 gpu/experiments/gpu.py run --paper

packs episodes, too, and runs other parts, also in ten minutes: two rows of the paper's tables with
60,000 clips each, and training of `wan-1.3b` with random weights by all GPUs together and by one.
`back.tar.xz` in the folder of the results has what is worth keeping: the page, logs, tables,
checkpoints and scores.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date
import json
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
import tempfile
import time

ROOT = Path(__file__).resolve().parents[1]
#: packages that a machine with PyTorch and transformers lacks; versions: the tested ones
PACKAGES = (
    'annotated-types', 'coal', 'diffusers', 'eigenpy', 'importlib_metadata', 'libcoal',
    'libpinocchio', 'lz4', 'mcap', 'mcap-ros2-support', 'peft', 'accelerate', 'pin', 'pydantic',
    'pydantic_core', 'rosbags', 'ruamel.yaml', 'simplejpeg', 'typing-inspection', 'zipp',
    'zstandard',
)  # fmt: skip
#: what the measured code imports and never calls
_STAND_INS = ('av', 'dartpy', 'mujoco')
_PLATFORMS = tuple(f'manylinux{name}_x86_64' for name in ('2014', '_2_17', '_2_27', '_2_28'))
_LEFT_OUT = (':!docs', ':!experiments/results', ':!.github', ':!findings')
_TESTS = (
    'test/model/serving/test_serving.py',
    'test/model/serving/test_wan_serving.py',
    'test/training/test_trainer.py',
    'test/training/test_wan_training.py',
    'test/vision/segmenters/test_prompted.py',
)
_SERVING = 'compile=true'
#: rows of the paper's tables that are trained, the full method first
_ROWS = ('mtv_world', 'ee_mlp')
#: clips that each row is trained with, and clips of a step of one GPU
_CLIPS, _BATCH = 60_000, 64
#: files of the results that are brought back; caches and training states are left out
_BACK = (
    'page.md',
    '*.log',
    'tables/tables.md',
    'tables/rows/*/seed_*/times.json',
    'tables/rows/*/seed_*/training/log.jsonl',
    'tables/rows/*/seed_*/clips_*/checkpoint',
    'tables/rows/*/seed_*/clips_*/*/metrics.json',
)
_COMPARED = (
    _SERVING,
    'compile=true tiny_decoder=random tiny_encoder=true',
    'offload=true',
)
#: a model of a few thousand numbers
_TINY = (
    'transformer.num_layers=1', 'transformer.num_attention_heads=2',
    'transformer.attention_head_dim=12', 'transformer.ffn_dim=40', 'transformer.text_dim=32',
    'transformer.image_dim=32', 'transformer.added_kv_proj_dim=24', 'video.num_frames=4',
    'video.width=32', 'video.height=32', 'autoencoder.base_dim=4',
)  # fmt: skip


#: the preset of the tables with as few numbers
_TINY_ROW = (
    'transformer.num_layers=1',
    'transformer.num_attention_heads=1',
    'transformer.ffn_dim=32',
    'video.num_frames=4',
    'video.width=32',
    'video.height=24',
    'optimizer.batch_size=2',
)


@dataclass(frozen=True)
class Part:
    """A command, and how long it may take."""

    title: str
    seconds: int
    command: tuple[str, ...]


def parts(tiny: bool) -> list[Part]:
    """Everything, in the order of what is wanted most; 590 s in all."""
    more = ('--set', *_TINY) if tiny else ()
    device = ('--device', 'cpu' if tiny else 'cuda', '--repeats', '1' if tiny else '2')
    steps, compared, serving = ('4', '16'), _COMPARED, ('--serving', _SERVING)
    if tiny:  # compiling takes g++ a minute
        steps, compared, serving = ('1',), (_COMPARED[1].removeprefix(f'{_SERVING} '),), ()
    speed = ('experiments/wan_speed.py', *device, *more, *serving)
    tests = ('-m', 'pytest', '-q', '-m', 'gpu', '-p', 'no:cacheprovider', *_TESTS)
    compiled = () if tiny else ('optimizer.compile=true',)
    kept = 'optimizer.gradient_checkpointing=false'
    return [
        Part('Speed', 200, (*speed, '--steps', *steps, '--compare', *compared)),
        Part('Training', 60, _training(device, tiny)),
        Part('Training compiled', 70, _training(device, tiny, *compiled)),
        Part('Training blocks kept', 70, _training(device, tiny, *compiled, kept)),
        Part('Tests', 80, tests),
        Part('14B', 110, (*speed, '--preset', 'wan-14b', '--steps', '2', '--compare')),
    ]


def paper_parts(tiny: bool, data: Path) -> list[Part]:
    """Rows of the paper's tables, and training by all GPUs together; 590 s in all."""
    count = 2 if tiny else max(_num_gpus(), 1)
    device = ('--device', 'cpu' if tiny else 'cuda', '--repeats', '1' if tiny else '5')
    launcher = ('-m', 'torch.distributed.run', '--standalone', '--nproc-per-node', str(count))
    tables = [
        'experiments/paper_tables.py', '--out', '{out}/tables', '--data', str(data.absolute()),
        '--zero-shot-episodes', '0', '--no-lite-features', *device[:2], '--clips',
        '2' if tiny else str(_CLIPS), '--test-episodes', '2' if tiny else '30',
    ]  # fmt: skip
    sets = _TINY_ROW if tiny else (f'optimizer.batch_size={_BATCH}',)
    tables += [x for value in sets for x in ('--set', value)]
    if count > 1 and not tiny:
        tables += ['--launcher', f'{sys.executable} {" ".join(launcher)}']
    if (data / 'dataset.json').is_file():
        tables += ['--tasks', ','.join(_tasks(data))]
    one = _training(device, tiny)
    together = tuple(
        value.replace('optimizer.batch_size=1', f'optimizer.batch_size={count}') for value in one
    )
    rows = [Part(f'Row {row}', 230, (*tables, '--rows', row)) for row in _ROWS]
    return [
        *rows,
        Part('One process', 60, one),
        Part('All processes', 70, (*launcher, *together)),
    ]


def _num_gpus() -> int:
    if not shutil.which('nvidia-smi'):
        return 0
    listed = subprocess.run(['nvidia-smi', '-L'], capture_output=True, text=True, check=False)
    return listed.stdout.count('GPU ')


def _tasks(data: Path) -> list[str]:
    """Return the tasks of a data set."""
    episodes = json.loads((data / 'dataset.json').read_text())['episodes']
    return sorted({episode['task'] for episode in episodes})


def _bring_back(out: Path) -> None:
    """Pack the results that are worth keeping, without links out of their folder."""
    names = sorted({str(p.relative_to(out)) for glob in _BACK for p in out.glob(glob)})
    if names:
        file = out / 'back.tar.xz'
        subprocess.run(['tar', 'cJf', str(file), '-C', str(out), *names], check=True)
        print(f'\nbring back: {file} ({file.stat().st_size / 2**20:.1f} MiB)', flush=True)


def _training(device: tuple[str, ...], tiny: bool, *values: str) -> tuple[str, ...]:
    set_ = (*(_TINY if tiny else ()), 'optimizer.batch_size=1', *values)
    options = (x for value in set_ for x in ('--set', value))
    return ('experiments/wan_training_speed.py', *device, *options)


def run(options: argparse.Namespace) -> int:
    """Run the parts; print and write the page. Return how many of them failed."""
    options.out.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, **_environment(options.out)}
    head, sections, failed = f'# Run on a GPU, {date.today()}\n\n{_machine()}', [], 0
    print(head, flush=True)
    data = options.data or ROOT.parent / 'data'
    chosen = paper_parts(options.tiny, data) if options.paper else parts(options.tiny)
    out = str(options.out.absolute())
    for part in chosen:
        if part.title not in (options.parts or [part.title]):
            continue
        command = [word.replace('{out}', out) for word in part.command]
        begun = time.monotonic()
        log = options.out / f'{part.title.lower().replace(" ", "_")}.log'
        with log.open('wb') as stream:
            try:
                status = subprocess.run(
                    [sys.executable, *command],
                    cwd=ROOT,
                    env=environment,
                    stdout=stream,
                    stderr=subprocess.STDOUT,
                    # a CPU may be busy with other things
                    timeout=part.seconds * (10 if options.tiny else 1),
                    check=False,
                ).returncode
            except subprocess.TimeoutExpired:
                status = -1
        failed += status != 0
        ended = 'out of time' if status == -1 else f'status {status}'
        told = '\n'.join(_worth(log.read_text(errors='replace')))
        spent = time.monotonic() - begun
        sections.append(f'## {part.title}: {ended}, {spent:.0f} s\n\n{told}')
        # at once: the machine may be gone before the next part ends
        (options.out / 'page.md').write_text('\n\n'.join([head, *sections]) + '\n')
        print(f'\n{sections[-1]}', flush=True)
    _bring_back(options.out)
    return failed


def _environment(out: Path) -> dict[str, str]:
    """Where packages are looked for: the stand-ins and packed ones before the machine's own."""
    paths = [str(ROOT), str(ROOT / 'experiments')]
    site = ROOT.parent / 'site'
    if site.is_dir():
        stand_ins = out / 'stand_ins'
        stand_ins.mkdir(exist_ok=True)
        (stand_ins / 'sitecustomize.py').write_text(_SITE.format(names=_STAND_INS))
        cmeel = site / 'cmeel.prefix' / 'lib'
        paths = [
            str(stand_ins),
            str(site),
            *map(str, cmeel.glob('python3*/site-packages')),
            *paths,
        ]
    return {
        'PYTHONPATH': os.pathsep.join([*paths, os.environ.get('PYTHONPATH', '')]).rstrip(':'),
        'HF_HUB_OFFLINE': '1',
        'PYTHONUNBUFFERED': '1',
    }


_SITE = '''"""Stand-ins for packages that the measured code imports and never calls."""
import importlib.abc, importlib.machinery, importlib.util, sys, types

class StandIn(types.ModuleType):
    __path__ = []
    def __getattr__(self, name):
        if name.startswith('__'):
            raise AttributeError(name)
        return type(name, (), {{}})

class Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in {names}:
            return importlib.machinery.ModuleSpec(name, self, is_package=True)
    def create_module(self, spec):
        return StandIn(spec.name)
    def exec_module(self, module):
        pass

sys.meta_path.append(Finder())
'''


def _worth(text: str) -> Iterator[str]:
    """The lines of a part's output that belong on the page: tables, and how it ended."""
    lines = text.splitlines()
    begins = next((n for n, line in enumerate(lines) if line.startswith('# ')), None)
    if begins is None:
        yield from ('```', *lines[-25:], '```')
        return
    for line in lines[begins:]:
        yield re.sub('^#', '###', line)


def _machine() -> str:
    """The card, and versions."""
    if shutil.which('nvidia-smi'):
        query = ['nvidia-smi', '--query-gpu=name,memory.total', '--format=csv,noheader']
        card = subprocess.run(query, capture_output=True, text=True, check=False).stdout.strip()
    else:
        card = 'no GPU'
    code = 'import torch,diffusers;print(torch.__version__,"diffusers",diffusers.__version__)'
    with tempfile.TemporaryDirectory() as work:
        environment = {**os.environ, **_environment(Path(work))}
        told = subprocess.run(
            [sys.executable, '-c', code],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
    versions = (told.stdout.strip() or told.stderr.strip().splitlines()[-1]).splitlines()[-1]
    return f'{card}; Python {sys.version.split()[0]}, torch {versions}.'


def pack(options: argparse.Namespace) -> int:
    """Pack this commit's tree and the packages."""
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        tree = work / 'gpu'
        tree.mkdir()
        archive = subprocess.run(
            ['git', '-C', str(ROOT), 'archive', 'HEAD', '--', '.', *_LEFT_OUT],
            check=True,
            stdout=subprocess.PIPE,
        )
        subprocess.run(['tar', 'x', '-C', str(tree)], input=archive.stdout, check=True)
        git = ['git', '-C', str(ROOT), 'rev-parse', '--short', 'HEAD']
        commit = subprocess.run(git, check=True, capture_output=True, text=True).stdout.strip()
        (tree / 'COMMIT').write_text(commit)
        # commands are found by entry points, which stand in a package's metadata
        subprocess.run([sys.executable, 'setup.py', '--quiet', 'egg_info'], cwd=tree, check=True)
        _install(work / 'site', options.python)
        members = ['-C', name, 'gpu', 'site']
        if options.data is not None:
            # under the name that `run` looks for
            (work / 'data').symlink_to(options.data.absolute())
            members.append('data')
        subprocess.run(['tar', 'chJf', str(options.file.absolute()), *members], check=True)
    print(f'{options.file}: {options.file.stat().st_size / 2**20:.0f} MiB')
    return 0


def _install(site: Path, python: str) -> None:
    """The packages' wheels, unpacked, without what is needed to compile against them."""
    listed = (ROOT / 'requirements' / 'constraints.txt').read_text().split()
    pinned = {line.partition('==')[0].lower().replace('_', '-'): line for line in listed}
    names = [*PACKAGES, *(name for name in pinned if name.startswith('cmeel'))]
    wanted = [pinned.get(name.lower().replace('_', '-'), name) for name in names]
    pip = [sys.executable, '-m', 'pip', 'install', '--quiet', '--no-deps', '--target', str(site)]
    pip += ['--python-version', python, '--only-binary', ':all:', *wanted]
    platforms = [x for name in _PLATFORMS for x in ('--platform', name)]
    subprocess.run([*pip, *platforms], check=True)
    for unused in (*site.glob('cmeel.prefix/include'), *site.glob('cmeel.prefix/share')):
        shutil.rmtree(unused)
    for unused in [*site.rglob('*.a'), *site.rglob('*.pyc')]:
        unused.unlink()
    for library in site.rglob('*.so*'):
        if library.is_file() and not library.is_symlink():
            subprocess.run(['strip', '--strip-unneeded', str(library)], check=False)


def main() -> int:
    """Run a command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    packing = commands.add_parser('pack', help='make a file for a machine without network')
    packing.add_argument('file', type=Path)
    packing.add_argument('--python', default='3.12', help="the other machine's version")
    packing.add_argument('--data', type=Path, help='episodes of mtv-world collect, to be packed')
    packing.set_defaults(handler=pack)
    running = commands.add_parser('run', help='run, and print the page')
    running.add_argument('--out', type=Path, default=ROOT / 'out' / 'gpu')
    running.add_argument('--tiny', action='store_true', help='on a CPU, with a small model')
    running.add_argument('--paper', action='store_true', help="rows of the paper's tables, DDP")
    running.add_argument('--data', type=Path, help='episodes of --paper; default: the packed ones')
    titles = [part.title for part in [*parts(tiny=False), *paper_parts(False, Path('data'))]]
    running.add_argument('--parts', nargs='+', choices=titles, help='default: all')
    running.set_defaults(handler=run)
    options = parser.parse_args()
    return options.handler(options)


if __name__ == '__main__':
    sys.exit(main())
