"""How far are the camera poses of `mtv-world fit camera` from the truth?

    python experiments/camera_calibration.py --repeats 20 [--robots franka,ur5e_pair,yam_bimanual]

Each recording is a simulated scene of its own, with a speckled table, in which all joints of the
robot move smoothly about their pose at rest for 10 s; the bundled robots' first view stands
still, and a camera sits on the first arm's tool link. Estimates start from a guess that is 5
degrees and 50 mm wrong, and from none. The errors are those of the poses; they are covered where
they are within twice the stated standard error. --minutes ends a run early, with the n it got to;
with --kept FILE the same command goes on from there. --kinds picks estimates by the beginning of
their names, e.g. "on the arm" or "fixed, guess".
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
import json
from pathlib import Path
import time
from typing import Any

import numpy as np
from page import parse_arguments, publish, table

from mtv_world_ros.cameras.camera import camera_poses
from mtv_world_ros.cli.fits.camera import GOOD_MATCH, is_doubtful
from mtv_world_ros.core.data_types import ByteArray, CameraModel, FloatArray
from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.core.transforms import looking_along
from mtv_world_ros.data.episode import JointStates, Track
from mtv_world_ros.inspection.camera_pose import CameraEstimate, difference, displaced_pose
from mtv_world_ros.inspection.cameras.fixed_camera import FixedCamera
from mtv_world_ros.inspection.cameras.scene_tracks import follow_scene
from mtv_world_ros.inspection.cameras.wrist_camera import WristCamera
from mtv_world_ros.inspection.clocks import JointTrack
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import load_shape
from mtv_world_ros.simulation.arms.arm import actuators_of
from mtv_world_ros.simulation.expert.expert import Expert
from mtv_world_ros.simulation.opengl import load_mujoco
from mtv_world_ros.simulation.scenes.randomize import draw_scene
from mtv_world_ros.simulation.scenes.scene import scene_xml
from mtv_world_ros.simulation.scenes.tasks import task_named
from mtv_world_ros.simulation.scenes.workcell import workcell_of
from mtv_world_ros.simulation.simulator import scene_generator

#: of estimates
KINDS = ('on the arm, guess', 'on the arm, no guess', 'fixed, guess', 'fixed, no guess')
START_NS, FPS, SECONDS = 1_700_000_000_000_000_000, 10, 10
CLOTH = (
    '<texture name="cloth" type="2d" builtin="flat" rgb1="0.62 0.6 0.55" mark="random" '
    'random="0.12" markrgb="0.2 0.25 0.3" width="160" height="160"/>'
    '<material name="cloth" texture="cloth" texrepeat="5 5" specular="0"/>'
)


class Recording:
    """One recording: joint states, and what any camera sees of it.

    Args:
        robot: one of the bundled robots.
        home: (J,) its pose at rest.
        seed: of scene and motion.
    """

    def __init__(self, robot: RobotModel, home: FloatArray, seed: int) -> None:
        self.robot, self.rng = robot, np.random.default_rng(seed)
        task = task_named('bussing_table')
        self.scene = draw_scene(task, scene_generator(seed), workcell_of(robot))
        self.positions = self._motion(home)
        self.stamps_ns = START_NS + (np.arange(len(self.positions)) * 1e9 / FPS).astype(np.int64)
        self.joints = JointTrack(
            JointStates(
                stamps_ns=self.stamps_ns, joint_names=robot.joint_names, positions=self.positions
            ),
            robot,
        )

    def _motion(self, home: FloatArray) -> FloatArray:
        """(T, J) smooth, within the limits, the tools clear of the table."""
        times = np.arange(SECONDS * FPS) / FPS
        room = np.minimum(home - self.robot.lower, self.robot.upper - home).clip(0)
        reach = np.minimum(0.9 * room, 0.5) * self.rng.uniform(0.6, 1.0, len(home))
        rate, start = self.rng.uniform(0.5, 1.1, (2, len(home), 1))
        waves = np.sin(rate * times + 2 * np.pi * start).T
        while True:
            positions = home + reach * waves
            if self.robot.tool_poses(positions)[..., 2, 3].min() > 0.1 or reach.max() < 0.05:
                return positions
            reach = 0.85 * reach

    def film(self, camera: CameraModel, every: int = 1) -> Track:
        """What a camera sees."""
        mujoco = load_mujoco()
        seen = replace(camera, mount_link=self.robot.base_link, T_mount_camera=np.eye(4))
        xml = scene_xml(replace(self.scene, cameras=(seen,)), self.robot)
        xml = xml.replace('<asset>', f'<asset>{CLOTH}', 1)
        xml = xml.replace('<geom name="table"', '<geom name="table" material="cloth"', 1)
        model = mujoco.MjModel.from_xml_string(xml)
        model.geom('table').rgba[:] = 1
        data, actuators = mujoco.MjData(model), actuators_of(self.robot)
        poses = camera_poses(camera, self.robot, self.positions)[::every]
        frames: list[ByteArray] = []
        with mujoco.Renderer(model, camera.height, camera.width) as renderer:
            for row, T in zip(self.positions[::every], poses, strict=True):
                for actuator in actuators:
                    value = row[actuator.column] * actuator.multiplier + actuator.offset
                    data.joint(actuator.joint).qpos[0] = value
                turned = np.column_stack([T[:3, 0], -T[:3, 1], -T[:3, 2]])
                model.camera(0).pos[:] = T[:3, 3]
                mujoco.mju_mat2Quat(model.camera(0).quat, turned.ravel())
                mujoco.mj_forward(model, data)
                renderer.update_scene(data, model.camera(0).name)
                frames.append(renderer.render())
        return Track(self.stamps_ns[::every], np.stack(frames))  # type: ignore[arg-type]

    def wrist_camera(self) -> CameraModel:
        """A camera beside the first arm's tool that looks about where the tool points."""
        tool = self.robot.tools[0]
        T_tool_camera = np.eye(4)
        eye = np.array([0.07, 0.0, -0.1]) + self.rng.normal(0, 0.015, 3)
        T_tool_camera[:3, :3] = looking_along(-eye + self.rng.normal(0, 0.02, 3))
        T_tool_camera[:3, 3] = eye
        K = np.array([[260.0, 0, 191.5], [0, 260, 143.5], [0, 0, 1]])
        return CameraModel(
            view='wrist',
            width=384,
            height=288,
            K=K,
            mount_link=tool.link,
            T_mount_camera=tool.T_link_tool @ T_tool_camera,
        )

    def guess(self, camera: CameraModel) -> CameraModel:
        """The camera 5 degrees and 50 mm off."""
        turn, shift = self.rng.normal(size=(2, 3))
        change = [
            *turn * np.radians(5) / np.linalg.norm(turn),
            *shift * 0.05 / np.linalg.norm(shift),
        ]
        T = camera.T_mount_camera
        return replace(camera, T_mount_camera=displaced_pose(T, np.array(change), T[:3, 3]))


