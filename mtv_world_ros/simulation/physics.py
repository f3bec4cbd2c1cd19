"""The truth's physics: a catalogue of shifts from the nominal one, and what each changes."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import Field

from mtv_world_ros.core.config import Factor, read_yaml, Schema, validated, Wait
from mtv_world_ros.core.data_types import ByteArray, CameraModel, FloatArray
from mtv_world_ros.core.errors import SimulatorError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.simulation.arms.actuator import Actuator
from mtv_world_ros.simulation.scenes.workcell import Workcell

#: the second engine
DART = 'dart'
#: geoms of this priority are the pads of fingers
_PAD_PRIORITY = 1
#: seed of the directions of joint zero errors; the same for all episodes
_ZERO_SEED = 17
#: key of the random stream of physics; pictures and cameras have streams of their own
_SPAWN_KEY = 8

_Degrees = Annotated[float, Field(ge=0, le=180)]


class Physics(Schema):
    """One entry of `config/physics.yaml`: how the truth differs from the nominal one."""

    text: str = Field(description='what is different, in words')
    engine: Literal['mujoco', 'dart'] = Field(
        default='mujoco', description='what steps the bodies; MuJoCo draws them'
    )
    table_friction: Factor = Field(default=1.0, description='factor, of all but finger pads')
    grip_friction: Factor = Field(default=1.0, description='factor, of finger pads')
    object_mass: Factor = Field(default=1.0, description='factor')
    gripper_force: Factor = Field(default=1.0, description="factor, of grippers' gains and limits")
    contact_time: Annotated[float, Field(ge=1, le=1000)] = Field(
        default=1.0, description='factor of the time constant of contacts'
    )
    delay_s: Wait = Field(
        default=0.0, description='delay of commands on their way to the joints [s]'
    )
    joint_zero_deg: _Degrees = Field(
        default=0.0,
        description='error of the zero of each turning joint but grippers, either sign [degrees]',
    )
    table_m: Annotated[float, Field(ge=-0.05, le=0.05)] = Field(
        default=0.0, description='height of the table [m]'
    )
    object_size: Annotated[float, Field(ge=0.7, le=1.2)] = Field(default=1.0, description='factor')
    camera_m: float = Field(
        default=0.0, ge=0, le=100, description='error of the calibrated place of each camera [m]'
    )
    camera_deg: _Degrees = Field(
        default=0.0, description='error of its calibrated direction [degrees]'
    )
    blur_px: float = Field(
        default=0.0, ge=0, le=1000, description='standard deviation of the blur [px]'
    )
    noise: float = Field(
        default=0.0, ge=0, le=255, description='standard deviation of the noise [grey levels]'
    )
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] | None = Field(
        default=None, description='quality of JPEG compression; none = not compressed'
    )

    def workcell(self, workcell: Workcell) -> Workcell:
        """Return a workcell with this table and objects of this size."""
        return replace(workcell, table_m=self.table_m, object_size=self.object_size)

    def joint_zeros(self, robot: RobotModel) -> FloatArray:
        """Return (J,) reported less true positions [rad]; 0 of grippers and what slides."""
        signs = np.random.default_rng(_ZERO_SEED).choice((-1.0, 1.0), len(robot.joint_names))
        grippers = {tool.gripper_joint for tool in robot.tools}
        model = robot.pinocchio_model
        turns = [
            name not in grippers
            and 'JointModelP' not in model.joints[model.getJointId(name)].shortname()
            for name in robot.joint_names
        ]
        return np.where(turns, np.deg2rad(self.joint_zero_deg) * signs, 0.0)

    def change(self, model: Any, mujoco: Any, change: ModelParts) -> None:
        """Change a compiled scene in place.

        Args:
            model: the nominal `MjModel`.
            mujoco: the module.
            change: parts of the model that are objects and grippers.
        """
        pads = model.geom_priority == _PAD_PRIORITY
        model.geom_friction *= np.where(pads, self.grip_friction, self.table_friction)[:, None]
        model.geom_solref[:, 0] *= self.contact_time
        model.body_mass[change.objects] *= self.object_mass
        model.body_inertia[change.objects] *= self.object_mass
        for number in change.grippers:
            model.actuator_gainprm[number, 0] *= self.gripper_force
            model.actuator_biasprm[number, 1:3] *= self.gripper_force
            model.actuator_forcerange[number] *= self.gripper_force
        mujoco.mj_setConst(model, mujoco.MjData(model))

    def calibrated_cameras(
        self, cameras: Sequence[CameraModel], seed: int
    ) -> tuple[CameraModel, ...]:
        """Return the cameras as they are calibrated, off in directions that a seed draws."""
        if not (self.camera_m or self.camera_deg):
            return tuple(cameras)
        rng = _generator(seed)
        return tuple(self._miscalibrated(camera, rng) for camera in cameras)

    def _miscalibrated(self, camera: CameraModel, rng: np.random.Generator) -> CameraModel:
        way, axis = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        pose = np.array(camera.T_mount_camera)
        pose[:3, :3] = cv2.Rodrigues(axis * np.deg2rad(self.camera_deg))[0] @ pose[:3, :3]
        pose[:3, 3] += self.camera_m * way
        return replace(camera, T_mount_camera=pose)

    def pictured(self, image: ByteArray, rng: np.random.Generator) -> ByteArray:
        """Return a picture (H, W, 3) as the camera gives it."""
        if self.blur_px:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), self.blur_px), np.uint8)
        if self.noise:
            noisy = image + rng.normal(0.0, self.noise, image.shape)
            image = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        if self.jpeg_quality is not None:
            quality = [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality]
            _, coded = cv2.imencode('.jpg', image[..., ::-1], quality)
            decoded = cv2.imdecode(coded, cv2.IMREAD_COLOR)
            assert decoded is not None
            image = np.asarray(decoded[..., ::-1], np.uint8)
        return image


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelParts:
    """Indices of the bodies and actuators that a shift changes in a compiled scene.

    Attributes:
        objects: bodies of the free objects.
        grippers: actuators of the grippers.
    """

    objects: list[int]
    grippers: list[int]

    @classmethod
    def of(
        cls, model: Any, roles: Sequence[str], robot: RobotModel, actuators: Sequence[Actuator]
    ) -> ModelParts:
        """Return the indices for a scene with objects of these roles."""
        columns = {
            robot.joint_names.index(tool.gripper_joint)
            for tool in robot.tools
            if tool.gripper_joint is not None
        }
        return cls(
            objects=[model.body(role).id for role in roles],
            grippers=[n for n, actuator in enumerate(actuators) if actuator.column in columns],
        )


class DelayLine:
    """Delays commands on their way to the joints.

    Args:
        first: (J,) command before the first one.
        periods: delay in periods; commands between two periods are interpolated.
    """

    def __init__(self, first: FloatArray, periods: float) -> None:
        self._share = periods % 1.0
        self._last = deque([first] * (int(periods) + 2), maxlen=int(periods) + 2)

    def pass_on(self, command: FloatArray) -> FloatArray:
        """Add a command (J,) to the delay line; return the command (J,) that leaves it."""
        self._last.append(command)
        return self._last[1] * (1 - self._share) + self._last[0] * self._share


def picture_generator(seed: int) -> np.random.Generator:
    """Return the generator of the noise of an episode's pictures."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_SPAWN_KEY, 1)))


def _generator(seed: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_SPAWN_KEY,)))


@cache
def catalogue() -> dict[str, Physics]:
    """Return all physics by name, the nominal one first."""
    path = share_path('config', 'physics.yaml')
    entries = read_yaml(path, 'physics catalogue', 'physics')
    return {
        name: validated(Physics, values, f"'{path}', {name}") for name, values in entries.items()
    }


def physics_named(name: str) -> Physics:
    """Return a physics by name.

    Raises:
        SimulatorError: unknown name; the text names the nearest known one.
    """
    known = catalogue()
    if name not in known:
        raise SimulatorError.unknown(
            'unknown physics',
            name,
            known,
            listed=' (--physics); known are',
            advice=' (config/physics.yaml)',
        )
    return known[name]
