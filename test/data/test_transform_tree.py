"""Frames and transforms as TF tells them: what carries a camera, and what is refused."""

from types import SimpleNamespace as Message

import numpy as np
import pytest

from mtv_world_ros.core.errors import CalibrationError
from mtv_world_ros.data.transform_tree import pose_track, read_tree, TransformTree

LINKS = ('base', 'hand')
TURNED = (0.0, 0.0, np.sin(0.25), np.cos(0.25))  # by 0.5 rad about z


def message(*edges):
    """A TFMessage of (parent, child, position, quaternion, stamp [s])."""
    transforms = []
    for parent, child, place, turn, stamp_s in edges:
        sec, nanosec = divmod(round(stamp_s * 1e9), 10**9)
        header = Message(frame_id=parent, stamp=Message(sec=sec, nanosec=nanosec))
        position = Message(**dict(zip('xyz', place, strict=True)))
        rotation = Message(**dict(zip('xyzw', turn, strict=True)))
        transform = Message(translation=position, rotation=rotation)
        transforms.append(Message(header=header, child_frame_id=child, transform=transform))
    return Message(transforms=transforms)


def edge(parent, child, x=0.0, turn=(0, 0, 0, 1), stamp_s=0.0):
    return parent, child, (x, 0.0, 0.0), turn, stamp_s


def test_a_wrist_camera_is_mounted_on_the_hand_though_the_hand_moves():
    tree = TransformTree()
    tree.add(message(edge('hand', 'bracket', 0.1), edge('bracket', 'optical', 0.02)), latched=True)
    for k in range(5):
        tree.add(message(edge('base', 'hand', 0.1 * k, stamp_s=k)))
    mount = tree.mount('optical', LINKS)
    assert (mount.link, mount.stamp_ns) == ('hand', None)
    np.testing.assert_allclose(mount.T_link_frame[:3, 3], (0.12, 0, 0))


def test_a_pose_over_tf_has_the_stamp_of_its_least_recent_transform():
    tree = TransformTree()
    tree.add(message(edge('base', 'ceiling', 1.0, TURNED)), latched=True)
    for stamp_s in (1, 2, 3):
        tree.add(message(edge('ceiling', 'rail', 0.5, stamp_s=stamp_s)))
    for stamp_s in (3, 4, 5):
        tree.add(message(edge('rail', 'optical', 0.5, stamp_s=stamp_s)))
    mount = tree.mount('optical', LINKS)
    assert (mount.link, mount.stamp_ns) == ('base', 3_000_000_000)
    np.testing.assert_allclose(mount.T_link_frame[:2, 3], (1 + np.cos(0.5), np.sin(0.5)))
    tree.forget_moving()
    assert not tree.is_connected('optical', LINKS)


def test_a_camera_that_pans_has_no_link_but_is_connected():
    tree = TransformTree()
    tree.add(message(edge('pan', 'optical')), latched=True)
    tree.add(message(edge('base', 'pan')))
    assert tree.mount('optical', LINKS).link == 'base'  # as far as one knows
    tree.add(message(edge('base', 'pan', turn=TURNED)))
    with pytest.raises(CalibrationError, match='pans and tilts'):
        tree.mount('optical', LINKS)
    assert tree.is_connected('optical', LINKS)
    assert tree.mount('optical', ()).link == 'pan'


def test_the_latest_of_tf_static_holds():
    tree = TransformTree()
    for x in (1.0, 2.0):
        tree.add(message(edge('base', 'optical', x)), latched=True)
    assert tree.mount('optical', LINKS).T_link_frame[0, 3] == 2.0


def test_frames_in_a_circle_and_transforms_that_are_no_poses():
    tree = TransformTree('cell/')
    tree.add(message(edge('/cell/a', 'cell/b'), edge('b', 'a'), edge('b', 'b')), latched=True)
    tree.add(message(edge('a', 'c', float('nan')), edge('a', 'd', turn=(0, 0, 0, 0))))
    assert tree.frames == {'a', 'b'}
    assert sum('no poses' in line for line in tree.problems) == 3
    with pytest.raises(CalibrationError, match='no link of the robot'):
        tree.mount('a', LINKS)


def test_memory_is_bounded_whatever_is_published():
    tree = TransformTree()
    for k in range(5000):
        tree.add(message(edge('base', f'frame{k}'), edge('base', f'nan{k}', float('nan'))))
    assert len(tree.frames) + len(tree.problems) < 2100


def test_a_camera_that_moves_is_where_the_newest_transform_says():
    tree = TransformTree()
    tree.add(message(edge('pan', 'optical', 0.1)), latched=True)
    tree.add(message(edge('base', 'pan', stamp_s=1)))
    assert not tree.is_moving('optical', LINKS)
    tree.add(message(edge('base', 'pan', 0.5, stamp_s=2)))
    assert tree.is_moving('optical', LINKS) and not tree.is_moving('nowhere', LINKS)
    mount = tree.moving_mount('optical', LINKS)
    assert (mount.link, mount.stamp_ns) == ('base', 2_000_000_000)
    np.testing.assert_allclose(mount.T_link_frame[:3, 3], (0.6, 0, 0))


