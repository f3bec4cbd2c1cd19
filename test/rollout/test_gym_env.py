"""Imagination as an environment of Gymnasium: its own checker passes; rejected actions say why."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('gymnasium', reason="gymnasium is not installed (pip install '.[gym]')")

from gymnasium.utils.env_checker import check_env

from mtv_world_ros.core.data_types import WorldModelSpec
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.rollout.gym_env import WorldEnv
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.world import ImaginedWorld
from test.support.pipelines import assembled
from test.support.small_episodes import PersistenceWorldModel

SPEC = WorldModelSpec(
    views=('low', 'high'), fps=5.0, num_frames=8, width=64, height=48, robot='yam_bimanual'
)
YAM = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))


class SeededWorldModel(PersistenceWorldModel):
    """Holds the start frame, with noise of the seed in a corner."""

    def predict(self, start_frame, inputs, *, seed, **options):
        frames = super().predict(start_frame, inputs, seed=seed, **options)
        frames[:, :, :8, :8] = np.random.default_rng(seed).integers(256, size=(8, 8, 3))
        return frames


@pytest.fixture
def env() -> WorldEnv:
    recording = load_recording(share_path('resource', 'demo_episode'), SPEC, YAM)
    card = Checkpoint.open().card.replace(rendering={})
    pipeline = assembled(card, SeededWorldModel(SPEC), YAM)
    options = RolloutOptions(instruction=recording.instruction)
    world = ImaginedWorld(pipeline, recording.observation(0), options)
    return WorldEnv(world, YAM, max_steps=3, render_mode='rgb_array')


def test_gymnasiums_own_checker_passes(env):
    check_env(env, skip_render_check=False)


def test_an_action_moves_the_joints_where_it_says_within_a_chunk(env):
    state, info = env.reset(seed=4)
    assert info['instruction'] and state['low'].shape == env.observation_space['low'].shape
    target = state['joint_positions'].copy()
    target[0] += 0.2
    after, reward, terminated, truncated, _ = env.step(target.astype(np.float32))
    np.testing.assert_allclose(after['joint_positions'], target, atol=1e-6)
    assert (reward, terminated, truncated) == (0.0, False, False)
    assert not np.array_equal(after['low'], state['low'])
    assert np.array_equal(env.render(), np.concatenate([after['low'], after['high']], axis=1))


def test_an_action_that_is_too_fast_is_not_executed_and_says_why(env):
    state, _ = env.reset(seed=4)
    fast = WorldEnv(env._world, YAM, action_s=0.02)
    fast.reset(seed=4)
    target = state['joint_positions'].copy()
    target[0] = max(YAM.lower[0], YAM.upper[0], key=lambda end: abs(end - target[0]))
    after, reward, terminated, truncated, info = fast.step(target.astype(np.float32))
    assert 'left_joint1' in info['rejected'] and truncated and not terminated and reward == 0.0
    np.testing.assert_array_equal(after['joint_positions'], state['joint_positions'])


def test_an_episode_is_truncated_after_the_last_step(env):
    state, _ = env.reset(seed=0)
    hold = state['joint_positions'].astype(np.float32)
    assert [env.step(hold)[3] for _ in range(3)] == [False, False, True]
    env.reset(seed=0)
    assert not env.step(hold)[3]
