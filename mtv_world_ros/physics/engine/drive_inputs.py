"""Control inputs of the arms' drives at each step of the engine, and their motion.

Shape letters: N periods of commands, S steps of the engine, D degrees of freedom, J joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.physics.arms.arm_response import PERIOD_S
from mtv_world_ros.physics.contact_settings import ContactSettings
from mtv_world_ros.physics.engine.contact_scene import CompiledScene, STEP_S
from mtv_world_ros.physics.mujoco_import import mujoco, Rollout

#: a gripper that is closed by this share of its travel squeezes in full
_CLOSED = 0.2
#: steps of the engine in a period of commands
SUBSTEPS = round(PERIOD_S / STEP_S)
FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS.value


@dataclass(frozen=True, slots=True, kw_only=True)
class FreeMotion:
    """Motion of the arms without contact with solids, and the inputs of their drives.

    Attributes:
        controls: (S, D) set points of the drives [rad or m].
        pushes: (S, D) feed-forward effort of the drives [N m or N].
        positions: (S + 1, D) joint positions [rad or m]; row 0 at the start.
        velocities: (S + 1, D) joint velocities [rad/s or m/s].
    """

    controls: FloatArray
    pushes: FloatArray
    positions: FloatArray
    velocities: FloatArray

    def late(self, steps: int, last: FreeMotion | None) -> FreeMotion:
        """Return the motion, delayed by a number of steps.

        Args:
            steps: steps of the engine.
            last: motion before this one; None = the arms were at rest.
        """
        if not steps:
            return self

        if last is None:
            last = self._rest(steps)

        def shifted(rows: FloatArray, before: FloatArray, skip: int) -> FloatArray:
            first = before[len(before) - skip - steps : len(before) - skip]
            return np.concatenate([first, rows[: len(rows) - steps]])

        return FreeMotion(
            controls=shifted(self.controls, last.controls, 0),
            pushes=shifted(self.pushes, last.pushes, 0),
            positions=shifted(self.positions, last.positions, 1),
            velocities=shifted(self.velocities, last.velocities, 1),
        )

    def _rest(self, steps: int) -> FreeMotion:
        """Return a course of the given number of steps that holds the start of this one."""
        where = np.repeat(self.positions[:1], steps + 1, axis=0)
        still = np.zeros_like(where)
        return FreeMotion(controls=where[1:], pushes=still[1:], positions=where, velocities=still)


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmsState:
    """State that the arms would have without contact with solids.

    Attributes:
        physics: MuJoCo's full physics state of a scene of the arms and the table.
        ways: (2, D) set points and speeds of the fingers.
        commands: (J,) the last ones [rad or m].
    """

    physics: FloatArray
    ways: FloatArray
    commands: FloatArray


class CoursePlanner:
    """Computes the free motion of the arms under commands.

    Args:
        scene: scene of the arms without solids.
        settings: settings of contact.
    """

    def __init__(self, scene: CompiledScene, settings: ContactSettings) -> None:
        self._scene, self._squeeze = scene, settings.squeeze
        self._model = scene.model_of(settings, ())
        self._data = mujoco.MjData(self._model)
        self._rollout = Rollout(nthread=0)
        self._finger_mass = self._masses()

    def begin(self, positions: FloatArray) -> ArmsState:
        """Return the state of arms that rest at joints (J,)."""
        drives = self._scene.arms.drives
        data, model = self._data, self._model
        mujoco.mj_resetData(model, data)
        at = drives.spread(positions)
        data.qpos[self._scene.arm_qpos] = at
        physics = np.zeros(mujoco.mj_stateSize(model, FULL))
        mujoco.mj_getState(model, data, physics, FULL)
        return ArmsState(
            physics=physics, ways=np.stack([at, np.zeros_like(at)]), commands=positions
        )

    def plan(self, commands: FloatArray, state: ArmsState) -> tuple[FreeMotion, ArmsState]:
        """Return the free motion under commands (1 + N, J), `PERIOD_S` apart, and its end."""
        scene, drives = self._scene, self._scene.arms.drives
        targets = np.concatenate([state.commands[None], commands[1:]])
        rows = drives.spread(self._squeezed(targets))
        led = rows[1:] + drives.lead * np.diff(rows, axis=0) / PERIOD_S
        controls = np.repeat(led, SUBSTEPS, axis=0)
        pushes = np.zeros_like(controls)
        fingers = np.flatnonzero(drives.fingers)
        ways = state.ways
        if len(fingers):
            controls[:, fingers], pushes[:, fingers], own = self._finger_controls(
                led[:, fingers], state.ways[:, fingers], fingers
            )
            ways = ways.copy()
            ways[:, fingers] = own
        states, _ = self._rollout.rollout(
            self._model,
            self._data,
            state.physics[None],
            (controls + pushes / self._model.actuator_gainprm[:, 0])[None],
        )
        nq = self._model.nq
        physics = np.concatenate([state.physics[None], states[0]])
        then = ArmsState(physics=physics[-1], ways=ways, commands=commands[-1])
        course = FreeMotion(
            controls=controls,
            pushes=pushes,
            positions=physics[:, 1 + scene.arm_qpos],
            velocities=physics[:, 1 + nq + scene.arm_dofs],
        )
        return course, then

    def _squeezed(self, commands: FloatArray) -> FloatArray:
        """Return the commands (N, J) with grippers that are not open closed further."""
        if not self._squeeze:
            return commands
        robot, closer = self._scene.arms.robot, commands.copy()
        for tool, opening in zip(robot.tools, robot.gripper_openings(commands), strict=True):
            if tool.gripper_joint is None:
                continue
            column = robot.joint_names.index(tool.gripper_joint)
            share = self._squeeze * np.clip((1 - opening) / _CLOSED, 0.0, 1.0)
            ends = tool.gripper_closed, tool.gripper_open
            closer[:, column] = np.clip(
                commands[:, column] + share * (ends[0] - ends[1]), min(ends), max(ends)
            )
        return closer

    def _finger_controls(
        self, led: FloatArray, state: FloatArray, fingers: np.ndarray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the ways and pushes (S, F) that take free fingers where their joint goes.

        (2, F) then.

        What a gripper's joint does in free air was found for itself; what its fingers hang on,
        which is softer, counts where they touch something.
        """
        drives = self._scene.arms.drives
        stiffness, damping = drives.stiffness[fingers], drives.damping[fingers]
        mass = self._finger_mass[fingers]
        inertia = mass + drives.armature[fingers]
        brake = -self._model.actuator_biasprm[fingers, 2]
        system = np.zeros((len(fingers), 3, 3))
        system[:, 0, 1] = 1.0
        system[:, 1] = np.stack([-stiffness, -damping, stiffness], -1) / inertia[:, None]
        powers = np.stack([expm(system * STEP_S * (k + 1)) for k in range(SUBSTEPS)])
        now, rows = state, []
        for command in led:
            given = np.concatenate([now, command[None]])
            steps = np.einsum('kfij,jf->kif', powers, given)[:, :2]
            rows.append(steps)
            now = steps[-1]
        place, speed = np.moveaxis(np.concatenate(rows), 1, 0)
        pull = stiffness * (np.repeat(led, SUBSTEPS, axis=0) - place) - damping * speed
        moved = mass + self._model.dof_armature[self._scene.arm_dofs[fingers]]
        return place, brake * speed + moved * pull / inertia, now

    def _masses(self) -> FloatArray:
        """Return (D,) of what each degree of freedom moves alone, without its drive."""
        model, data = self._model, self._data
        mujoco.mj_forward(model, data)
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        dofs = self._scene.arm_dofs
        return np.diag(mass)[dofs] - model.dof_armature[dofs]
