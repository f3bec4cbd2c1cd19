"""Objects that move rigidly: their pictures go where a pinhole camera has them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.core.transforms import about_z
from mtv_world_ros.physics.object_motion import (
    cut_outs,
    FoundObjects,
    moved_pictures,
    ObjectMotion,
)

FOCAL, SIZE = 100.0, (60, 80)
POSE = np.eye(4)


@pytest.fixture
def camera() -> CameraModel:
    height, width = SIZE
    return CameraModel(
        view='low',
        width=width,
        height=height,
        K=np.array([[FOCAL, 0, 39.5], [0, FOCAL, 29.5], [0, 0, 1]]),
        distortion_model='none',
        distortion=np.zeros(0),
        mount_link='base',
        T_mount_camera=POSE,
    )


def square(row: int, column: int, half: int) -> np.ndarray:
    mask = np.zeros(SIZE, bool)
    mask[row - half : row + half + 1, column - half : column + half + 1] = True
    return mask


def shown(camera, masks, colours, reference, points, rotations=None):
    """(T, H, W, 4) of one view, the optical axis along the base's z."""
    frame = np.full((*SIZE, 3), 200, np.uint8)
    for mask, colour in zip(masks, colours, strict=True):
        frame[mask] = colour
    points = np.asarray(points, float)
    turns = np.tile(np.eye(3), (*points.shape[:2], 1, 1)) if rotations is None else rotations
    motion = ObjectMotion(reference=np.asarray(reference, float), points=points, rotations=turns)
    poses = np.tile(POSE, (1, len(points), 1, 1))
    cuts = cut_outs(frame[None], np.stack(masks)[None])
    return moved_pictures(cuts, motion, [camera], POSE[None, None], poses)[0]


def centre_and_area(picture: np.ndarray) -> tuple[np.ndarray, float]:
    cover = picture[..., 3] / 255.0
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    area = cover.sum()
    return np.array([(columns * cover).sum(), (rows * cover).sum()]) / area, float(area)


def test_a_shift_in_space_is_a_shift_by_focal_length_over_depth(camera):
    mask = square(30, 40, 4)
    start = np.array([0.005, 0.005, 1.0])
    moved = shown(camera, [mask], [(255, 0, 0)], [start], [[start], [start + [0.1, -0.05, 0]]])
    (at_start, area), (at_end, area_after) = map(centre_and_area, moved)
    np.testing.assert_allclose(at_end - at_start, [10.0, -5.0], atol=0.05)
    assert area_after == pytest.approx(area, rel=0.02)
    assert (moved[1, 25, 50] == (255, 0, 0, 255)).all()


def test_half_the_depth_is_four_times_the_area(camera):
    start = np.array([0.005, 0.005, 1.0])
    moved = shown(camera, [square(30, 40, 4)], [(9, 9, 9)], [start], [[start], [start * 0.5]])
    (_, area), (_, area_after) = map(centre_and_area, moved)
    assert area_after == pytest.approx(4 * area, rel=0.1)


def test_a_turn_about_the_line_of_sight_turns_the_picture(camera):
    mask = np.zeros(SIZE, bool)
    mask[28:33, 30:51] = True  # wide and low, about pixel (40, 30)
    start = np.array([0.005, 0.005, 1.0])
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turns = np.stack([np.eye(3), quarter])[:, None]
    moved = shown(camera, [mask], [(9, 9, 9)], [start], [[start], [start]], turns)
    rows, columns = np.nonzero(moved[1, ..., 3] > 127)
    assert np.ptp(rows) == 20 and np.ptp(columns) == 4


def test_near_objects_hide_far_ones_and_unknown_ones_stay(camera):
    masks = [square(30, 20, 4), square(30, 40, 4), square(10, 60, 3)]
    colours = [(255, 0, 0), (0, 255, 0), (0, 0, 255)]
    reference = [[-0.195, 0.005, 1.0], [0.005, 0.005, 1.0], [np.nan] * 3]
    end = [[0.0045, 0.0045, 0.9], reference[1], [np.nan] * 3]
    moved = shown(camera, masks, colours, reference, [end])[0]
    assert (moved[30, 40, :3] == (255, 0, 0)).all()  # the red one came nearer, before the green
    assert moved[30, 20, 3] == 0
    assert (moved[10, 60] == (0, 0, 255, 255)).all()
    over = [
        [0.2025, -0.1755, 0.9],
        reference[1],
        [np.nan] * 3,
    ]  # the red one comes where it is seen
    moved = shown(camera, masks, colours, reference, [over])[0]
    assert (moved[10, 60] == (0, 0, 255, 255)).all() and (moved[10, 65, :3] == (255, 0, 0)).all()
    assert not moved[50:, :, 3].any()


