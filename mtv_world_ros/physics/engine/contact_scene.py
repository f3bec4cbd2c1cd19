"""A table, a robot and solids as a scene of MuJoCo, and its numbers in each of several futures.

Shape letters: O solids, D degrees of freedom of the arms.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.errors import RobotError
from mtv_world_ros.physics.arms.arms import Arms, PASSED, PATCH_M, set_drives, SOLIDS
from mtv_world_ros.physics.contact_settings import ContactSettings
from mtv_world_ros.physics.mujoco_import import mujoco
from mtv_world_ros.physics.solids import Solid

#: of the engine [s]
STEP_S = 0.004
#: smallest width of a dish or tray, which is hollow [m]
MIN_DISH_WIDTH_M = 0.06
#: smallest ratio of width to height of a dish or tray
MIN_DISH_RATIO = 1.5
#: thickness of the bottom of a hollow solid [m]
DISH_BOTTOM_M = 0.006
#: gap between the lower edge of a wall and the ground [m]
WALL_GAP_M = 0.0005
#: number of boxes that approximate a round wall
NUM_WALL_BOXES = 16
#: smallest thickness of a simulated part [m]
MIN_THICKNESS_M = 1e-3
#: smallest mass of a simulated part [kg]
MIN_MASS_KG = 0.01
#: time constant of contacts, in steps of the engine (MuJoCo: solref)
CONTACT_TIME_STEPS = 2.5
#: stiffness of friction as a multiple of the contacts' (MuJoCo: impratio)
FRICTION_STIFFNESS_RATIO = 10.0
#: largest number of iterations of the constraint solver
SOLVER_ITERATIONS = 30
#: termination tolerance of the constraint solver
SOLVER_TOLERANCE = 1e-7
_BOX = mujoco.mjtGeom.mjGEOM_BOX
_CYLINDER = mujoco.mjtGeom.mjGEOM_CYLINDER


@dataclass(frozen=True, slots=True, kw_only=True)
class _Piece:
    """A box or an upright cylinder of a solid.

    Attributes:
        size: half extents (3,) of a box; radius, half height and 0 of a cylinder [m].
        at: (3,) middle of the piece in the solid [m].
        mass: mass of the piece [kg].
        yaw: rotation about z [rad].
        is_round: whether the piece is a cylinder.
    """

    size: tuple[float, float, float]
    at: tuple[float, float, float]
    mass: float
    yaw: float = 0.0
    is_round: bool = False

    @property
    def half(self) -> FloatArray:
        """(3,) half extents."""
        if self.is_round:
            return np.array([self.size[0], self.size[0], self.size[1]])
        return np.array(self.size)

    @property
    def inertia(self) -> FloatArray:
        """(3, 3) about its middle, along the solid's axes."""
        if self.is_round:
            radius, half = self.size[:2]
            across = self.mass * (radius**2 / 4 + half**2 / 3)
            return np.diag([across, across, self.mass * radius**2 / 2])
        x, y, z = np.array(self.size) ** 2
        moment = self.mass / 3 * np.diag([y + z, x + z, x + y])
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        return turn @ moment @ turn.T


