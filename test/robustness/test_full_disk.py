"""Every command that writes, on a full disk: one line, status 1, and no half written result."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
import os
from pathlib import Path
import subprocess

import pytest
import yaml

from mtv_world_ros.cli import main
from mtv_world_ros.core.files import share_path
from mtv_world_ros.inspection import inspect
from mtv_world_ros.inspection.camera_pose import CameraEstimate
from mtv_world_ros.inspection.cameras.fixed_camera import FixedCamera
from mtv_world_ros.inspection.motion_residual import ResidualSearch
from robustness.interrupts import ONE_STEP, settings
from test.support.tiers import rest_slow
from test.support.wan_files import AUTOENCODER, SCHEDULER, TRANSFORMER, write_videox

EPISODE = share_path('resource', 'demo_episode')
URDF = share_path('config', 'robots', 'yam_bimanual', 'yam_bimanual.urdf')
QUICK = ResidualSearch(max_pairs=5, lags_s=(0.0,), rolls_deg=(), zooms=())
SETTINGS = settings(2)

#: command -> its words, of the folder on the full disk
WRITERS: dict[str, Callable[[Path], list[str]]] = {
    'doctor': lambda out: ['check', str(EPISODE), '--out', str(out / 'doctor')],
    'robot': lambda out: ['robot', str(URDF), '--out', str(out / 'a.yaml')],
    'robot picture': lambda out: ['robot', 'yam_bimanual', '--picture', str(out / 'a.png')],
    'calibrate-camera': lambda out: [
        'fit', 'camera', str(EPISODE), '--view', 'low', '--out', str(out / 'camera.yaml')],
    'replay': lambda out: ['replay', str(EPISODE), '--offline', '--out', str(out / 'replay')],
    'train': lambda out: [
        'train', str(EPISODE.parent), '--out', str(out / 'run'), '--dtype', 'float32',
        '--threads', '1', *SETTINGS],
    'export-dataset': lambda out: [
        'export', 'lerobot', str(EPISODE), '--out', str(out / 'dataset')],
    'import-bag': lambda out: [
        'import', 'bag', str(EPISODE), '--robot', 'yam_bimanual', '--out', str(out / 'episodes')],
    'view': lambda out: ['view', str(EPISODE), '--save', str(out / 'a.rrd')],
    'recover': lambda out: ['recover', str(EPISODE), '--out', str(out / 'bag')],
    'collect': lambda out: [
        'collect', '--task', 'stack_blocks_two', '--episodes', '1', '--out', str(out / 'set')],
    'evaluate': lambda out: [
        'evaluate', 'bundled', str(EPISODE.parent), '--actions', 'true', '--no-ceiling',
        '--out', str(out / 'evaluation'), *ONE_STEP],
    'calibrate': lambda out: [
        'fit', 'success', 'bundled', str(EPISODE.parent), '--no-store',
        '--out', str(out / 'calibration'), *ONE_STEP],
    'rank': lambda out: [
        'rank', '--policies', 'expert,expert-miss-0.5', '--tasks', 'stack_blocks_two',
        '--episodes', '1',
        '--max-chunks', '1', '--out', str(out / 'ranking'), *ONE_STEP],
    'demo': lambda out: ['demo', '--out', str(out / 'demo'), *ONE_STEP],
    'imagine': lambda out: [
        'imagine', '--episodes', str(EPISODE), '--out', str(out / 'imagined'), *ONE_STEP],
}  # fmt: skip

#: writers of each kind of output that are quick: YAML, pictures, Rerun files, bags
FAST_WRITERS = ['robot', 'robot picture', 'view', 'import-bag', 'recover']


@pytest.fixture
def full_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 32 kB with nothing left."""
    disk = tmp_path / 'disk'
    disk.mkdir()
    if os.geteuid() != 0:
        pytest.skip('only root can mount a small disk')
    mount = ['mount', '-t', 'tmpfs', '-o', 'size=32k', 'tmpfs', str(disk)]
    if subprocess.run(mount, capture_output=True).returncode:
        pytest.skip('no small disk can be mounted here')
    try:
        (disk / 'others').write_bytes(bytes(32 * 1024))
        yield disk
    finally:
        subprocess.run(['umount', '-l', str(disk)], check=True)


def _as_guessed(camera: FixedCamera, **options: object) -> CameraEstimate:
    """In place of a search of a minute, whose result is written like any other."""
    return CameraEstimate(camera=camera.camera, std_mm=1.0, std_deg=0.1, evidence='none')


