"""A process that is lost while latents are encoded by several: what was encoded stays."""

from __future__ import annotations

import os
from pathlib import Path
import re
import signal
import subprocess
import time

import pytest
import yaml

from mtv_world_ros.model.card import read_card
from mtv_world_ros.training.training_config import load_training_config
from test.support.launched import rank_pid, start_torchrun, torchrun
from test.support.wan_base import make_base, tiny_preset

#: clips for both processes
QUICK = {'width': 64, 'height': 64, 'clip_stride_s': 0.8}
#: pictures that take some time to encode, and a clip from nearly every frame
SLOW = {'width': 160, 'height': 128, 'clip_stride_s': 0.2}
#: runs a command; in process 1 every file of a folder meets a full disk, which has no inode left
FULL_IN_ONE = """#!/bin/sh
folder=$1
shift
if [ "$RANK" = 1 ]; then
    mounted='mount -t tmpfs -o nr_inodes=1 tmpfs "$0" && exec "$@"'
    exec unshare --mount sh -c "$mounted" "$folder" "$@"
fi
exec "$@"
"""


def words_of(episode: Path, folder: Path, video: dict[str, float]) -> list[str]:
    """A training of one step with a latent cache, without the folders that it writes."""
    preset = tiny_preset(folder)
    values = yaml.safe_load(preset.read_text())
    values['video'] |= video
    values['optimizer']['steps'] = 1
    preset.write_text(yaml.safe_dump(values))
    base = make_base(folder, load_training_config(preset))
    options = ['--preset', str(preset), '--init', str(base), '--threads', '1']
    return ['train', str(episode), *options, '--peak-tflops', '1', '--dtype', 'float32']


def shards(latents: Path) -> set[str]:
    """Return the numbers of the processes that have written a shard."""
    return {file.name.split('-')[1] for file in latents.rglob('*.safetensors')}


def cpu_s(pid: int) -> float:
    """Return the CPU time of a process [s]."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def check_goes_on(words: list[str], out: Path) -> None:
    """The same command encodes the rest, and trains."""
    status, said, errors = torchrun(2, words)
    assert status == 0, errors
    found = re.search(r'(\d+) of (\d+) clips were there, (\d+) encoded by 2', said + errors)
    assert found, errors
    held, count, encoded = map(int, found.groups())
    assert held > 0 and held + encoded == count
    assert read_card(out / 'adapter').trained_on['clips'] == count


@pytest.mark.slow
def test_a_disk_that_is_full_in_one_process_is_named_and_the_others_clips_stay(episode, tmp_path):
    if os.geteuid() != 0 or subprocess.run(['unshare', '--mount', 'true']).returncode:
        pytest.skip('only root can mount a disk for one process')
    out, latents, program = tmp_path / 'out', tmp_path / 'latents', tmp_path / 'full_in_one'
    latents.mkdir()
    program.write_text(FULL_IN_ONE)
    program.chmod(0o755)
    words = words_of(episode, tmp_path, QUICK)
    words += ['--out', str(out), '--latent-cache', str(latents)]
    status, said, errors = torchrun(2, words, through=[str(program), str(latents)])
    assert status == 1, errors
    assert f"latent cache '{latents}" in errors and 'No space left on device' in errors
    assert 'rank      : 1' in errors.partition('Root Cause')[2], errors
    assert 'latent_cache.py' not in errors and 'adapter for' not in said
    assert shards(latents) == {'000'}
    check_goes_on(words, out)


@pytest.mark.slow
def test_a_process_killed_while_it_encodes_is_named_and_the_others_clips_stay(episode, tmp_path):
    out, latents, end_s = tmp_path / 'out', tmp_path / 'latents', time.monotonic() + 600
    words = words_of(episode, tmp_path, SLOW)
    words += ['--out', str(out), '--latent-cache', str(latents)]
    with start_torchrun(2, words) as launcher:
        while not latents.exists():  # made when a clip is encoded
            assert launcher.poll() is None and time.monotonic() < end_s
            time.sleep(0.01)
        pid = rank_pid(launcher.pid, 0)
        until_s = cpu_s(pid) + 1.5  # a few clips
        while cpu_s(pid) < until_s and not shards(latents):
            time.sleep(0.01)
        assert not shards(latents)  # it encodes
        os.kill(rank_pid(launcher.pid, 1), signal.SIGKILL)
        _, errors = launcher.communicate(timeout=600)
    assert launcher.returncode != 0
    assert 'rank      : 1' in errors.partition('Root Cause')[2], errors
    assert shards(latents) == {'000'} and not out.joinpath('adapter').exists()
    check_goes_on(words, out)
