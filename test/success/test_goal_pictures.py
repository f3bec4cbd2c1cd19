"""Tasks whose goal is a picture: of the task done, or of a painted region."""

import cv2
from drawn_blocks import BLUE, CAMERAS, footage, LEFT, masks, NAMES, path, RED
import numpy as np
import pytest
import yaml

from mtv_world_ros.assembly import assemble, assemble_segmenter, checkpoint_robot
from mtv_world_ros.errors import ConfigError
from mtv_world_ros.files import share_path
from mtv_world_ros.model.card import read_card
from mtv_world_ros.success.estimator import SuccessEstimator
from mtv_world_ros.success.task import load_task
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter, PALETTE

GOAL = (-0.1, 0.32, 0.025)
SAID = 'put the red block where it belongs'
SCALE = 4


def painted(at):
    """(V, H, W, 3) RGB pictures of both blocks, four times as large as the views."""
    shown = masks([at], [BLUE]).masks[:, :, 0]
    pictures = np.full((*shown[:, 0].shape, 3), 170, np.uint8)
    for item, name in enumerate(NAMES):
        pictures[shown[:, item]] = PALETTE[name.split()[0]]
    return pictures.repeat(SCALE, axis=1).repeat(SCALE, axis=2)


def write_task(folder, relation, views=('low', 'high'), pictures=None, **changes):
    """A task file with its pictures beside it, of the block at its goal."""
    key = 'regions' if relation == 'in_region' else 'pictures'
    if pictures is None:
        pictures = painted(GOAL)
    for camera, picture in zip(CAMERAS, pictures, strict=True):
        cv2.imwrite(str(folder / f'{camera.view}.png'), picture[..., ::-1])
    values = {
        'name': 'put_away',
        'instruction': 'put the {a} where it belongs',
        'relations': [
            {
                'kind': relation,
                'subject': 'a',
                key: {view: f'{view}.png' for view in views},
                **changes,
            }
        ],
    }
    file = folder / 'put_away.yaml'
    file.write_text(yaml.safe_dump(values))
    return file


def regions(reach=10):
    """White about the goal in both views."""
    goal = masks([GOAL], [BLUE]).masks[:, 0, 0].astype(np.uint8)
    wide = [cv2.dilate(mask, np.ones((reach, reach), np.uint8)) for mask in goal]
    return np.repeat(np.array(wide, np.uint8)[..., None] * 255, 3, axis=-1)


def judge(file, end, segmenter=None):
    estimator = SuccessEstimator(
        [load_task(file)], task='put_away', segmenter=segmenter or ColourSegmenter()
    )
    rollout = masks(path(RED, end), [BLUE] * 9)
    return estimator.estimate(footage(rollout, masks([RED], [BLUE])), SAID).estimate


@pytest.mark.parametrize('views', [('low', 'high'), ('high',)])
def test_block_where_the_picture_has_it_is_a_success_and_elsewhere_none(tmp_path, views):
    file = write_task(tmp_path, 'as_pictured', views)
    there = judge(file, GOAL)
    assert there.probability > 0.8, there.reasons
    known = [camera.view in views for camera in CAMERAS]
    assert (there.jaccard[known, 0] > 0.8).all()
    assert np.isnan(there.jaccard[np.logical_not(known), 0]).all()
    assert there.features['goal'] > 0.5
    for end in ((GOAL[0] + 0.06, *GOAL[1:]), (*GOAL[:2], 0.1), RED):
        away = judge(file, end)
        assert away.probability < 0.2, away.reasons
    assert "'as in the goal picture' missed by" in away.reasons[0]


def test_block_that_is_at_its_goal_from_the_start_is_judged_by_its_j_not_by_its_gain(tmp_path):
    task = load_task(write_task(tmp_path, 'as_pictured'))
    estimator = SuccessEstimator([task], task='put_away', segmenter=ColourSegmenter())
    found = {}
    for name, end in (('stays', GOAL), ('leaves', RED)):
        rollout = masks(path(GOAL, end), [BLUE] * 9)
        judged = estimator.estimate(footage(rollout, masks([GOAL], [BLUE])), SAID)
        found[name] = judged.estimate
    assert found['stays'].features['goal'] > 0.5 and found['stays'].probability > 0.8
    assert found['leaves'].features['goal'] < -0.5 and found['leaves'].probability < 0.2