@dataclass(frozen=True, slots=True, kw_only=True)
class CompiledScene:
    """Compiled MuJoCo scene; `model_of` sets the parameters of one future.

    Attributes:
        arms: arms of the robot.
        kinds: kinds of the O solids, see `kind_of`.
        model: the `MjModel`, whose numbers are replaced.
        arm_qpos: (D,) indices of the arms' positions in qpos.
        arm_dofs: (D,) indices of the arms' velocities in qvel.
        solid_qpos: (O,) first indices of the solids' positions in qpos.
        solid_dofs: (O,) first indices of the solids' velocities in qvel.
    """

    arms: Arms
    kinds: tuple[str, ...]
    model: Any
    arm_qpos: np.ndarray
    arm_dofs: np.ndarray
    solid_qpos: np.ndarray
    solid_dofs: np.ndarray
    _actuators: np.ndarray = field(repr=False)
    _geoms: tuple[np.ndarray, ...] = field(repr=False)
    _bodies: tuple[int, ...] = field(repr=False)
    _fingers: np.ndarray = field(repr=False)

    @classmethod
    def compiled(cls, arms: Arms, kinds: Sequence[str]) -> CompiledScene:
        """Compile the scene of a robot and of solids of these kinds.

        Raises:
            RobotError: MuJoCo refuses the robot.
        """
        spec = _empty_spec()
        arms.add_to(spec)
        for number, kind in enumerate(kinds):
            body = spec.worldbody.add_body(name=f'solid {number}')
            body.add_freejoint(name=f'solid {number}')
            _add_pieces(body, _pieces(_EXAMPLES[kind], _SETTINGS, kind))
        try:
            model = spec.compile()
        except ValueError as error:
            raise RobotError(
                f"robot '{arms.robot.name}' cannot be used for contact: {error}"
            ) from error
        bodies = [model.body(f'solid {n}').id for n in range(len(kinds))]
        joints = [model.joint(f'solid {n}').id for n in range(len(kinds))]
        driven = [model.joint(name).id for name in arms.drives.names]
        return cls(
            arms=arms,
            kinds=tuple(kinds),
            model=model,
            arm_qpos=model.jnt_qposadr[driven],
            arm_dofs=model.jnt_dofadr[driven],
            solid_qpos=model.jnt_qposadr[joints],
            solid_dofs=model.jnt_dofadr[joints],
            _actuators=np.array([model.actuator(name).id for name in arms.drives.names], int),
            _geoms=tuple(np.flatnonzero(model.geom_bodyid == body) for body in bodies),
            _bodies=tuple(bodies),
            _fingers=np.flatnonzero(model.geom_priority > 0),
        )

    def model_of(
        self, settings: ContactSettings, solids: Sequence[Solid], data: Any = None
    ) -> Any:
        """Return the model with the parameters of the settings and of the solids.

        Args:
            settings: settings of contact.
            solids: the O solids.
            data: data of a model of this scene, which is written to; None = new data.
        """
        model = copy(self.model)
        set_drives(model, self.arms.drives, settings, self._actuators, self.arm_dofs)
        model.geom_friction[:, 0] = settings.table_friction
        model.geom_friction[self._fingers, 0] = settings.grip_friction
        model.geom_friction[:, 1] = PATCH_M
        model.geom_pos[0, 2] = settings.table_m
        model.geom_conaffinity[0] = SOLIDS | PASSED if settings.table_varies else -1
        model.eq_active0[:] = not settings.fingers_swing
        for number, solid in enumerate(solids):
            _set_pieces(model, self._bodies[number], self._geoms[number],
                        _pieces(solid, settings, self.kinds[number]))  # fmt: skip
        mujoco.mj_setConst(model, mujoco.MjData(model) if data is None else data)
        return model

    def let_pass(self, model: Any, solids: Iterable[int]) -> None:
        """Let arms pass through solids of these numbers in a model, and touch the others."""
        passed = set(solids)
        for number, geoms in enumerate(self._geoms):
            is_passed = number in passed
            model.geom_contype[geoms] = PASSED if is_passed else SOLIDS
            model.geom_conaffinity[geoms] = SOLIDS | PASSED if is_passed else -1

    def lowest_fingers(self, positions: FloatArray) -> tuple[FloatArray, list[str]]:
        """Return the height of the lowest point of all fingers, and the link that has it.

        Args:
            positions: (T, D) positions of the arms [rad or m].

        Returns:
            (T,) heights [m], and T links; infinite and '' for a robot without fingers.
        """
        names = [self.model.geom(geom).name.rpartition('/')[0] for geom in self._fingers]
        heights, links = np.full(len(positions), np.inf), [''] * len(positions)
        for row, shapes in enumerate(self.finger_shapes(positions)):
            for name, corners in zip(names, shapes, strict=True):
                if corners[:, 2].min() < heights[row]:
                    heights[row], links[row] = corners[:, 2].min(), name
        return heights, links

    def finger_shapes(self, positions: FloatArray) -> Iterator[list[FloatArray]]:
        """Yield the corners (N, 3) of the shapes of all fingers [m], with arms at (T, D)."""
        data = mujoco.MjData(self.model)
        for row in positions:
            data.qpos[self.arm_qpos] = row
            mujoco.mj_kinematics(self.model, data)
            yield [self._corners(data, geom) for geom in self._fingers]

    def _corners(self, data: Any, geom: int) -> FloatArray:
        """Return the corners (N, 3) of a shape [m]; of one that is no mesh those of its box."""
        model, mesh = self.model, self.model.geom_dataid[geom]
        if mesh >= 0:
            first = model.mesh_vertadr[mesh]
            points = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
        else:
            signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
            points = model.geom_aabb[geom, :3] + signs * model.geom_aabb[geom, 3:]
        return points @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]

    def solid_of(self, geom: int) -> int | None:
        """Return the number of the solid that a shape of the model is a piece of, if any."""
        found = (number for number, geoms in enumerate(self._geoms) if geom in geoms)
        return next(found, None)

    def positions(self, arms: FloatArray, solids: Sequence[Solid]) -> FloatArray:
        """Return MuJoCo's qpos for arm positions (D,) and the poses of the solids."""
        qpos = self.model.qpos0.copy()
        qpos[self.arm_qpos] = arms
        for first, solid in zip(self.solid_qpos, solids, strict=True):
            half = solid.yaw / 2
            qpos[first : first + 7] = *solid.centre, np.cos(half), 0.0, 0.0, np.sin(half)
        return qpos


