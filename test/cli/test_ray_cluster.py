"""Commands on a Ray cluster of two nodes with GPUs, one of which is killed while they run."""

from __future__ import annotations

from collections.abc import Iterator
import json
from pathlib import Path
import shutil
import subprocess
import sys
import time
from typing import Any

import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.core.files import share_path
from mtv_world_ros.simulation.opengl import missing_opengl

cluster_utils = pytest.importorskip(
    'ray.cluster_utils', reason="Ray is not installed: pip install 'mtv_world_ros[rank]'"
)

pytestmark = pytest.mark.slow
TIMEOUT_S = 600.0
#: runs of a command until a node is killed in its middle
MOST_TRIES = 3
TASK = 'stack_blocks_two'
MODEL = ['--steps', '1', '--segmenter', 'colour', '--threads', '1']
#: command, pattern of the files of its results, and how many there are in the end
COMMANDS = {
    'collect': (
        ['collect', '--task', TASK, '--episodes', '4', '--width', '96', '--height', '72'],
        '*/metadata.yaml',
        4,
    ),
    'evaluate': (
        ['evaluate', 'bundled', 'DATA', '--split', 'all', '--actions', 'true', '--no-ceiling',
         '--no-report', *MODEL],
        'episodes/*.json',
        6,
    ),
    'imagine': (
        ['imagine', '--policy', 'recorded', '--episodes', 'DATA', '--count', '12',
         '--max-chunks', '1', '--no-video', *MODEL],
        'episode_*/metadata.yaml',
        12,
    ),
    'rank': (
        ['rank', '--policies', 'expert,expert-miss-1', '--tasks', TASK, '--episodes', '2',
         '--max-chunks', '2', '--no-video', *MODEL],
        'rollouts/*.json',
        4,
    ),
}  # fmt: skip


@pytest.fixture(scope='module')
def cluster(own_ray: None) -> Iterator[Any]:
    """A node of one CPU and one logical GPU."""
    cluster = cluster_utils.Cluster(
        initialize_head=True,
        head_node_args={'num_cpus': 1, 'num_gpus': 1, 'include_dashboard': False},
    )
    yield cluster
    cluster.shutdown()


@pytest.fixture(scope='module')
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six recorded episodes."""
    folder = tmp_path_factory.mktemp('data')
    for index in range(6):
        shutil.copytree(share_path('resource', 'demo_episode'), folder / f'{TASK}_{index:05d}')
    return folder


def without_times(value: Any) -> Any:
    """Return JSON without run times and places."""
    if isinstance(value, list):
        return [without_times(one) for one in value]
    if not isinstance(value, dict):
        return value
    apart = ('seconds', 'seconds_per_chunk', 'episode_s', 'total_s', 'bag', 'path', 'donor')
    return {key: without_times(one) for key, one in value.items() if key not in apart}


def results(out: Path, pattern: str) -> dict[str, Any]:
    """Return what a command found, by the file's name."""
    if pattern.endswith('metadata.yaml'):
        bags = {str(f.parent.relative_to(out)): bag_bytes(f.parent) for f in out.glob(pattern)}
        lists = [out / 'episodes.json', out / 'dataset.json']
        found = {f.name: without_times(json.loads(f.read_text())) for f in lists if f.is_file()}
        assert found
        return {**bags, **found}
    return {f.name: without_times(json.loads(f.read_text())) for f in out.glob(pattern)}


def bag_bytes(bag: Path) -> list[bytes]:
    """Return the recorded messages of a bag, without those that hold run times."""
    from rosbags.rosbag2 import Reader

    with Reader(bag) as reader:
        return [
            bytes(data)
            for connection, _, data in reader.messages()
            if connection.msgtype != 'diagnostic_msgs/msg/DiagnosticArray'
        ]


def num_started(cluster: Any) -> int:
    """Return the number of workers that have loaded what they run, on all nodes."""
    return len(cluster.global_state.actor_table(None, None, 'ALIVE'))


