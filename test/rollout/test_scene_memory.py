"""The background of a rollout, held where nothing covers it, by hand-made frames."""

from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.core.data_types import ObjectMasks
from mtv_world_ros.robot.shape import LinkShape
from mtv_world_ros.rollout.scene_memory import SceneKeeper
from mtv_world_ros.training.training_config import load_training_config

#: a thin plate across the optical axis, in the frame of the link that carries it [m]
PLATE = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.002, 0.002)])
LEFT, RIGHT = (-0.3, 0.0, 1.0), (0.3, 0.0, 1.0)


@pytest.fixture(scope='module')
def keeper(one_arm):
    return SceneKeeper(one_arm, [LinkShape(link='hand0', points=PLATE)])


def motion_of(robot, cameras, tools, keeper):
    positions = np.column_stack([np.asarray(tools, float), np.ones(len(tools))])
    return Motion.of(robot, cameras, positions, keeper.links)


def masks_of(camera, boxes, views=1):
    """Masks of objects that stand still, by boxes (top, bottom, left, right) or None."""
    masks = np.zeros((views, len(boxes), 1, camera.height, camera.width), np.bool_)
    for item, box in enumerate(boxes):
        if box is not None:
            masks[:, item, 0, box[0] : box[1], box[2] : box[3]] = True
    names = tuple(f'object {n}' for n in range(len(boxes)))
    return ObjectMasks(names=names, masks=masks, status=((('ok',) * len(boxes)),) * views)


def texture(camera):
    rng = np.random.default_rng(0)
    return rng.integers(0, 255, (1, 1, camera.height, camera.width, 3)).astype(np.uint8)


def test_what_the_arm_left_and_never_covered_is_as_it_was_seen(one_arm, make_camera, keeper):
    camera = make_camera(192, 144)
    cameras, scene = [camera], texture(camera)
    nothing = masks_of(camera, [None])
    memory = keeper.seen(None, motion_of(one_arm, cameras, [LEFT], keeper), scene, nothing)
    drawn = np.full_like(scene, 7)  # what a model makes of it
    at_right = motion_of(one_arm, cameras, [RIGHT], keeper)
    frames, after = keeper.held(memory, at_right, drawn, nothing, None)
    there = np.rint(camera.K @ RIGHT)[:2].astype(int)
    was = np.rint(camera.K @ LEFT)[:2].astype(int)
    assert (frames[0, 0, there[1], there[0]] == 7).all()  # the arm itself
    assert (frames[0, 0, was[1], was[0]] == 7).all()  # never seen: drawn once
    assert (frames[0, 0, -4:, -4:] == scene[0, 0, -4:, -4:]).all()
    assert (frames == scene).all(-1).mean() > 0.5
    # what was drawn once is held from then on
    again, _ = keeper.held(after, at_right, np.full_like(scene, 200), nothing, None)
    assert (again[0, 0, was[1], was[0]] == 7).all()
    assert (again[0, 0, there[1], there[0]] == 200).all()


def test_real_frames_fill_in_what_the_arm_hid_before(one_arm, make_camera, keeper):
    camera = make_camera(192, 144)
    scene, nothing = texture(camera), masks_of(camera, [None])
    memory = None
    for tool in (LEFT, RIGHT):
        memory = keeper.seen(memory, motion_of(one_arm, [camera], [tool], keeper), scene, nothing)
    assert memory.known.all()
    assert (memory.pictures == scene[:, 0]).all()


@pytest.mark.parametrize(('tool', 'touched'), [(LEFT, False), (RIGHT, True)])
def test_an_object_stays_in_the_memory_until_the_robot_may_have_moved_it(
    one_arm, make_camera, keeper, tool, touched
):
    camera = make_camera(192, 144)
    x, y = np.rint(camera.K @ RIGHT)[:2].astype(int)
    box, scene = (y - 3, y + 3, x - 3, x + 3), texture(camera)
    seen, lost = masks_of(camera, [box]), masks_of(camera, [None])
    start = motion_of(one_arm, [camera], [LEFT], keeper)
    memory = keeper.seen(None, start, scene, seen)
    drawn = np.full_like(scene, 7)
    _, memory = keeper.held(
        memory, motion_of(one_arm, [camera], [tool], keeper), drawn, lost, None
    )
    assert memory.touched.tolist() == [touched]
    frames, _ = keeper.held(memory, start, drawn, lost, None)
    assert (frames[0, 0, y, x] == 7).all() == touched


@pytest.mark.parametrize(('column', 'touched'), [(90, True), (20, False)])
def test_an_object_that_a_moved_one_reaches_may_have_moved_too(
    one_arm, make_camera, keeper, column, touched
):
    camera = make_camera(192, 144)
    x, y = np.rint(camera.K @ RIGHT)[:2].astype(int)
    taken, other = (y - 3, y + 3, x - 3, x + 3), (4, 10, 88, 94)
    scene, drawn = texture(camera), np.full_like(texture(camera), 7)
    start = motion_of(one_arm, [camera], [LEFT], keeper)
    memory = keeper.seen(None, start, scene, masks_of(camera, [taken, other]))
    at_right = motion_of(one_arm, [camera], [RIGHT], keeper)
    _, memory = keeper.held(memory, at_right, drawn, masks_of(camera, [taken, other]), None)
    assert memory.touched.tolist() == [True, False]
    pushed = masks_of(camera, [(4, 10, column - 6, column), None])
    frames, memory = keeper.held(memory, at_right, drawn, pushed, None)
    assert memory.touched.tolist() == [True, touched]
    assert (frames[0, 0, 7, 93] == 7).all() == touched