def kind_of(solid: Solid) -> str:
    """Return the kind of a solid, which decides the pieces that it is made of."""
    wide, long, high = map(float, solid.size)
    across = min(wide, long)
    if across > MIN_DISH_WIDTH_M and across > MIN_DISH_RATIO * high:
        return 'dish' if solid.is_round else 'tray'
    if solid.is_round:
        return 'cup' if solid.is_open else 'cylinder'
    return 'box'


def _empty_spec() -> Any:
    """Return a table, and how the engine computes."""
    spec = mujoco.MjSpec()
    option = spec.option
    option.timestep, option.integrator = STEP_S, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone, option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, FRICTION_STIFFNESS_RATIO
    option.iterations, option.tolerance = SOLVER_ITERATIONS, SOLVER_TOLERANCE
    # sizes change after the trees of boxes were built; what diverges is looked at, not reset
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.compiler.balanceinertia, spec.compiler.degree = True, False
    soft = [CONTACT_TIME_STEPS * STEP_S, 1.0]
    spec.default.geom.solref = soft
    spec.default.joint.solref_limit = soft
    spec.default.equality.solref = soft
    spec.default.geom.condim = 3
    spec.worldbody.add_geom(
        name='table',
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(2.0, 2.0, 0.1),
        contype=0,
        conaffinity=-1,
    )
    return spec


def _add_pieces(body: Any, pieces: Sequence[_Piece]) -> None:
    """Add the pieces of a solid to its body in an `MjSpec`."""
    mass, middle, moments, turn = _inertia_of(pieces)
    body.explicitinertial, body.simple = True, False  # numbers change after compilation
    body.mass, body.ipos, body.inertia, body.iquat = mass, middle, moments, turn
    for piece in pieces:
        body.add_geom(
            type=_CYLINDER if piece.is_round else _BOX,
            size=piece.size,
            pos=piece.at,
            quat=(np.cos(piece.yaw / 2), 0.0, 0.0, np.sin(piece.yaw / 2)),
            contype=SOLIDS,
            conaffinity=-1,
            density=0.0,
        )


def _set_pieces(model: Any, body: int, geoms: np.ndarray, pieces: Sequence[_Piece]) -> None:
    """Write sizes, place and inertia of a solid into a model."""
    for geom, piece in zip(geoms, pieces, strict=True):
        model.geom_size[geom], model.geom_pos[geom] = piece.size, piece.at
        model.geom_aabb[geom] = *np.zeros(3), *piece.half
        model.geom_rbound[geom] = np.linalg.norm(piece.size)
    mass, middle, moments, turn = _inertia_of(pieces)
    model.body_mass[body], model.body_ipos[body] = mass, middle
    model.body_inertia[body], model.body_iquat[body] = moments, turn


def _inertia_of(pieces: Sequence[_Piece]) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """Mass, its middle (3,), moments (3,) about it and the quaternion (4,) of their axes."""
    mass = sum(piece.mass for piece in pieces)
    middle = np.sum([piece.mass * np.array(piece.at) for piece in pieces], axis=0) / mass
    inertia = np.zeros((3, 3))
    for piece in pieces:
        arm = np.array(piece.at) - middle
        inertia += piece.inertia
        inertia += piece.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    if np.abs(inertia - np.diag(np.diag(inertia))).max() < 1e-12 * np.trace(inertia):
        return mass, middle, np.diag(inertia), np.array([1.0, 0.0, 0.0, 0.0])
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 0] *= np.linalg.det(axes)
    turn = np.zeros(4)
    mujoco.mju_mat2Quat(turn, axes.ravel())
    return mass, middle, moments, turn