@pytest.mark.parametrize(
    ('stamp_s', 'x'),
    [(0.5, 0.0), (1.0, 0.0), (2.0, 0.0), (2.25, 0.25), (2.5, 0.5), (3.0, 0.5), (9.0, 0.5)],
)
def test_a_camera_that_moves_is_where_it_was_at_a_time(stamp_s, x):
    tree = TransformTree()
    tree.add(message(edge('pan', 'optical', 0.1)), latched=True)
    for at_s, place in ((1, 0.0), (2, 0.0), (3, 0.5), (2.5, 0.5)):  # the last one came late
        tree.add(message(edge('base', 'pan', place, stamp_s=at_s)))
    mount = tree.moving_mount('optical', LINKS, round(stamp_s * 1e9))
    assert (mount.link, mount.stamp_ns) == ('base', 3_000_000_000)
    np.testing.assert_allclose(mount.T_link_frame[:3, 3], (0.1 + x, 0, 0))


def test_poses_between_two_transforms_are_interpolated_over_another_branch():
    sent = [message(edge('map', 'base', 1.0), edge('pan', 'optical', 0.1))]
    sent += [message(edge('map', 'pan', 0.2 * k, stamp_s=0.2 * k)) for k in range(6)]
    stamps = np.array([0.0, 0.3, 1.0]) * 1e9
    track = pose_track(sent, 'optical', LINKS, stamps.astype(np.int64))
    assert track.link == 'base'
    np.testing.assert_allclose(track.T_link_frame[:, 0, 3], np.array([0, 0.3, 1.0]) + 0.1 - 1.0)
    with pytest.raises(CalibrationError, match='within 0.5 s before and after 1 of 2 images'):
        pose_track(sent, 'optical', LINKS, np.array([0, 2 * 10**9]))


def test_frames_in_a_circle_are_named_and_counted_and_the_rest_is_kept():
    tree = TransformTree()
    tree.add(message(edge('base', 'stand', 0.2), edge('stand', 'good')), latched=True)
    tree.add(message(edge('a', 'b'), edge('b', 'c'), edge('c', 'a'), edge('c', 'optical')))
    (problem,) = tree.problems
    assert all(f"'{first}' -> '{then}'" in problem for first, then in ('ab', 'bc', 'ca')), problem
    assert 'circle (3 transforms)' in problem
    assert tree.mount('good', LINKS).link == 'base'
    with pytest.raises(CalibrationError, match="'optical': it hangs in a circle, 'c' -> 'a'"):
        tree.mount('optical', LINKS)


def test_the_newest_static_transform_holds_for_all_times_and_is_said():
    static = [message(edge('base', 'optical', x, stamp_s=k)) for k, x in enumerate((0.3, 0.35))]
    tree = read_tree([], static=static)
    mount = tree.mount('optical', LINKS)
    assert mount.stamp_ns is None
    np.testing.assert_allclose(mount.T_link_frame[:3, 3], (0.35, 0, 0))
    (text,) = tree.problems
    assert "/tf_static: the transform 'base' -> 'optical' was replaced once" in text
    assert '50.0 mm and 0.00 degrees away; the newest holds for good' in text


def test_the_turn_of_a_replaced_static_transform_is_said():
    static = [message(edge('base', 'optical')), message(edge('base', 'optical', turn=TURNED))]
    (text,) = read_tree([], static=static).problems
    assert '0.0 mm and 28.65 degrees' in text  # 0.5 rad


@pytest.mark.parametrize('change', [0.0, 1e-9], ids=['equal', 'rounded'])
def test_a_static_transform_that_is_published_again_is_no_news(change):
    static = [message(edge('base', 'optical', 0.3 + change * k, stamp_s=k)) for k in range(6)]
    assert read_tree([], static=static).problems == []


def test_a_static_transform_with_a_new_parent_replaces_the_old_one():
    static = [message(edge('base', 'optical', 0.1)), message(edge('hand', 'optical', 0.2))]
    tree = read_tree([], static=static)
    assert tree.mount('optical', LINKS).link == 'hand'
    (text,) = tree.problems
    assert "'hand' -> 'optical' was replaced once, the last time that of 'base'" in text


def test_a_static_transform_that_was_replaced_does_not_break_the_poses_of_a_moving_camera():
    static = [message(edge('pan', 'optical', x, stamp_s=0)) for x in (0.5, 0.1)]
    moving = [message(edge('base', 'pan', 0.2 * k, stamp_s=0.2 * k)) for k in range(6)]
    track = pose_track(moving, 'optical', LINKS, np.array([0, 10**9]), static=static)
    np.testing.assert_allclose(track.T_link_frame[:, 0, 3], (0.1, 1.1))
