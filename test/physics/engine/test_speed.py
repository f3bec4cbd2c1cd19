"""A chunk takes no longer than what keeps the three figures of 22 November 2026, on any machine.

Those are .37, .44 and .46 s from a plan to its verdict, at a plan every 4 s, 1 Hz and 5 Hz, on two
quiet cores (`experiments/foresight.py`). Tests run on busy and unlike machines, so what counts
here is the processor's time of one thread, against that of a computation that never changes:
steps of an engine, and layers of a network.
"""

from __future__ import annotations

import time

import mujoco
import numpy as np
import pytest
import torch

from mtv_world_ros.core.data_types import JointTrajectory
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline

#: turns, of which the fastest counts: other work only ever makes one slower
TURNS = 6
#: a chunk of 3.2 s in units of the computation. It took 20.8 (.8 s) when it took .44 of what one
#: of the tag v0.1.0 does (`experiments/foresight_engines.py --chunks`), which needs .64, .82 and
#: .87 s from plan to verdict; the figures are .53 of those and more, and lost from here on
MOST_UNITS = 24.5
BOXES = ''.join(
    f'<body pos="{0.02 * (k % 3)} 0 {0.021 + 0.041 * k}"><freejoint/><geom type="box" '
    'size=".02 .02 .02"/></body>'
    for k in range(8)
)


@pytest.fixture
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def calibrating() -> float:
    """Seconds of the processor that the computation takes."""
    xml = f'<mujoco><worldbody><geom type="plane" size="1 1 .1"/>{BOXES}</worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    picture, kernel = torch.ones(1, 64, 48, 64), torch.ones(64, 64, 3, 3)
    begun = time.process_time()
    for _ in range(500):
        mujoco.mj_step(model, data)
    with torch.no_grad():
        for _ in range(10):
            torch.nn.functional.conv2d(picture, kernel, padding=1)
    return time.process_time() - begun


@pytest.mark.slow
def test_a_chunk_takes_no_longer_than_the_floors_allow(one_thread, record_property):
    pipeline = Pipeline.load('bundled', num_threads=1, dtype='float32')  # all machines have it
    recording = load_recording(
        share_path('resource', 'demo_episode'), pipeline.spec, pipeline.robot
    )
    commands, seconds = recording.commands, pipeline.spec.chunk_seconds
    kept = (commands.times > 1e-6) & (commands.times <= seconds)
    plan = JointTrajectory(
        joint_names=commands.joint_names,
        times=commands.times[kept],
        positions=commands.positions[kept],
    )
    units, chunks = [], []
    for _ in range(TURNS):
        units.append(calibrating())
        episode = pipeline.begin(
            recording.observation(0), RolloutOptions(instruction=recording.instruction)
        )
        begun = time.process_time()
        (chunk,) = episode.extend(plan)
        chunks.append(time.process_time() - begun)
    taken = min(chunks[1:]) / min(units)
    print(f'a chunk takes {taken:.1f} units, {min(chunks):.3f} s of the processor')
    assert np.isfinite(chunk.success.probability)
    assert taken < MOST_UNITS
