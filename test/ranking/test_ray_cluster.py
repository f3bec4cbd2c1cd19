"""A ranking on a Ray cluster of two nodes, one of which is killed while it runs."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.simulation.opengl import missing_opengl

cluster_utils = pytest.importorskip(
    'ray.cluster_utils', reason="Ray is not installed: pip install 'mtv_world_ros[rank]'"
)

pytestmark = pytest.mark.slow
RANK = ['rank', '--policies', 'expert,expert-miss-1', '--tasks', 'stack_blocks_two', '--episodes']
RANK += ['2', '--max-chunks', '2', '--steps', '1', '--segmenter', 'colour', '--no-video']
TIMEOUT_S = 600.0


@pytest.fixture
def cluster():
    """Two nodes of one CPU each; the environment that Ray changes is given back."""
    environment, handler = dict(os.environ), signal.getsignal(signal.SIGTERM)
    cluster = cluster_utils.Cluster(
        initialize_head=True, head_node_args={'num_cpus': 1, 'include_dashboard': False}
    )
    yield cluster
    cluster.shutdown()
    os.environ.clear()
    os.environ.update(environment)
    signal.signal(signal.SIGTERM, handler)


def results(out):
    """What the rollouts found, without their run times."""
    found = {}
    for file in sorted((out / 'rollouts').glob('*.json')):
        found[file.name] = json.loads(file.read_text())['result']
        assert found[file.name].pop('seconds')
    return found


def wait_for_a_result(out, process):
    end_s = time.monotonic() + TIMEOUT_S
    while not list((out / 'rollouts').glob('*.json')):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end_s, 'no rollout ended'
        time.sleep(0.05)


def test_the_ranking_is_complete_and_the_same_when_a_node_is_killed_in_the_middle(
    cluster, tmp_path
):
    if reason := missing_opengl():
        pytest.skip(reason)
    node = cluster.add_node(num_cpus=1)
    alone, shared = tmp_path / 'alone', tmp_path / 'shared'
    words = [*RANK, '--workers', '2', '--ray', cluster.address, '--out', str(shared)]
    process = subprocess.Popen(
        [sys.executable, '-m', 'mtv_world_ros.cli', *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        wait_for_a_result(shared, process)
        # four rollouts and two workers: each node is at one of them
        assert len(list((shared / 'rollouts').glob('*.json'))) < 3
        cluster.remove_node(node, allow_graceful=False)
        said, _ = process.communicate(timeout=TIMEOUT_S)
    finally:
        process.kill()
    assert process.returncode == 0, said
    assert said.count('a Ray worker died; 1 go on') == 1, said
    assert main([*RANK, '--out', str(alone)]) == 0
    assert len(results(shared)) == 4
    assert results(shared) == results(alone)