def test_what_was_put_into_a_container_is_seen_in_it(camera):
    masks = [square(30, 20, 3), square(30, 50, 10)]
    reference = [[-0.195, 0.005, 1.0], [0.105, 0.005, 1.0]]
    into = [[0.107, 0.005, 1.02], [0.1055, 0.005, 1.0]]  # farther than the container's centre
    moved = shown(camera, masks, [(255, 0, 0), (0, 255, 0)], reference, [into])[0]
    assert (moved[30, 50, :3] == (255, 0, 0)).all() and (moved[30, 42, :3] == (0, 255, 0)).all()
    assert not moved[30, 61, 3]  # half a millimetre is no motion
    pushed = [into[0], [0.115, 0.005, 1.0]]
    moved = shown(camera, masks, [(255, 0, 0), (0, 255, 0)], reference, [pushed])[0]
    assert (moved[30, 50, :3] == (255, 0, 0)).all() and moved[30, 61, 3]
    behind = [[0.0, 0.005, 1.02], [0.105, 0.005, 1.0]]
    moved = shown(camera, masks, [(255, 0, 0), (0, 255, 0)], reference, [behind])[0]
    assert (moved[30, 40, :3] == (0, 255, 0)).all() and (moved[30, 38, :3] == (255, 0, 0)).all()


def test_what_is_behind_something_high_does_not_stand_in_it(camera):
    bottle = np.zeros(SIZE, bool)
    bottle[14:47, 46:55] = True
    reference = [[-0.195, 0.005, 1.0], [0.105, 0.005, 1.0]]
    behind = [[0.165, 0.005, 1.1], [0.105, 0.005, 1.0]]
    moved = shown(
        camera, [square(30, 20, 3), bottle], [(255, 0, 0), (0, 255, 0)], reference, [behind]
    )
    assert (moved[0, 30, 53, :3] == (0, 255, 0)).all() and (
        moved[0, 30, 56, :3] == (255, 0, 0)
    ).all()


def test_what_stands_still_goes_through_the_picture_of_a_camera_that_moves(camera):
    mask, start = square(30, 40, 4), np.array([[0.005, 0.005, 1.0]])
    motion = ObjectMotion(
        reference=start, points=start[None], rotations=np.tile(np.eye(3), (1, 1, 1, 1))
    )
    cuts = cut_outs(np.full((1, *SIZE, 3), 200, np.uint8), mask[None, None])
    pose = POSE.copy()
    pose[0, 3] -= 0.1
    (moved,) = moved_pictures(cuts, motion, [camera], POSE[None, None], pose[None, None])
    at, _ = centre_and_area(moved[0])
    np.testing.assert_allclose(at, [50.0, 30.0], atol=0.1)


def test_what_goes_behind_the_camera_is_held(camera):
    mask = square(30, 40, 4)
    start = [0.005, 0.005, 1.0]
    moved = shown(camera, [mask], [(255, 0, 0)], [start], [[[0.0, 0.0, -1.0]]])[0]
    np.testing.assert_array_equal(moved[..., 3] == 255, mask)


class Foreseen:
    """One object that goes along x at speeds (K,) of its motions [m / step]."""

    step_s, commands_a_step = 0.1, 1

    def __init__(self, *speeds: float, steps: int = 0) -> None:
        self.speeds, self.steps = speeds, steps

    @property
    def sizes(self) -> np.ndarray:
        return np.full((len(self.speeds), 1, 3), 0.05)

    def advance(
        self, positions: np.ndarray, should_stop=None
    ) -> tuple[tuple[ObjectMotion, ...], Foreseen]:
        steps = self.steps + np.arange(len(positions))
        turns = np.tile(np.eye(3), (len(steps), 1, 1, 1))
        motions = []
        for speed in self.speeds:
            points = np.zeros((len(steps), 1, 3))
            points[..., 0], points[..., 2] = speed * steps[:, None], 1.0
            start = np.array([[0.0, 0.0, 1.0]])
            motions.append(ObjectMotion(reference=start, points=points, rotations=turns))
        return tuple(motions), Foreseen(*self.speeds, steps=int(steps[-1]))


