"""Every checkpoint in the package, with every switch, beats a held first frame."""

from __future__ import annotations

from pathlib import Path

import pytest

from mtv_world_ros.core.files import share_path
from mtv_world_ros.evaluation.evaluate_episodes import evaluate
from mtv_world_ros.evaluation.settings import EvaluationConfig
from mtv_world_ros.model.card import CARD
from mtv_world_ros.rollout.pipeline import Pipeline

CHECKPOINTS = sorted(path.parent for path in share_path('resource').glob(f'*/{CARD}'))
WHOLE_EPISODE = EvaluationConfig(mode='imagine', actions=('true',), ceiling=False, seed=3)


@pytest.mark.parametrize('foresight', [True, False], ids=['foresight', 'no_foresight'])
@pytest.mark.parametrize('checkpoint', CHECKPOINTS, ids=[path.name for path in CHECKPOINTS])
def test_imagined_objects_overlap_the_true_ones_more_than_a_held_frame_does(
    checkpoint: Path, foresight: bool, tmp_path: Path
):
    pipeline = Pipeline.load(checkpoint, foresight=foresight)
    demo = share_path('resource', 'demo_episode')
    found = evaluate(pipeline, [demo], tmp_path, WHOLE_EPISODE, show_progress=False)
    scores = found.estimates(None)
    imagined, held = scores['j_moving'].value, scores['j_copy_moving'].value
    print(f'{checkpoint.name}, foresight {foresight}: J {imagined:.3f}, held {held:.3f}')
    assert imagined > held + 0.1


def test_the_package_has_the_bundled_checkpoint():
    assert share_path('resource', 'checkpoint') in CHECKPOINTS
