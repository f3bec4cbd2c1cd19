"""How long does a trajectory video take, against a plain loop that redraws every past point?

    python experiments/trajectory_video.py [--out experiments/results/]

Two arms, two views with lens distortion, two objects; from joint positions to uint8 frames. The
plain loop draws, for every frame and view, every past point again as a disc with cv2.circle, as
bright as its age says, and blurs the frame into a glow. Forward kinematics is in both.
"""

from __future__ import annotations

from functools import partial
import os

os.environ.setdefault('OMP_NUM_THREADS', '1')

import cv2
import numpy as np
from page import measure, parse_arguments, publish, table

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.control.trajectory_video import (
    arm_colour,
    object_colour,
    render_trajectory_video,
    TrajectoryVideoConfig,
)
from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.core.files import share_path
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.model import RobotModel

#: name, frames, width, height, frames a second
CASES = (('small preset', 17, 96, 72, 5.0), ('81 frames', 81, 384, 288, 10.0))
PLUMB_BOB = np.array([-0.05, 0.02, 0.0005, -0.0005, 0.0])


def looking_at(position: tuple[float, float, float], target: np.ndarray) -> np.ndarray:
    """T_base_camera of a camera at `position` that looks at `target`."""
    ahead = target - np.array(position)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, (0, 0, 1.0))
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    T[:3, 3] = position
    return T


def make_cameras(width: int, height: int) -> list[CameraModel]:
    """A low and a high view of the table."""
    K = np.array([[1.6 * width, 0, width / 2], [0, 1.6 * width, height / 2], [0, 0, 1]])
    places = {'low': (0.45, 1.15, 0.55), 'high': (-0.05, 0.9, 1.2)}
    return [
        CameraModel(
            view=view, width=width, height=height, K=K, distortion_model='plumb_bob',
            distortion=PLUMB_BOB, mount_link='base',
            T_mount_camera=looking_at(place, np.array([0, 0.3, 0.1])),
        )
        for view, place in places.items()
    ]  # fmt: skip


def make_motion(frames: int, fps: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Both arms swing over the table, grippers open and close: positions (T, 14), times (T,)."""
    generator = np.random.default_rng(seed)
    times = np.arange(frames) / fps
    centre = np.tile([0.0, 1.4, 1.4, -1.2, 0.0, 0.0, 0.019], 2)
    width = np.tile([0.35, 0.15, 0.15, 0.2, 0.2, 0.3, 0.018], 2)
    phase = generator.uniform(0, 2 * np.pi, 14)
    return centre + width * np.sin(2 * np.pi * times[:, None] / 4 + phase), times


def make_masks(width: int, height: int) -> np.ndarray:
    """Two squares in each view."""
    masks = np.zeros((2, 2, height, width), bool)
    side = height // 8
    for index, left in enumerate((width // 3, width // 2)):
        masks[:, index, height // 2 : height // 2 + side, left : left + side] = True
    return masks


def plain_loop(
    cameras: list[CameraModel],
    robot: RobotModel,
    positions: np.ndarray,
    times: np.ndarray,
    masks: np.ndarray,
    config: TrajectoryVideoConfig,
) -> np.ndarray:
    """Every frame from scratch: project each past point, draw a disc, blur."""
    fine = np.arange((len(times) - 1) * config.points_per_frame + 1) / config.points_per_frame
    stamps = np.interp(fine, np.arange(len(times)), times)
    dense = np.stack([np.interp(stamps, times, column) for column in positions.T], axis=1)
    points = robot.tool_poses(dense)[..., :3, 3]
    frames = np.empty((len(cameras), len(times), cameras[0].height, cameras[0].width, 3), np.uint8)
    for view, camera in enumerate(cameras):
        T = np.linalg.inv(camera.T_mount_camera)
        rotation, shift = cv2.Rodrigues(T[:3, :3])[0], T[:3, 3]
        radius = max(1, round(config.point_radius_m * camera.K[0, 0]))
        for k, now in enumerate(times):
            canvas = np.zeros((camera.height, camera.width, 3), np.float32)
            for index, mask in enumerate(masks[view]):
                canvas[mask] = 255 * object_colour(index, config.object_fill)
            for n in np.flatnonzero(stamps <= now + 1e-9):
                fade = 0.5 ** ((now - stamps[n]) / config.half_life_s)
                for arm in range(len(points)):
                    pixel, _ = cv2.projectPoints(
                        points[arm, n], rotation, shift, camera.K.copy(), PLUMB_BOB
                    )
                    x, y = np.rint(pixel[0, 0]).astype(int)
                    colour = 255 * fade * arm_colour(arm, len(points))
                    cv2.circle(canvas, (int(x), int(y)), radius, colour.tolist(), -1)
            glow = cv2.GaussianBlur(canvas, (0, 0), max(radius / 2, 0.8))
            frames[view, k] = np.clip(glow, 0, 255)
    return frames


def main() -> None:
    """Measure both and print the table."""
    options = parse_arguments(__doc__, repeats=15)
    cv2.setNumThreads(1)
    robot = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))
    config, rows = TrajectoryVideoConfig(), []
    for name, frames, width, height, fps in CASES:
        cameras, masks = make_cameras(width, height), make_masks(width, height)
        positions, times = make_motion(frames, fps, options.seed)
        found = measure(
            {
                'plain cv2 loop': partial(
                    plain_loop, cameras, robot, positions, times, masks, config
                ),
                'render_trajectory_video': partial(
                    render_trajectory_video,
                    motion=Motion.of(robot, cameras, positions),
                    times=times,
                    object_masks=masks,
                    config=config,
                ),
            },
            options.repeats,
        )  # fmt: skip
        slow = found['plain cv2 loop'][0]
        for method, (median, low, high) in found.items():
            case = f'{name}: {frames} frames x 2 views, {height}x{width}'
            rows.append([case, method, f'{median:.1f}', f'{low:.1f} .. {high:.1f}',
                         f'{slow / median:.1f}'])  # fmt: skip
    header = ['case', 'method', 'CPU-ms, median', '5 .. 95 %', 'times as fast']
    body = f'{table(header, rows)}\n\nOne thread; both take turns in one run.'
    publish(
        'trajectory_video', 'Drawing trajectory videos', 'python experiments/trajectory_video.py',
        body, options, f'numpy {np.__version__}, OpenCV {cv2.__version__}',
    )  # fmt: skip


if __name__ == '__main__':
    main()