def run_and_kill(cluster: Any, words: list[str], out: Path, pattern: str, count: int) -> str:
    """Run a command on two nodes, kill one after the first result; return what it prints.

    Nothing is killed, and the text is empty, where the second worker started so late that the
    first one had nearly all results.
    """
    node = cluster.add_node(num_cpus=1, num_gpus=1)
    cluster.wait_for_nodes()  # until Ray has noticed that the last killed one is gone
    process = subprocess.Popen(
        [sys.executable, '-m', 'mtv_world_ros.cli', *words, '--out', str(out), '--workers', '2',
         '--ray', cluster.address, '--gpus-per-worker', '1'],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    try:
        end_s = time.monotonic() + TIMEOUT_S
        # two workers that have started: the killed node is at a job, or about to get one
        while not list(out.glob(pattern)) or num_started(cluster) < 2:
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < end_s, 'there is no result'
            time.sleep(0.05)
        is_early = len(list(out.glob(pattern))) < count - 1
        cluster.remove_node(node, allow_graceful=False)
        if not is_early:
            return ''
        said, _ = process.communicate(timeout=TIMEOUT_S)
    finally:
        process.kill()
    assert process.returncode == 0, said
    return said


@pytest.mark.parametrize('name', COMMANDS)
def test_results_are_complete_and_the_same_when_a_node_is_killed_in_the_middle(
    name: str, cluster: Any, data: Path, tmp_path: Path
) -> None:
    if name in ('collect', 'rank') and (reason := missing_opengl()):
        pytest.skip(reason)
    command, pattern, count = COMMANDS[name]
    words = [str(data) if word == 'DATA' else word for word in command]
    alone = tmp_path / 'alone'
    for number in range(MOST_TRIES):
        shared = tmp_path / f'shared_{number}'
        if said := run_and_kill(cluster, words, shared, pattern, count):
            break
    assert said.count('a Ray worker died; 1 go on') == 1, said
    assert main([*words, '--out', str(alone)]) == 0
    assert len(list(shared.glob(pattern))) == count
    assert results(shared, pattern) == results(alone, pattern)
    assert not list(shared.glob('.*_*'))  # of the worker that died


#: `mtv-world`, whose fit of contact draws little
FIT_OF_FEW_DRAWS = """import sys
from mtv_world_ros.cli import main
from mtv_world_ros.physics.fitting import contact_fit
contact_fit._FIT = contact_fit.ContactFitSettings(num_draws=16, num_rounds=2)
sys.exit(main(sys.argv[1:]))
"""


def test_contact_is_fitted_alike_by_processes_and_on_ray(cluster: Any, tmp_path: Path) -> None:
    if reason := missing_opengl():
        pytest.skip(reason)
    data = tmp_path / 'data'
    size = ['--width', '96', '--height', '72', '--failures-of-ten', '0']
    assert main(['collect', '--task', TASK, '--episodes', '2', *size, '--out', str(data)]) == 0
    ways = {
        'one': [],
        'two': ['--workers', '2'],
        'ray': ['--workers', '1', '--ray', cluster.address, '--gpus-per-worker', '1'],
    }
    found = []
    for name, words in ways.items():
        out = tmp_path / name
        # in a process of its own: Ray keeps the token of a cluster that this one used before
        command = ['fit', 'contact', str(data), '--checkpoint', str(out), *words]
        run = subprocess.run(
            [sys.executable, '-c', FIT_OF_FEW_DRAWS, *command], capture_output=True, text=True
        )
        assert run.returncode == 0, run.stdout + run.stderr
        found.append(json.loads((out / 'object_motion' / 'contact.json').read_text()))
    assert found[0] == found[1] == found[2]


@pytest.mark.parametrize(
    ('words', 'said'),
    [
        (['--gpus-per-worker', '2', '--ray'], 'asks for 1 CPU cores and 2 GPUs, which no machine'),
        (['--gpus-per-worker', '1'], '--gpus-per-worker 1 is for --ray; leave it out'),
        (['--cpus-per-worker', '-1', '--ray'], '--cpus-per-worker is -1; it must be 0 or more'),
    ],
)
def test_resources_that_cannot_be_had_are_an_error(
    words: list[str],
    said: str,
    cluster: Any,
    data: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = [*words, cluster.address] if words[-1] == '--ray' else words
    command = ['imagine', '--policy', 'recorded', '--episodes', str(data), *MODEL, *words]
    assert main([*command, '--out', str(tmp_path / 'out')]) == 1
    assert said in capsys.readouterr().err
