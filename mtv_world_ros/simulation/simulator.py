"""A simulated episode in closed loop: joint targets in, images, joint states and success out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TYPE_CHECKING

import numpy as np

from mtv_world_ros.core.data_types import ByteArray, FloatArray
from mtv_world_ros.core.errors import SimulatorError, TrajectoryError
from mtv_world_ros.data.episode import NOMINAL
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.simulation.arms.arm import actuators_of
from mtv_world_ros.simulation.opengl import load_mujoco
from mtv_world_ros.simulation.physics import (
    DART,
    DelayLine,
    ModelParts,
    physics_named,
    picture_generator,
)
from mtv_world_ros.simulation.scenes.randomize import (
    draw_scene,
    instruction_of,
    RandomizationConfig,
)
from mtv_world_ros.simulation.scenes.scene import Scene, scene_xml, TIMESTEP_S
from mtv_world_ros.simulation.scenes.tasks import Task, task_named
from mtv_world_ros.simulation.scenes.workcell import workcell_of
from mtv_world_ros.simulation.second_engine import second_engine
from mtv_world_ros.success.situation import TruePoses

if TYPE_CHECKING:
    from mtv_world_ros.simulation.dart.stepped_world import SteppedWorld

CONTROL_PERIOD_S = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class SimObservation:
    """Observation after a step.

    Attributes:
        time_s: simulated time since reset [s].
        images: view -> (H, W, 3) uint8 RGB.
        masks: view -> (H, W) uint8; 0 = none, i + 1 = scene.objects[i]; empty without masks.
        positions: (J,) measured joint positions in the robot's order [rad or m].
        success: the task is done at this instant.
    """

    time_s: float
    images: dict[str, ByteArray]
    masks: dict[str, ByteArray]
    positions: FloatArray
    success: bool


def scene_generator(seed: int) -> np.random.Generator:
    """Return the generator that draws the scene of an episode seed."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0,)))


def situation_of(scene: Scene, task: Task, poses: FloatArray, openings: FloatArray) -> TruePoses:
    """Return the objects' poses over time, with heights above the table.

    Args:
        scene: scene of O objects.
        task: task that has the goals.
        poses: T_base_object (T, O, 4, 4) [m].
        openings: (A, T) openings of the grippers.
    """
    up = np.array([0.0, 0.0, scene.table_m])
    goals = task.goals(scene.goals)
    return TruePoses(
        positions={item.role: poses[:, i, :3, 3] - up for i, item in enumerate(scene.objects)},
        rotations={item.role: poses[:, i, :3, :3] for i, item in enumerate(scene.objects)},
        sizes={item.role: item.size for item in scene.objects},
        openings=openings,
        goals={role: goal - up for role, goal in goals.items()},
    )