def found(*speeds: float) -> FoundObjects:
    return FoundObjects.at(
        names=('block',),
        frames=np.full((1, *SIZE, 3), 200, np.uint8),
        masks=square(30, 40, 3)[None, None],
        poses=POSE[None],
        tracked=Foreseen(*speeds),
    )


@pytest.mark.parametrize('openings', [None, np.array([[0.0], [0.5], [1.0]])])
def test_motions_go_on_and_are_cut_with_all_that_they_know(openings):
    points, turns = np.arange(9.0).reshape(3, 1, 3), np.tile(np.eye(3), (3, 1, 1, 1))
    motion = ObjectMotion(
        reference=points[0], points=points, rotations=turns, openings=openings, weight=2.0
    )
    both = motion.then(motion)
    assert len(both.points) == len(both.rotations) == 5 and both.weight == 2.0
    ends = both[np.array([0, -1])]
    np.testing.assert_array_equal(ends.points, points[[0, -1]])
    if openings is None:
        assert both.openings is None and ends.openings is None
    else:
        np.testing.assert_array_equal(both.openings[:, 0], [0, 0.5, 1, 0.5, 1])
        np.testing.assert_array_equal(ends.openings[:, 0], [0, 1])


def plan(steps: int) -> np.ndarray:
    return np.zeros((steps + 1, 1))


def test_the_motion_that_is_shown_is_most_like_all():
    objects = found(0.0, 0.02, 0.021, 0.022, 0.9)
    ahead = objects.foresee([plan(4), plan(4)])
    assert [len(part.positions) for part in ahead] == [5, 9]
    assert ahead[-1].medoid() == 2
    assert ahead[-1].medoid(np.array([True, False, False, True, True])) == 3
    turned = replace(ahead[-1].motions[2], rotations=np.tile(about_z(1.5), (9, 1, 1, 1)))
    motions = (*ahead[-1].motions[:2], turned, *ahead[-1].motions[3:])
    assert replace(ahead[-1], motions=motions).medoid() != 2


def test_pictures_pass_gradually_from_one_motion_to_another(camera):
    """Objects neither jump where another motion is shown, nor stay where it does not have them."""
    *_, part = found(0.02, 0.0).foresee([plan(8), plan(20)])
    passing = replace(part, shown=1, shown_before=0)
    times = np.array([0.0, 0.5, 1.0, 2.0])
    poses = np.tile(POSE, (1, len(times), 1, 1))
    pictures = passing.pictures(times, [camera], poses)[0]
    at = [centre_and_area(picture)[0][0] for picture in pictures]
    np.testing.assert_allclose(np.array(at) - at[-1], [16, 8, 0, 0], atol=0.1)


def test_a_motion_blended_from_another_one_turns_to_what_it_is():
    points, half = np.zeros((5, 1, 3)), about_z(np.pi / 2)
    still = ObjectMotion(
        reference=points[0], points=points, rotations=np.tile(np.eye(3), (5, 1, 1, 1))
    )
    turned = replace(still, points=points + 0.1, rotations=np.tile(half, (5, 1, 1, 1)))
    passing = still.blended_from(turned, 2)
    np.testing.assert_allclose(passing.points[:, 0, 0], [0.1, 0.05, 0, 0, 0])
    turns = [about_z(np.pi / 2), about_z(np.pi / 4), *[np.eye(3)] * 3]
    np.testing.assert_allclose(passing.rotations[:, 0], turns, atol=1e-9)
    unknown = replace(still, points=np.full_like(points, np.nan))
    np.testing.assert_array_equal(still.blended_from(unknown, 2).points, points)


def test_pictures_are_those_of_the_motion_that_is_shown(camera):
    parts = found(0.0, 0.01).foresee([plan(4), plan(4)])
    poses = np.tile(POSE, (1, 2, 1, 1))
    for number, part in enumerate(parts):
        still, moved = (
            replace(part, shown=k, shown_before=k).pictures(np.array([0.0, 0.4]), [camera], poses)[
                0
            ]
            for k in (0, 1)
        )
        at, _ = centre_and_area(still[1])
        for row, frame in enumerate(moved):
            gone = 100 * 0.01 * 4 * (number + row)
            np.testing.assert_allclose(centre_and_area(frame)[0] - at, [gone, 0], atol=0.1)