def test_block_in_the_painted_region_is_a_success_and_elsewhere_none(tmp_path):
    file = write_task(tmp_path, 'in_region', pictures=regions())
    inside = judge(file, (GOAL[0] + 0.01, GOAL[1], GOAL[2]))
    assert inside.probability > 0.8, inside.reasons
    assert inside.features['contained'] > 0.9
    outside = judge(file, (GOAL[0] + 0.08, GOAL[1], GOAL[2]))
    assert outside.probability < 0.2, outside.reasons


def test_object_that_the_picture_does_not_show_abstains_with_the_file(tmp_path):
    file = write_task(tmp_path, 'as_pictured', pictures=np.full_like(painted(GOAL), 170))
    found = judge(file, GOAL)
    assert np.isnan(found.probability)
    assert 'low.png' in found.reasons[0] and 'absent' in found.reasons[0]


@pytest.mark.parametrize('relation', ['as_pictured', 'in_region'])
def test_picture_of_other_sides_abstains_with_both_sizes(tmp_path, relation):
    file = write_task(tmp_path, relation, pictures=painted(GOAL)[:, :, :300])
    found = judge(file, GOAL)
    assert np.isnan(found.probability)
    assert '300x288, view ' in found.reasons[0] and '96x72' in found.reasons[0]


def test_picture_of_a_view_that_there_is_not_abstains(tmp_path):
    file = write_task(tmp_path, 'as_pictured')
    file.write_text(file.read_text().replace('low:', 'top:'))
    assert "looks at the views ['top']" in judge(file, GOAL).reasons[0]


def test_each_picture_is_segmented_once(tmp_path):
    class Counting(ColourSegmenter):
        calls = 0

        def segment(self, *args, **kwargs):
            self.calls += 1
            return super().segment(*args, **kwargs)

    counting = Counting()
    estimator = SuccessEstimator(
        [load_task(write_task(tmp_path, 'as_pictured'))], segmenter=counting
    )
    shown = footage(masks(path(RED, GOAL), [BLUE] * 9), masks([RED], [BLUE]))
    for _ in range(3):
        estimator.estimate(shown, SAID)
    assert counting.calls == 1


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (('low.png', 'lost.png'), "'.*lost.png' of view 'low' does not exist"),
        (('low.png', 'put_away.yaml'), 'is no picture; use PNG or JPEG'),
        (('pictures', 'picture'), r"unknown key 'picture' \(did you mean 'pictures'"),
        (('subject: a', 'subject: a\n  min_jaccard: 2'), r"'min_jaccard' is 2; .* in \(0, 1\]"),
        (('subject: a', 'subject: a\n  min_jaccard: no'), "'min_jaccard' is False; it must be in"),
    ],
)
def test_wrong_pictures_say_what_is_wrong(tmp_path, change, message):
    file = write_task(tmp_path, 'as_pictured')
    file.write_text(file.read_text().replace(*change))
    with pytest.raises(ConfigError, match=message):
        load_task(file)


def test_black_region_and_no_views_are_refused(tmp_path):
    with pytest.raises(ConfigError, match='black all over; paint the region'):
        load_task(write_task(tmp_path, 'in_region', pictures=np.zeros_like(painted(GOAL))))
    with pytest.raises(ConfigError, match='expected picture files by view'):
        load_task(write_task(tmp_path, 'as_pictured', views=()))


def test_task_file_of_ones_own_is_taken_beside_the_bundled_ones(tmp_path):
    file = write_task(tmp_path, 'as_pictured')
    card = read_card(share_path('resource', 'checkpoint'))

    def estimator(task):
        robot = checkpoint_robot('bundled')
        return assemble(
            card, None, robot=robot, task=task, segmenter=assemble_segmenter()
        ).estimator

    assert [task.name for task in estimator(str(file)).tasks] == ['put_away']
    assert LEFT not in [task.instruction for task in estimator(str(file)).tasks]
    assert len(estimator(None).tasks) == 15
    with pytest.raises(ConfigError, match='none.yaml'):
        estimator(str(tmp_path / 'none.yaml'))
