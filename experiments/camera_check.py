"""How many injected camera errors does the arm's outline find, correct and refuse?

    python experiments/camera_check.py --out experiments/results

In scenes of the simulator the told pose of each camera is off by so much, in a direction that the
seed draws; the check sees the first frame alone. Error: mean distance in the picture of what is
seen where objects lie, before and after, of a picture 384 px wide. Time: CPU of an episode's check
of two views.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
import time

import cv2
import numpy as np
from page import parse_arguments, publish, table

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.core.data_types import CameraModel, Observation
from mtv_world_ros.core.files import bundled
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.shape import load_shape
from mtv_world_ros.simulation.expert.expert import home_positions
from mtv_world_ros.simulation.simulator import SimEpisode
from mtv_world_ros.vision.camera_check import CameraChecker

#: errors of the told poses [m, degrees]
ERRORS = ((0.0, 0.0), (0.005, 0.5), (0.01, 1.0), (0.02, 2.0), (0.04, 4.0))
TASKS = ('place_block_a2b_left', 'collect_food', 'stack_blocks_two', 'shake_bottle')
#: where objects lie [m]
PLACES = np.array([[x, y, 0.03] for x in (-0.2, 0.0, 0.2) for y in (0.2, 0.35)])
HEAD = (
    'off by', 'cameras', 'fit', 'corrected', 'refused', 'not checked', 'error before',
    'after, where corrected', 'largest after',
)  # fmt: skip


def off(camera: CameraModel, metres: float, degrees: float, rng: np.random.Generator):
    """Return a camera elsewhere."""
    way, axis = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    pose = np.array(camera.T_mount_camera)
    pose[:3, :3] = cv2.Rodrigues(axis * np.deg2rad(degrees))[0] @ pose[:3, :3]
    pose[:3, 3] += metres * way
    return replace(camera, T_mount_camera=pose)


def apart(one: CameraModel, other: CameraModel) -> float:
    """Return how far apart both show what lies where objects do [px]."""
    ends = [project(camera, camera.T_mount_camera, PLACES)[0] for camera in (one, other)]
    return float(np.linalg.norm(ends[0] - ends[1], axis=-1).mean())


def main() -> None:
    """Print a row for each size of the error, and write them as a page."""
    options = parse_arguments(__doc__, 20)
    robot = load_robot(bundled('robots', 'yam_bimanual', '--robot'))
    checker, rng = CameraChecker(robot, load_shape(robot)), np.random.default_rng(options.seed)
    sim, rows, seconds = SimEpisode(robot, home_positions(robot)), [], []
    scenes = []
    for number in range(options.repeats):
        seen = sim.reset(number, TASKS[number % len(TASKS)])
        frames = np.stack([seen.images[camera.view] for camera in sim.scene.cameras])
        scenes.append((sim.scene.cameras, frames, seen.positions))
    sim.close()
    for metres, degrees in ERRORS:
        statuses, before, after = Counter[str](), [], []
        for cameras, frames, positions in scenes:
            told = tuple(off(camera, metres, degrees, rng) for camera in cameras)
            seen = Observation(cameras=told, frames=frames, positions=positions, stamp_ns=1)
            begun = time.process_time()
            check = checker.check(seen)
            seconds.append(time.process_time() - begun)
            found = zip(cameras, told, check.corrected(told), check.fits, strict=True)
            for true, wrong, now, fit in found:
                statuses[fit.status] += 1
                before.append(apart(true, wrong))
                after += [apart(true, now)] if fit.status == 'corrected' else []
        rows.append(
            [
                f'{1e3 * metres:g} mm, {degrees:g} degrees',
                str(len(before)),
                *(str(statuses[s]) for s in ('fits', 'corrected', 'refused', 'unchecked')),
                f'{np.mean(before):.1f} px',
                f'{np.mean(after):.2f} px' if after else '–',
                f'{max(after):.2f} px' if after else '–',
            ]
        )
    text = (__doc__ or '').split('\n' * 2)[-1]
    times = f'Median time {1e3 * float(np.median(seconds)):.0f} ms.'
    publish(
        'camera_check',
        "Camera errors that the arm's outline finds",
        f'python experiments/camera_check.py --repeats {options.repeats} --seed {options.seed}',
        '\n\n'.join([text, table(HEAD, rows), times]),
        options,
        'one process',
    )


if __name__ == '__main__':
    main()