def _pieces(solid: Solid, settings: ContactSettings, kind: str) -> list[_Piece]:
    """Return the kind of a solid; it does not change with its size in a future."""
    wide, long, high = (max(float(extent), MIN_THICKNESS_M) for extent in solid.size)
    density = settings.density
    if kind == 'tray':
        return _tray(wide, long, high, settings)
    if kind in ('dish', 'cup'):
        rim = settings.rim_m if kind == 'dish' else settings.wall_m
        return _vessel(wide, high, rim, density)
    volume = wide * long * high * (np.pi / 4 if solid.is_round else 1.0)
    mass, at = max(volume * density, MIN_MASS_KG), (0.0, 0.0, 0.0)
    if solid.is_round:
        return [_Piece(size=(wide / 2, high / 2, 0.0), at=at, mass=mass, is_round=True)]
    return [_Piece(size=(wide / 2, long / 2, high / 2), at=at, mass=mass)]


def _vessel(wide: float, high: float, rim: float, density: float) -> list[_Piece]:
    """Round and open at the top."""
    rim = min(rim, wide / 2)
    middle, half = (wide - rim) / 2, max(high - WALL_GAP_M, MIN_THICKNESS_M) / 2
    wall = (rim / 2, float(middle * np.tan(np.pi / NUM_WALL_BOXES)) * 1.02, half)
    floor = _Piece(
        size=(middle, DISH_BOTTOM_M / 2, 0.0),
        at=(0.0, 0.0, (DISH_BOTTOM_M - high) / 2),
        mass=np.pi * middle**2 * DISH_BOTTOM_M * density,
        is_round=True,
    )
    turns = np.arange(NUM_WALL_BOXES) * 2 * np.pi / NUM_WALL_BOXES
    return [floor] + [
        _Piece(
            size=wall,
            at=(middle * np.cos(turn), middle * np.sin(turn), WALL_GAP_M / 2),
            mass=8 * float(np.prod(wall)) * density,
            yaw=float(turn),
        )
        for turn in turns
    ]


def _tray(wide: float, long: float, high: float, settings: ContactSettings) -> list[_Piece]:
    """Return the floor and the walls of a box without a lid; the floor has most of the mass."""
    x, y, wall = wide / 2, long / 2, min(settings.wall_m, wide / 2, long / 2) / 2
    half = max(high - WALL_GAP_M, MIN_THICKNESS_M) / 2
    walls = (
        ((wall, y, half), (x - wall, 0.0)),
        ((wall, y, half), (wall - x, 0.0)),
        ((x, wall, half), (0.0, y - wall)),
        ((x, wall, half), (0.0, wall - y)),
    )
    floor = (x, y, DISH_BOTTOM_M / 2)
    return [
        _Piece(size=floor, at=(0.0, 0.0, (DISH_BOTTOM_M - high) / 2), mass=0.9 * settings.tray_kg)
    ] + [
        _Piece(size=size, at=(*at, WALL_GAP_M / 2), mass=0.025 * settings.tray_kg)
        for size, at in walls
    ]


#: a solid of each kind, for the number of its pieces
_EXAMPLES = {
    kind: Solid(centre=np.zeros(3), size=np.array(size), is_round=is_round, is_open=is_open)
    for kind, size, is_round, is_open in (
        ('box', (0.04, 0.04, 0.04), False, False),
        ('cylinder', (0.04, 0.04, 0.04), True, False),
        ('cup', (0.06, 0.06, 0.08), True, True),
        ('dish', (0.12, 0.12, 0.03), True, True),
        ('tray', (0.2, 0.2, 0.05), False, True),
    )
}
_SETTINGS = ContactSettings(
    finger_stiffness=100.0,
    finger_damping=10.0,
    finger_mass_kg=0.05,
    grip_friction=1.0,
    table_friction=0.5,
    density=300.0,
    tray_kg=0.4,
)