class SimEpisode:
    """Physics and cameras of one episode at a time.

    Args:
        robot: robot that has a workcell.
        home: (J,) joint positions at reset [rad or m].
        config: randomised quantities and image size; default: the workcell's.
        rendering: False runs physics alone, without OpenGL; images are then empty.
        physics: name of the physics, a key of `config/physics.yaml`.

    Attributes:
        physics: name of that physics.
        calibrated_cameras: the scene's cameras as they are calibrated.
    """

    def __init__(
        self,
        robot: RobotModel,
        home: FloatArray,
        config: RandomizationConfig | None = None,
        *,
        rendering: bool = True,
        physics: str = NOMINAL,
    ) -> None:
        self.robot, self.physics = robot, physics
        self.home = np.asarray(home, dtype=np.float64)
        self._physics = physics_named(physics)
        self._workcell = self._physics.workcell(workcell_of(robot))
        # reported less true positions
        self._zeros = self._physics.joint_zeros(robot)
        self._config = config or RandomizationConfig()
        self._rendering = rendering
        self._mujoco = load_mujoco(rendering=rendering)
        actuators = actuators_of(robot)
        self._columns = np.array([actuator.column for actuator in actuators])
        self._multipliers = np.array([actuator.multiplier for actuator in actuators])
        self._offsets = np.array([actuator.offset for actuator in actuators])
        # velocity feedforward that removes the lag [s]
        self._lead = np.array([actuator.kv / actuator.kp for actuator in actuators])
        self._renderer: Any = None
        self._model: Any = None
        self._seed = 0

    def reset(self, seed: int, task: str | Task) -> SimObservation:
        """Build the scene of a seed and return its first observation."""
        self.task = task_named(task) if isinstance(task, str) else task
        self._seed = seed
        scene = draw_scene(self.task, scene_generator(seed), self._workcell, self._config)
        return self.load(scene, self.task)

    def load(self, scene: Scene, task: Task) -> SimObservation:
        """Build a given scene and return its first observation.

        Raises:
            SimulatorError: MuJoCo refuses the scene.
        """
        self.close()
        mujoco = self._mujoco
        self.scene, self.task = scene, task
        try:
            self._model = mujoco.MjModel.from_xml_string(scene_xml(scene, self.robot))
        except ValueError as error:
            raise SimulatorError(
                f"the scene of task '{task.name}' does not build: {error}"
            ) from error
        actuators = actuators_of(self.robot)
        roles = [item.role for item in scene.objects]
        parts = ModelParts.of(self._model, roles, self.robot, actuators)
        self._physics.change(self._model, mujoco, parts)
        self._data = mujoco.MjData(self._model)
        self._index_model()
        self.calibrated_cameras = self._physics.calibrated_cameras(scene.cameras, self._seed)
        self._noise = picture_generator(self._seed)
        if self._rendering:
            height, width = scene.cameras[0].height, scene.cameras[0].width
            self._renderer = mujoco.Renderer(self._model, height, width)
            self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
            self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._target, self._arrived, self._seen = self.home, self.home, []
        self._delay = DelayLine(self.home, self._physics.delay_s / CONTROL_PERIOD_S)
        self._data.qpos[self._arm_qpos] = self._spread(self.home - self._zeros)
        self._data.ctrl[:] = self._spread(self.home - self._zeros)
        mujoco.mj_forward(self._model, self._data)
        self._second = None
        if self._physics.engine == DART:
            rest = self.home - self._zeros
            self._second = second_engine(self._model, scene, self.robot, actuators, rest)
        return self.observe()

    def close(self) -> None:
        """Free the OpenGL context of the current scene."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    @property
    def instruction(self) -> str:
        """The instruction of the episode."""
        return instruction_of(self.task, self.scene)

    @property
    def time_s(self) -> float:
        """Simulated time since reset [s]."""
        return float(self._data.time)

    def step(self, targets: FloatArray, seconds: float = 0.1) -> SimObservation:
        """Drive the joints to `targets` (J,) over one camera period and observe."""
        targets = self._checked(targets)
        start, num = self._target, max(1, round(seconds / CONTROL_PERIOD_S))
        for k in range(1, num + 1):
            self.advance(start + (targets - start) * k / num)
        return self.observe()

    def advance(self, targets: FloatArray) -> None:
        """Run one control period towards joint `targets` (J,), without rendering.

        Raises:
            TrajectoryError: wrong number of joints, or not finite.
        """
        targets = self._checked(targets)
        arrived = self._delay.pass_on(targets)
        if self._second is not None:
            self._second.advance(arrived - self._zeros)
            self._show(self._second)
            self._target, self._arrived = targets, arrived
            return
        velocity = (self._spread(arrived) - self._spread(self._arrived)) / CONTROL_PERIOD_S
        self._data.ctrl[:] = self._spread(arrived - self._zeros) + self._lead * velocity
        num_steps = round(CONTROL_PERIOD_S / TIMESTEP_S)
        self._mujoco.mj_step(self._model, self._data, nstep=num_steps)
        self._target, self._arrived = targets, arrived

    def _show(self, second: SteppedWorld) -> None:
        """Put arms and objects where the second engine has them, for pictures and poses."""
        mujoco, data = self._mujoco, self._data
        data.qpos[self._arm_qpos] = self._spread(second.joints)
        for item, pose in zip(self.scene.objects, second.poses, strict=True):
            first, turn = self._model.joint(item.role).qposadr[0], np.zeros(4)
            mujoco.mju_mat2Quat(turn, pose[:3, :3].ravel())
            data.qpos[first : first + 7] = [*pose[:3, 3], *turn]
        data.time += CONTROL_PERIOD_S
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)
        mujoco.mj_camlight(self._model, data)

    def _checked(self, targets: FloatArray) -> FloatArray:
        targets = np.asarray(targets, dtype=np.float64)
        if targets.shape != self.home.shape or not np.isfinite(targets).all():
            raise TrajectoryError(
                f'joint targets must be {len(self.home)} finite values, got shape '
                f'{targets.shape}: {targets.tolist()}'
            )
        return targets

    def positions(self) -> FloatArray:
        """Return the measured joint positions (J,) in the robot's order [rad or m]."""
        driven = (self._data.qpos[self._arm_qpos] - self._offsets) / self._multipliers
        sums = np.bincount(self._columns, driven, minlength=len(self.home))
        return sums / np.bincount(self._columns, minlength=len(self.home)) + self._zeros

    def object_poses(self) -> FloatArray:
        """Return T_base_object (O, 4, 4) of the objects' centres [m]."""
        poses = np.tile(np.eye(4), (len(self.scene.objects), 1, 1))
        for pose, item in zip(poses, self.scene.objects, strict=True):
            body = self._data.body(item.role)
            pose[:3, :3], pose[:3, 3] = body.xmat.reshape(3, 3), body.xpos
        return poses

    def seen_poses(self) -> FloatArray:
        """Return T_base_object (T, O, 4, 4) [m] at every observation since reset."""
        return np.array([poses for poses, _ in self._seen])

    def situation(self) -> TruePoses:
        """Return the true poses since reset, on which the task's relations are evaluated."""
        openings = self.robot.gripper_openings(np.array([seen for _, seen in self._seen]))
        return situation_of(self.scene, self.task, self.seen_poses(), openings)

    def observe(self, *, rendering: bool = True) -> SimObservation:
        """Render all views (unless disabled) and evaluate whether the task is done."""
        positions = self.positions()
        self._seen.append((self.object_poses(), positions))
        images, masks = self._render() if self._rendering and rendering else ({}, {})
        return SimObservation(
            time_s=self.time_s,
            images=images,
            masks=masks,
            positions=positions,
            success=bool(self.task.succeeds(self.situation())[-1]),
        )

    def _render(self) -> tuple[dict[str, ByteArray], dict[str, ByteArray]]:
        images, masks = {}, {}
        for camera in self.scene.cameras:
            self._renderer.update_scene(self._data, camera.view)
            images[camera.view] = self._physics.pictured(self._renderer.render(), self._noise)
            masks[camera.view] = self._render_instances()
        return images, masks

    def _render_instances(self) -> ByteArray:
        """Draw the same scene with every geom in the colour of its number.

        The renderer's own segmentation looks all geoms up again in every frame, which takes
        as long as drawing them.
        """
        flag, scene = self._mujoco.mjtRndFlag, self._renderer.scene
        by_number = [int(flag.mjRND_SEGMENT), int(flag.mjRND_IDCOLOR)]
        scene.flags[by_number] = 1
        colours = self._renderer.render()
        scene.flags[by_number] = 0
        if len(self._instance_of) != scene.ngeom + 1:
            self._instance_of = self._instances(scene)
        return self._instance_of[colours[..., 0] | colours[..., 1].astype(np.uint16) << 8]

    def _instances(self, scene: Any) -> ByteArray:
        """Return the instance id by the number of a drawn geom, from 1; nothing drawn is 0."""
        owners = {
            self._model.body(item.role).id: i for i, item in enumerate(self.scene.objects, 1)
        }
        instances = np.zeros(scene.ngeom + 1, dtype=np.uint8)
        for drawn in scene.geoms[: scene.ngeom]:
            if drawn.objtype == self._mujoco.mjtObj.mjOBJ_GEOM and drawn.segid >= 0:
                body = int(self._model.geom_bodyid[drawn.objid])
                instances[drawn.segid + 1] = owners.get(body, 0)
        return instances

    def _index_model(self) -> None:
        """Look up the joints' indices in qpos."""
        joints = [actuator.joint for actuator in actuators_of(self.robot)]
        self._arm_qpos = np.array([self._model.joint(name).qposadr[0] for name in joints])
        self._instance_of = np.zeros(0, dtype=np.uint8)

    def _spread(self, positions: FloatArray) -> FloatArray:
        """(J,) robot joints -> actuators: mimic joints follow, the YAM's right finger mirrors."""
        return positions[self._columns] * self._multipliers + self._offsets