@pytest.fixture(scope='module')
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], list[str]]:
    """Make the input of a command of `PREPARED`, once; return the command."""

    @cache
    def words(name: str) -> list[str]:
        make, _ = PREPARED[name]
        return make(tmp_path_factory.mktemp('input'))

    return words


def _dataset(folder: Path) -> list[str]:
    """Make a LeRobot dataset; the command that imports it."""
    assert main(['export', 'lerobot', str(EPISODE), '--out', str(folder)]) == 0
    return ['import', 'lerobot', str(folder), '--mapping', str(folder / 'meta' / 'mapping.yaml')]


def _weights(folder: Path) -> list[str]:
    """Make small weights in the public layout; the command that imports them."""
    public = write_videox(folder / 'public')
    preset, video = folder / 'tiny.yaml', {'num_frames': 4, 'width': 32, 'height': 32}
    sections = {'transformer': TRANSFORMER, 'autoencoder': AUTOENCODER, 'scheduler': SCHEDULER}
    preset.write_text(yaml.safe_dump({**sections, 'video': video}))
    return ['import', 'wan', str(public), '--preset', str(preset)]


def _evaluation(folder: Path) -> list[str]:
    """Evaluate without a report; the command that writes it."""
    words = ['--actions', 'true', '--no-ceiling', '--no-report', '--out', str(folder), *ONE_STEP]
    assert main(['evaluate', 'bundled', str(EPISODE.parent), *words]) == 0
    return ['export', 'report', str(folder)]


#: what makes the input of a command on another disk and returns the command, and the output's name
PREPARED = {
    'import-dataset': (_dataset, 'episodes'),
    'import-weights': (_weights, 'checkpoint'),
    'report': (_evaluation, 'report.html'),
}


@pytest.mark.parametrize('name', rest_slow(WRITERS, FAST_WRITERS))
def test_a_full_disk_is_one_line_and_leaves_nothing_half_written(
    name: str, full_disk: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(full_disk.parent)
    monkeypatch.setattr(FixedCamera, 'estimate', _as_guessed)
    monkeypatch.setattr(inspect, 'load_inspector', partial(inspect.load_inspector, search=QUICK))
    check_refused(WRITERS[name](full_disk), full_disk, capfd)


@pytest.mark.parametrize(
    'name', rest_slow(['train', 'rank', 'import-bag', 'collect', 'export-dataset'], ['import-bag'])
)
def test_a_disk_that_fills_up_in_the_middle_is_one_line(
    name: str, full_disk: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (full_disk / 'others').unlink()
    words = WRITERS[name](full_disk)
    for _ in range(2):  # and when it is run again
        status = main(words)
        said = capfd.readouterr().err.splitlines()
        assert status == 1, said
        assert 'Traceback (most recent call last):' not in said
        (line,) = errors_in(said)
        assert any(word in line for word in ('No space left', 'os error 28', 'disk full')), said


@pytest.mark.parametrize('is_full', [True, False], ids=['full', 'fills_up'])
@pytest.mark.parametrize('name', rest_slow(PREPARED, list(PREPARED)[:1]))
def test_a_disk_that_is_full_or_fills_up_keeps_no_part_of_an_import_or_a_report(
    name: str,
    is_full: bool,
    full_disk: Path,
    prepared: Callable[[str], list[str]],
    capfd: pytest.CaptureFixture[str],
) -> None:
    words, (_, out) = prepared(name), PREPARED[name]
    capfd.readouterr()
    if not is_full:
        (full_disk / 'others').unlink()
    check_refused([*words, '--out', str(full_disk / out)], full_disk, capfd)


def errors_in(said: list[str]) -> list[str]:
    """Return the lines of a command that name an error, not those that say that it loads."""
    return [
        line
        for line in said
        if line.startswith(('mtv-world: ', 'episode 0: ')) and ': loading' not in line
    ]


def check_refused(words: list[str], disk: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The command ends with status 1 and one line about the disk, and leaves no result on it."""
    status = main(words)
    said = capfd.readouterr().err.splitlines()
    assert status == 1, said
    assert 'Traceback (most recent call last):' not in said
    (line,) = errors_in(said)
    assert any(word in line for word in ('No space left', 'os error 28', 'disk full')), said
    left = {path.name for path in disk.rglob('*') if path.is_file()}
    locks = {name for name in left if name == '.lock' or name.endswith('.mtv-lock')}
    assert left - locks <= {'others'}