def estimates(
    robot: RobotModel, home: FloatArray, seed: int, kinds: Collection[str]
) -> Iterator[tuple[str, CameraModel, Callable[[], CameraEstimate]]]:
    """Name, truth and estimator of each of some kinds; guesses do not depend on which."""
    recording = Recording(robot, home, seed)
    wrist = recording.wrist_camera()
    film = cache(partial(recording.film, wrist))
    for word, guess in (('guess', True), ('no guess', False)):
        start = recording.guess(wrist)

        def on_arm(start: CameraModel = start, guess: bool = guess) -> CameraEstimate:
            tracks = follow_scene(film(), start, robot, recording.joints)
            return WristCamera(tracks, start, robot).estimate(guess=guess)

        if f'on the arm, {word}' in kinds:
            film()  # costs the estimate no time
            yield f'on the arm, {word}', wrist, on_arm
    fixed = next(c for c in recording.scene.cameras if c.mount_link == robot.base_link)
    shown, parts = cache(partial(recording.film, fixed, every=4)), load_shape(robot).parts
    for word, guess in (('guess', True), ('no guess', False)):
        start = recording.guess(fixed)

        def standing(start: CameraModel = start, guess: bool = guess) -> CameraEstimate:
            camera = FixedCamera(shown(), start, robot, parts, recording.joints)
            return camera.estimate(guess=guess, seed=seed)

        if f'fixed, {word}' in kinds:
            shown()
            yield f'fixed, {word}', fixed, standing


class Kept:
    """Estimates in a file, a JSON line each, so that an interrupted run goes on.

    Args:
        file: None = in memory alone.
    """

    def __init__(self, file: Path | None) -> None:
        self._file = file
        lines = file.read_text().splitlines() if file is not None and file.is_file() else []
        self.results: list[dict[str, Any]] = [json.loads(line) for line in lines]

    def has(self, name: str, number: int) -> bool:
        """Whether the estimate of a recording is there."""
        return any((r['name'], r['number']) == (name, number) for r in self.results)

    def add(self, **result: Any) -> None:
        """Keep an estimate."""
        print(json.dumps(result), flush=True)
        self.results.append(result)
        if self._file is not None:
            with self._file.open('a') as out:
                out.write(json.dumps(result) + '\n')


