"""A red and a blue block, drawn along paths with OpenCV's own projection."""

import cv2
import numpy as np

from mtv_world_ros.core.data_types import CameraModel, ObjectMasks
from mtv_world_ros.success.footage_memory import Footage

HEIGHT, WIDTH, SCALE = 72, 96, 4
LEFT = 'place the red block to the left of the blue block'
STACK = 'stack the red block on the blue block'
NAMES = ('red block', 'blue block')
RED, BLUE = (0.15, 0.25, 0.025), (0.05, 0.3, 0.02)
EDGES = (0.05, 0.04)


def camera(view, azimuth, elevation, distance):
    """A camera opposite the robot that looks at the middle of the table."""
    azimuth, elevation = np.deg2rad([azimuth, elevation])
    outward = np.array(
        [
            np.cos(elevation) * np.sin(azimuth),
            np.cos(elevation) * np.cos(azimuth),
            np.sin(elevation),
        ]
    )
    right = np.cross(-outward, (0, 0, 1))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(-outward, right), -outward], axis=1)
    pose[:3, 3] = np.array([0, 0.31, 0.04]) + distance * outward
    focal = WIDTH * distance / 0.65
    K = np.array([[focal, 0, (WIDTH - 1) / 2], [0, focal, (HEIGHT - 1) / 2], [0, 0, 1]])
    return CameraModel(
        view=view, width=WIDTH, height=HEIGHT, K=K, mount_link='base', T_mount_camera=pose
    )


CAMERAS = (camera('low', 28, 28, 1.05), camera('high', -4, 62, 1.3))
POSES = tuple(np.asarray(c.T_mount_camera) for c in CAMERAS)


def silhouette(model, centre, edge, yaw):
    """(H, W) coverage of an upright cube, drawn with OpenCV's own projection."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * edge / 2
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    pose = np.linalg.inv(model.T_mount_camera)
    rotation, _ = cv2.Rodrigues(pose[:3, :3])
    corners = signs @ turn.T + centre
    pixels, _ = cv2.projectPoints(corners, rotation, pose[:3, 3], np.asarray(model.K), None)
    hull = cv2.convexHull(((pixels[:, 0] + 0.5) * SCALE - 0.5).astype(np.float32))
    canvas = np.zeros((HEIGHT * SCALE, WIDTH * SCALE), np.uint8)
    cv2.fillConvexPoly(canvas, np.round(hull).astype(np.int32), 1)
    return canvas


def masks(red_path, blue_path, status=None):
    """Masks of both blocks along (T, 3) paths; the nearer one hides the other."""
    found = np.zeros((2, 2, len(red_path), HEIGHT, WIDTH), bool)
    for view, model in enumerate(CAMERAS):
        for frame, centres in enumerate(zip(red_path, blue_path, strict=True)):
            drawn = [
                silhouette(model, np.array(c), edge, 0.4 * k)
                for k, (c, edge) in enumerate(zip(centres, EDGES, strict=True))
            ]
            near = np.argmin([np.linalg.norm(model.T_mount_camera[:3, 3] - c) for c in centres])
            drawn[1 - near] = drawn[1 - near] & (1 - drawn[near])
            for item, canvas in enumerate(drawn):
                area = cv2.resize(
                    canvas.astype(np.float32), (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA
                )
                found[view, item, frame] = area >= 0.5
    return ObjectMasks(names=NAMES, masks=found, status=status or (('ok', 'ok'),) * 2)


def path(start, end, steps=6):
    """A lift, a carry and a rest at the end."""
    start, end = np.array(start), np.array(end)
    share = np.linspace(0, 1, steps)[:, None]
    arc = start + share * (end - start)
    arc[:, 2] += 0.1 * np.sin(np.pi * share[:, 0])
    return np.concatenate([arc, np.repeat(end[None], 3, axis=0)])


def footage(rollout, start, openings=None, cameras=CAMERAS, poses=POSES):
    """The masks as seen by cameras that stand still, and grippers of one opening each."""
    count = rollout.masks.shape[2] + 1
    return Footage(
        masks=rollout,
        start_masks=start,
        cameras=cameras,
        poses=np.repeat(np.stack(poses)[:, None], count, axis=1),
        openings=None if openings is None else np.repeat(openings[:, None], count, axis=1),
    )
