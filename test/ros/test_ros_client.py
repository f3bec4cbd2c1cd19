"""The client of one screen: what it sends is taken, and what comes of it is printed."""

from pathlib import Path
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parents[2]
CLIENT = ROOT / 'examples' / 'ros_client.py'


def run_client(ros, timeout_s=300):
    done = subprocess.run(
        [sys.executable, str(CLIENT)],
        env=ros.ENVIRONMENT, cwd=ROOT, capture_output=True, text=True, timeout=timeout_s,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_plan_gets_a_verdict_with_its_reason_and_frames_of_all_views(tmp_path, ros):
    process = ros.start_node(tmp_path, 'pace:=burst')
    try:
        said = run_client(ros)
    finally:
        assert process.stop() == 0, process.output()
    first, last = said.splitlines()
    assert first.startswith('success ') and first.partition(': ')[2], said
    # the first plan has 3.2 s: 16 frames at 5 Hz
    assert last == "frames: {'low': 16, 'high': 16}", said


@pytest.mark.slow
def test_the_bundled_model_answers_a_client_that_does_not_wait_for_it(tmp_path, ros):
    program = ('-m', 'mtv_world_ros.ros.world_model.node')
    calibration = ROOT / 'resource' / 'demo_episode' / 'calibration.yaml'
    parameters = ('place:=simulator/nominal', f'calibration_file:={calibration}')
    process = ros.start_node_process(tmp_path, *parameters, program=program)
    try:
        said = run_client(ros)
    finally:
        process.stop()
    assert 'of 16 foreseen motions' in said and "frames: {'low': 16, 'high': 16}" in said
