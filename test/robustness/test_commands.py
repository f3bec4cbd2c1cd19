"""Commands that are given wrong folders, damaged files and impossible numbers: one line, no trace.

A word of the command line is replaced by what a stranger may put there. The command ends with
status 1 or 2 and says in the last line what is wrong; it writes nothing, and ends in time.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import cache
import os
from pathlib import Path
import time

import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.core.files import share_path
from test.support.tables import table

DEMO = share_path('resource', 'demo_episode')
BAG = next(DEMO.glob('*.mcap'))
#: longest time until it says so [s of the processor]
MOST_S = 20.0
#: stands where a hostile path is put, and where results would be written
AT, OUT = '@', '%'

COMMANDS = {
    'foresee': 'foresee @',
    'foresee, contact': f'foresee {DEMO} --contact @',
    'foresee, robot': f'foresee {DEMO} --robot @',
    'fit-contact': 'fit contact @ --out %',
    'doctor': 'check @ --out %',
    'calibrate-camera': 'fit camera @ --view low --out %/camera.yaml',
    'evaluate': 'evaluate bundled @ --out %',
    'evaluate, checkpoint': f'evaluate @ {DEMO.parent} --out %',
    'calibrate': 'fit success bundled @ --no-store --out %',
    'train': 'train @ --out %',
    'view': 'view @ --save %/a.rrd',
    'replay': 'replay @ --offline --out %',
    'import-bag': 'import bag @ --robot yam_bimanual --out %',
    'import-dataset': 'import lerobot @ --mapping @ --out %',
    'import-videos': 'import videos @ --mapping @ --out %',
    'import-weights': 'import wan @ --preset @ --out %',
    'export-dataset': 'export lerobot @ --out %',
    'rank': 'rank --policies @ --out %',
    'recover': 'recover @ --out %',
    'imagine': 'imagine --episodes @ --out %',
    'report': 'export report @ --out %',
    'robot': 'robot @ --out %/robot.yaml',
}

#: what is wrong with a number or a name
WORDS = (
    f'foresee {DEMO} --futures 0',
    f'foresee {DEMO} --views low,low,nowhere',
    f'fit contact {DEMO.parent} --out % --motions 0',
    f'fit contact {DEMO.parent} --out % --motions 100000',
    f'fit contact {DEMO.parent} --out % --episodes 0',
    f'fit contact {DEMO.parent} --out % --episodes -1',
    f'fit contact {DEMO.parent} --out % --threads -1',
    f'train {DEMO.parent} --out % --threads -1',
    f'evaluate bundled {DEMO.parent} --out % --threads -1',
    f'fit contact {DEMO.parent} --out % --views nowhere',
    'rank --list-faults nothing',
    'rank --list-faults drawn:',
    'rank --list-faults drawn:x',
    'rank --list-faults drawn:-1',
    'rank --list-faults drawn:99999999999999999999',
    'rank --list-faults drawn:1,drawn:2',
    'rank --list-faults train,test',
    'rank --faults drawn: --out %',
    'rank --faults drawn:1e3 --out %',
    'rank --faults nothing --out %',
    'rank --physics nothing --out %',
    'collect --physics nothing --out %',
    'collect --episodes -1 --out %',
    'collect --episodes 0 --out %',
    'collect --task nothing --out %',
    'collect --robot nothing --out %',
    f'evaluate bundled {DEMO.parent} --physics nothing --out %',
    'nothing',
    'forsee x',
    'foresee',
    'rank --out % --episodes 0',
    'rank --out % --policies expert-drawn_1_0-nan',
    'rank --out % --policies expert-drawn_1_0-1e300',
    'rank --out % --policies expert-drawn_1_999999999-1',
)


def _garbage(folder: Path) -> Path:
    (folder / 'metadata.yaml').write_bytes(b'\xff\xfe' * 99)
    (folder / 'a_0.mcap').write_bytes(os.urandom(5000))
    for name in ('world_model.json', 'dataset.json', 'meta.json', 'metrics.json'):
        (folder / name).write_text('{' * 5000)
    return folder


def _cut(folder: Path) -> Path:
    (folder / 'metadata.yaml').write_bytes((DEMO / 'metadata.yaml').read_bytes())
    (folder / BAG.name).write_bytes(BAG.read_bytes()[:2000])
    return folder


def _file(name: str, data: bytes) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(data)
        return folder / name

    return make


def _loop(folder: Path) -> Path:
    (folder / 'loop').symlink_to(folder / 'loop')
    return folder / 'loop'


def _pipe(folder: Path) -> Path:
    os.mkfifo(folder / 'pipe.yaml')
    return folder / 'pipe.yaml'


def _yaml_folder(folder: Path) -> Path:
    (folder / 'x.yaml').mkdir()
    return folder / 'x.yaml'


PLACES: dict[str, Callable[[Path], Path]] = {
    'missing': lambda folder: folder / 'none',
    'empty folder': lambda folder: folder,
    'garbage in a folder': _garbage,
    'a recording that ends early': _cut,
    'empty file': _file('x', b''),
    'empty YAML': _file('x.yaml', b''),
    'binary YAML': _file('x.yaml', os.urandom(300)),
    'YAML list': _file('x.yaml', b'[1, 2, 3]\n'),
    'deep YAML': _file('x.yaml', b'[' * 5000),
    'binary bag': _file('x.mcap', os.urandom(3000)),
    'folder named YAML': _yaml_folder,
    'loop of links': _loop,
    'pipe that nobody writes to': _pipe,
    'long name': lambda folder: folder / ('a' * 300),
    'device': lambda folder: Path('/dev/zero'),
}


@cache
def _warm() -> None:
    """Import what commands need, which is not their time."""
    with suppress(SystemExit):  # which ends a command that only prints
        main(['rank', '--list-faults', 'grasp_height'])


def run(words: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    """The command ends with status 1 or 2, in time, and its last line says why."""
    _warm()
    capfd.readouterr()
    begin_s = time.process_time()
    try:
        status = main(words)
    except SystemExit as exited:
        status = exited.code
    seconds = time.process_time() - begin_s
    said = capfd.readouterr().err
    assert status in (1, 2), (status, said)
    assert 'Traceback' not in said
    last = said.strip().splitlines()[-1]
    assert len(last) > 20 and len(last) < 2000, said
    assert seconds < MOST_S


#: every fourth, so that each place and each command is among them; all of them take minutes
PAIRS = [
    (name, place)
    for i, name in enumerate(COMMANDS)
    for j, place in enumerate(PLACES)
    if (os.environ.get('MTV_WORLD_ATTACKS') == 'all' or (i + j) % 4 == 0)
]


@pytest.mark.parametrize(('name', 'place'), PAIRS)
def test_a_path_that_is_none_is_refused(
    name: str, place: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    inside, out = tmp_path / 'in', tmp_path / 'out'
    inside.mkdir()
    at = str(PLACES[place](inside))
    words = COMMANDS[name].split(' ')
    run([w.replace(AT, at).replace(OUT, str(out)) for w in words], capfd)
    left = [path for path in out.rglob('*') if path.is_file()] if out.exists() else []
    assert not [path for path in left if path.name != '.lock' and path.suffix != '.log'], left


@table('name', COMMANDS)
def test_an_empty_path_is_not_the_present_folder(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = COMMANDS[name].split(' ')
    at = words.index(AT)
    with pytest.raises(SystemExit) as end:
        main([w.replace(AT, '').replace(OUT, 'out') for w in words])
    assert end.value.code == 2
    said = capfd.readouterr().err.splitlines()[-1]
    assert 'argument ' in said and ': it is empty;' in said
    if words[at - 1].startswith('--'):
        assert words[at - 1] in said
    assert not list(tmp_path.iterdir())


@table(
    'words, option',
    [
        (['foresee', str(DEMO), '--picture='], '--picture'),
        (['collect', '--episodes', '1', '--out', ''], '--out'),
        (['evaluate', 'bundled', '', str(DEMO.parent), '--out', 'x'], 'CHECKPOINT'),
        (['imagine', '--episodes', str(DEMO), '', '--out', 'x'], '--episodes'),
        (['demo', '--checkpoint', ''], '--checkpoint'),
    ],
)
def test_an_empty_path_among_others_is_named(
    words: list[str], option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 2
    assert f'argument {option}: it is empty;' in capsys.readouterr().err


@pytest.mark.parametrize('words', WORDS)
def test_words_that_mean_nothing_are_refused(
    words: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / 'out')
    run([w.replace(AT, str(tmp_path)).replace(OUT, out) for w in words.split(' ')], capfd)
