"""Which objects are drawn and scored: named by a describer, by the episode, by the instruction."""

import csv

import numpy as np
import pytest

from mtv_world_ros.core.data_types import ByteArray
from mtv_world_ros.core.errors import DescriptionError
from mtv_world_ros.evaluation.evaluate_episodes import evaluate
from mtv_world_ros.vision.describers.describer import DescribedObject


class Reader:
    """Names what it is told to, and remembers what it was shown."""

    def __init__(self, *names: str, error: DescriptionError | None = None) -> None:
        self.names, self.error, self.shown = names, error, []

    def describe(self, first_frame: ByteArray, instruction: str) -> tuple[DescribedObject, ...]:
        self.shown.append((first_frame, instruction))
        if self.error:
            raise self.error
        return tuple(DescribedObject(id=str(i), name=name) for i, name in enumerate(self.names, 1))


def _names(out) -> set[str]:
    rows = csv.DictReader((out / 'rows.csv').open())
    return {row['name'] for row in rows} - {'(union)'}


def _run(pipeline, episodes, out, **options):
    return evaluate(pipeline, episodes, out, show_progress=False, **options)


def test_described_objects_are_scored_and_the_others_are_not(make_pipeline, episodes, tmp_path):
    reader = Reader('blue block')
    _run(make_pipeline(), episodes, tmp_path, describer=reader)
    assert _names(tmp_path) == {'blue block'}
    frame, instruction = reader.shown[0]
    # a recorded frame at its own size, and what the robot was told
    assert frame.shape == (48, 64, 3) and np.ptp(frame) > 100
    assert instruction.startswith('place the red block')


def test_without_a_describer_the_episode_names_them(make_pipeline, episodes, tmp_path):
    _run(make_pipeline(), episodes, tmp_path)
    assert _names(tmp_path) == {'red block', 'blue block'}


def test_objects_are_drawn_into_the_trajectory_video_as_they_are_scored(
    make_pipeline, episodes, tmp_path
):
    drawn = {}
    for name in ('red block', 'blue block'):
        pipeline = make_pipeline()
        seen, predict = [], pipeline.world_model.predict
        pipeline.world_model.predict = lambda start, inputs, seen=seen, predict=predict, **rest: (
            seen.append(inputs) or predict(start, inputs, **rest)
        )
        _run(pipeline, episodes[:1], tmp_path / name, describer=Reader(name))
        drawn[name] = np.concatenate([inputs.video[:, 0] for inputs in seen])
    assert (drawn['red block'] != drawn['blue block']).any()


@pytest.mark.parametrize(
    ('reader', 'reason'),
    [
        (
            Reader(error=DescriptionError('no server at localhost:1', 'unreachable')),
            'its objects could not be named (unreachable): no server at localhost:1',
        ),
        (Reader(), 'no object was seen in its first frame'),
    ],
)
def test_an_episode_without_names_is_listed_with_the_reason(
    make_pipeline, episodes, tmp_path, reader, reason
):
    half = Reader('red block')
    turn = iter((reader, half, half))

    class Mixed:
        def describe(self, first_frame, instruction):
            return next(turn).describe(first_frame, instruction)

    summary = _run(make_pipeline(), episodes, tmp_path, describer=Mixed())
    assert list(summary.failed.values()) == [reason]
    assert reason.split('(')[0] in (tmp_path / 'tables.md').read_text()
    assert len(summary.results) == 2