def test_where_an_object_was_is_unknown_while_the_robot_covers_it(one_arm, make_camera, keeper):
    camera = make_camera(192, 144)
    x, y = np.rint(camera.K @ RIGHT)[:2].astype(int)
    scene, left = texture(camera), motion_of(one_arm, [camera], [LEFT], keeper)
    right = motion_of(one_arm, [camera], [RIGHT], keeper)
    taken = masks_of(camera, [(y - 3, y + 3, x - 3, x + 3)])
    memory = keeper.seen(None, left, scene, taken)
    assert memory.known[0, y, x]
    carried = masks_of(camera, [(4, 10, 4, 10)])  # real frames show it elsewhere
    memory = keeper.seen(memory, right, scene, carried)
    assert not memory.known[0, y, x]
    frames, _ = keeper.held(memory, left, np.full_like(scene, 7), carried, None)
    assert (frames[0, 0, y, x] == 7).all()  # not the object that is no longer there
    assert keeper.seen(memory, left, scene, carried).known[0, y, x]


def test_a_view_in_which_the_robot_stays_away_shows_that_it_touched_nothing(
    one_arm, make_camera, keeper
):
    camera = make_camera(192, 144)
    x, y = np.rint(camera.K @ RIGHT)[:2].astype(int)
    seen = masks_of(camera, [(y - 3, y + 3, x - 3, x + 3)], views=2)
    elsewhere = np.array(seen.masks)
    elsewhere[1] = False
    elsewhere[1, 0, 0, :4, :4] = True
    seen = replace(seen, masks=elsewhere)
    scene, cameras = np.repeat(texture(camera), 2, axis=0), [camera, camera]
    memory = keeper.seen(None, motion_of(one_arm, cameras, [LEFT], keeper), scene, seen)
    _, after = keeper.held(memory, motion_of(one_arm, cameras, [RIGHT], keeper), scene, seen, None)
    assert not after.touched.any()


def test_foreseen_objects_cover_the_background(one_arm, make_camera, keeper):
    camera = make_camera(192, 144)
    scene, nothing = texture(camera), masks_of(camera, [None])
    at = motion_of(one_arm, [camera], [LEFT], keeper)
    memory = keeper.seen(None, at, scene, nothing)
    cover = np.zeros((1, 1, camera.height, camera.width, 4), np.uint8)
    cover[..., 100:110, 150:160, 3] = 255
    frames, _ = keeper.held(memory, at, np.full_like(scene, 7), nothing, cover)
    assert (frames[0, 0, 105, 155] == 7).all()


def test_a_camera_that_was_moved_begins_anew(one_arm, make_camera, keeper):
    camera = make_camera(192, 144)
    pose = np.array(camera.T_mount_camera)
    pose[0, 3] += 0.01
    scene, nothing = texture(camera), masks_of(camera, [None])
    memory = keeper.seen(None, motion_of(one_arm, [camera], [LEFT], keeper), scene, nothing)
    moved = motion_of(one_arm, [replace(camera, T_mount_camera=pose)], [LEFT], keeper)
    memory = keeper.seen(memory, moved, np.zeros_like(scene), nothing)
    assert not memory.pictures[memory.known].any()


@pytest.mark.parametrize(('preset', 'holds'), [('few_recordings', True), ('small', False)])
def test_only_checkpoints_whose_preset_says_so_hold_the_background(preset, holds):
    card = load_training_config(preset).card({})
    assert card.scene_memory is holds
    assert ('scene_memory' in card.plain()) is holds  # cards of before stay as they were


def marked(one_arm, make_camera, keeper, pixel, mark, plain):
    """One pixel of a frame in front of a robot that is drawn with a mark, without it."""
    camera = make_camera(192, 144)
    scene, nothing = texture(camera), masks_of(camera, [None])
    memory = keeper.seen(None, motion_of(one_arm, [camera], [LEFT], keeper), scene, nothing)
    unmarked = np.zeros((1, 1, camera.height, camera.width, 4), np.uint8)
    unmarked[..., 70, 90, :] = *plain, 255
    drawn = unmarked[..., :3].copy()
    drawn[..., 70, 90, :] = mark
    frames = np.array(scene)
    frames[..., 70, 90, :] = pixel
    cleaned = keeper.without_marks(memory, frames, drawn, unmarked)
    others = np.ones(frames.shape[2:4], np.bool_)
    others[70, 90] = False
    assert (cleaned[0, 0][others] == frames[0, 0][others]).all()
    return cleaned[0, 0, 70, 90]


ORANGE, MAGENTA, WHITE, DARK = (250, 140, 20), (255, 0, 255), (255, 255, 255), (30, 30, 32)


@pytest.mark.parametrize('mark', [ORANGE, MAGENTA])
@pytest.mark.parametrize('share', [0.2, 0.6, 1.0])
def test_copied_marks_are_taken_out_of_a_frame(one_arm, make_camera, keeper, mark, share):
    pixel = np.rint((1 - share) * np.array(DARK) + share * np.array(mark))
    found = marked(one_arm, make_camera, keeper, pixel, mark, DARK)
    assert np.abs(found.astype(int) - DARK).max() <= 2


@pytest.mark.parametrize(
    ('pixel', 'mark'),
    [
        (DARK, ORANGE),  # nothing was copied
        ((40, 60, 200), ORANGE),  # a blue block between the fingers
        ((230, 230, 225), ORANGE),  # a plate
        (WHITE, WHITE),  # a white mark looks like a thing
    ],
)
def test_what_is_no_copied_mark_stays(one_arm, make_camera, keeper, pixel, mark):
    found = marked(one_arm, make_camera, keeper, pixel, mark, DARK)
    assert np.abs(found.astype(int) - pixel).max() <= 6
