"""Pairs of clips that show one scene, in an episode that failed and one that succeeded."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import ModuleType

import pytest

from mtv_world_ros.core.errors import TrainingError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.recording import load_recording, Recording
from mtv_world_ros.training.clips.episode_index import IndexedEpisode
from mtv_world_ros.training.training_config import load_training_config
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter
from test.support.scripts import imported_scripts

CONFIG = load_training_config('paper', {'optimizer.batch_size': 4})


@pytest.fixture(scope='module')
def module() -> Iterator[ModuleType]:
    with imported_scripts('twins') as (script,):
        yield script


@pytest.fixture(scope='module')
def made(robot) -> Recording:
    return load_recording(share_path('resource', 'demo_episode'), CONFIG.spec, robot)


def failed(made: Recording, end: int, moved_m: float = 0.0) -> Recording:
    """The same scene in an episode of `end` frames whose arms do something else."""
    assert made.object_poses is not None and made.object_ids is not None
    poses = made.object_poses[:end].copy()
    poses[:, 0, 0, 3] += moved_m
    return replace(
        made,
        outcome='failure',
        times=made.times[:end],
        frames=made.frames[:, :end],
        object_ids=made.object_ids[:, :end],
        positions=made.positions[:end] + 0.1,
        commands=replace(made.commands, positions=made.commands.positions + 0.1),
        object_poses=poses,
    )


def test_twins_show_one_scene_at_one_time_and_go_apart(module, made, robot):
    short = failed(made, len(made.times) - 4)
    options = {'robot': robot, 'segmenter': ColourSegmenter(), 'seed': 3}
    source = module.TwinSource([made, short], CONFIG, **options)
    (pair,) = source._pairs
    assert [one.outcome for one in pair] == ['failure', 'success']
    assert pair[0].starts == pair[1].starts == IndexedEpisode.of(short, CONFIG.spec, 0.0).starts
    for step in range(3):
        batch = source.batch(step)
        for first in (0, 2):
            one, other = batch.frames[first], batch.frames[first + 1]
            assert (one == other).all() and one.numpy().std() > 1
            assert (batch.start_frame[first] == batch.start_frame[first + 1]).all()
            videos = batch.inputs.video[first], batch.inputs.video[first + 1]
            assert (videos[0] != videos[1]).any()
        assert (batch.frames[0] != batch.frames[2]).any()
    source.close()


def test_scenes_whose_objects_lie_elsewhere_or_that_never_failed_are_no_twins(module, made, robot):
    options = {'robot': robot, 'segmenter': ColourSegmenter(), 'seed': 3}
    for others in ([], [failed(made, len(made.times), moved_m=0.01)], [made]):
        with pytest.raises(TrainingError, match='no two show one scene'):
            module.TwinSource([made, *others], CONFIG, **options)
    unposed = replace(failed(made, len(made.times)), object_poses=None)
    with pytest.raises(TrainingError, match='no two show one scene'):
        module.TwinSource([made, unposed], CONFIG, **options)