def row(name: str, results: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line of the table."""
    good = [r for r in results if r['name'] == name and 'mm' in r]
    count = sum(r['name'] == name for r in results)
    if not good:
        return [name, f'0 of {count}', *['-'] * 6]
    keys = ('mm', 'deg', 'std_mm', 'std_deg', 'seconds')
    mm, degrees, std_mm, std_deg, seconds = (np.array([r[k] for r in good]) for k in keys)
    covered = (mm <= 2 * std_mm) & (degrees <= 2 * std_deg)
    doubted = np.array([r['doubted'] for r in good])
    return [
        name,
        f'{len(mm)} of {count}',
        f'{np.median(mm):.1f} / {np.percentile(mm, 90):.1f} / {mm.max():.1f}',
        f'{np.median(degrees):.2f} / {np.percentile(degrees, 90):.2f} / {degrees.max():.2f}',
        f'{np.median(std_mm):.1f}, {np.median(std_deg):.2f}',
        f'{covered.sum()} of {len(mm)}',
        f'{doubted.sum()}, of those not within: {(doubted & ~covered).sum()}',
        f'{np.median(seconds):.1f}',
    ]


def body(options: Namespace) -> str:
    """The table."""
    ends = time.monotonic() + 60 * options.minutes
    robots = {name: load_robot(robot_path(name)) for name in options.robots.split(',')}
    homes = {name: Expert(robot).home for name, robot in robots.items()}
    kept = Kept(options.kept)
    cases = [(number, name) for number in range(options.repeats) for name in robots]
    for number, robot_name in cases:
        kinds = [kind for kind in KINDS if kind.startswith(options.kinds)]
        left = {kind for kind in kinds if not kept.has(f'{robot_name}, {kind}', number)}
        if not left or time.monotonic() > ends:
            continue
        seed = options.seed + number
        for kind, truth, estimate in estimates(robots[robot_name], homes[robot_name], seed, left):
            if time.monotonic() < ends:
                kept.add(name=f'{robot_name}, {kind}', number=number, **_measured(truth, estimate))
    names = sorted({result['name'] for result in kept.results})
    head = ['robot, camera', 'estimated', 'error [mm] median / 90 % / largest',
            'error [degrees]', 'standard error [mm, degrees], median', 'within twice that',
            f'said to be doubtful (correlation below {GOOD_MATCH:g})', 'CPU [s]']  # fmt: skip
    return table(head, [row(name, kept.results) for name in names])


def _measured(truth: CameraModel, estimate: Callable[[], CameraEstimate]) -> dict[str, Any]:
    """Errors of an estimate, or why there is none."""
    begun = time.process_time()
    try:
        result = estimate()
    except MtvWorldError as error:
        return {'refused': str(error)}
    mm, degrees = difference(result.camera.T_mount_camera, truth.T_mount_camera)
    return {
        'mm': round(mm, 3),
        'deg': round(degrees, 4),
        'std_mm': round(result.std_mm, 3),
        'std_deg': round(result.std_deg, 4),
        'match': None if np.isnan(result.match) else round(result.match, 3),
        'doubted': is_doubtful(result),
        'seconds': round(time.process_time() - begun, 2),
    }


def main() -> None:
    """Measure and publish."""

    def more(parser: object) -> None:
        parser.add_argument('--robots', default='franka,ur5e_pair,yam_bimanual')  # type: ignore[attr-defined]
        parser.add_argument('--minutes', type=float, default=1e9, help='stop starting after that')  # type: ignore[attr-defined]
        parser.add_argument('--kept', type=Path, help='estimates so far; run again to go on')  # type: ignore[attr-defined]
        parser.add_argument('--kinds', default='')  # type: ignore[attr-defined]

    options = parse_arguments(__doc__, 20, more)
    text = body(options)
    publish(
        'camera_calibration',
        'Estimated camera poses against the truth',
        f'python experiments/camera_calibration.py --repeats {options.repeats} '
        f'--robots {options.robots} --minutes {options.minutes:g}',
        f'{(__doc__ or "").split("    python")[0].strip()}\n\n{text}',
        options,
        'no GPU',
    )


if __name__ == '__main__':
    main()
