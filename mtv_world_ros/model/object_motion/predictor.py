"""The object motion network in use: objects found in a frame, and where a plan takes them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
import shutil
from typing import Any, TYPE_CHECKING

import numpy as np
from safetensors.torch import save_file
import torch
from torch import Tensor

from mtv_world_ros.bounded_input import read_json
from mtv_world_ros.config import validated
from mtv_world_ros.data_types import BoolArray, CameraModel, FloatArray
from mtv_world_ros.errors import CheckpointError
from mtv_world_ros.files import whole_folder, write_json
from mtv_world_ros.geometry.mask_geometry import centroids, locate_all
from mtv_world_ros.geometry.object_motion import ObjectMotion
from mtv_world_ros.geometry.object_shape import NUM_FEATURES, object_shapes
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.model.object_motion.arm_response import ArmResponse, ArmState
from mtv_world_ros.model.object_motion.contact_settings import ContactSettings
from mtv_world_ros.model.object_motion.helpers import Answer, Helpers
from mtv_world_ros.model.object_motion.network import (
    COMMANDS_A_STEP,
    Memory,
    ObjectMotionNetwork,
    Scene,
    STEP_S,
)
from mtv_world_ros.model.object_motion.stacked import stacked
from mtv_world_ros.model.tensor_files import disk_errors, read_tensors

if TYPE_CHECKING:
    from mtv_world_ros.geometry.solids import Solid
    from mtv_world_ros.model.object_motion.contact_motions import ContactMotions

#: settings of rigid bodies, beside the networks
CONTACT_FILE = 'contact.json'
#: standard deviations of where masks have an object, and of how large (relative)
_PLACE_ERROR_M, _SIZE_ERROR = 0.003, 0.04
#: objects with disturbances of their own
_MAX_OBJECTS = 16
#: how much motions of rigid bodies count together, where those of networks do one
_BODIES = 2.0
#: least height of an object's centre over the table [m]
_LEAST_HEIGHT_M = 0.004
_CONFIG, _WEIGHTS, _RESPONSE = 'config.json', 'model.safetensors', 'arm_response.json'
#: folders of further networks, in that of the first
_MEMBER = 'member_'


@dataclass(frozen=True, slots=True, kw_only=True)
class Member:
    """A trained network.

    Attributes:
        network: it.
        response: how the arms follow their commands, as it was trained with; None = at once.
    """

    network: ObjectMotionNetwork
    response: ArmResponse | None = None


class ObjectMotionPredictor:
    """Finds objects in a frame; `TrackedObjects` says where they go.

    Several networks share the motions that are foreseen, since they err in different places: the
    mean of their verdicts tells more than each alone. They compute as one, `network`.

    Args:
        members: the first says what is expected.
        robot: gives tools and grippers.
        contact: of motions of rigid bodies, foreseen beside those of the networks; None = of
            networks alone.
        num_disturbed: motions beside the expected one, from places and sizes within the error of
            what masks tell, and with the errors that the networks expect of themselves.
        helpers: that compute motions of rigid bodies beside this process; None = none do.
    """

    def __init__(
        self,
        members: Sequence[Member],
        robot: RobotModel,
        contact: ContactSettings | None = None,
        num_disturbed: int = 12,
        helpers: Helpers | None = None,
    ) -> None:
        self.members, self.robot, self.contact = tuple(members), robot, contact
        self.num_disturbed, self.helpers = num_disturbed, helpers or Helpers(0)
        networks = [member.network.eval() for member in members]
        self.network = networks[0] if len(networks) == 1 else stacked(networks)
        rng = np.random.default_rng(0)
        self._places = rng.normal(0.0, _PLACE_ERROR_M, (1 + num_disturbed, _MAX_OBJECTS, 3))
        self._scales = rng.normal(1.0, _SIZE_ERROR, (1 + num_disturbed, _MAX_OBJECTS, 1, 1))
        self._places[0], self._scales[0] = 0.0, 1.0

    @property
    def shares(self) -> list[np.ndarray]:
        """Which of the motions each member foresees."""
        return np.array_split(np.arange(len(self._places)), len(self.members))

    def with_robot(self, robot: RobotModel) -> ObjectMotionPredictor:
        """Returns the same for a robot of the same joints and tools."""
        other = copy(self)
        other.robot = robot
        return other

    def disturbed(self, points: FloatArray, features: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns (K, O, 3) places and (K, O, V, F) features; row 0 as they are."""
        item = np.arange(len(points)) % _MAX_OBJECTS
        return points + self._places[:, item], features * self._scales[:, item]

    def errors(self, first: int, count: int, num_objects: int) -> FloatArray:
        """Returns (K, T, O, 3) errors of all motions, see `ObjectMotionNetwork.roll`.

        They depend on the step since the objects were found alone, not on how a plan is cut into
        chunks; those of the expected motion are none.

        Args:
            first: step since the objects were found.
            count: T steps.
            num_objects: O.
        """
        shape = (len(self._places), _MAX_OBJECTS, 3)
        drawn = np.stack(
            [
                np.random.default_rng((1, step)).normal(size=shape)
                for step in range(first, first + count)
            ],
            axis=1,
        )
        drawn[0] = 0.0
        return drawn[:, :, np.arange(num_objects) % _MAX_OBJECTS]

    def find(
        self,
        names: Sequence[str],
        masks: BoolArray,
        cameras: Sequence[CameraModel],
        poses: Sequence[FloatArray],
    ) -> TrackedObjects:
        """Returns the objects of masks (V, O, H, W), best of the camera's own size.

        Args:
            names: O of them; those of vessels say that they are hollow.
            masks: of one frame.
            cameras: V cameras at the masks' size.
            poses: V of T_base_camera (4, 4).
        """
        points = locate_all(cameras, poses, centroids(masks))
        return self._find(names, masks, points, cameras, poses, [None] * len(names))

    def find_again(
        self,
        whole: TrackedObjects,
        names: Sequence[str],
        masks: BoolArray,
        cameras: Sequence[CameraModel],
        poses: Sequence[FloatArray],
    ) -> tuple[TrackedObjects, BoolArray, BoolArray]:
        """Returns objects that something may hide in part by now; see `ObjectMotionModel`.

        Only where motions of rigid bodies are foreseen; without them all are found anew.
        """
        nothing = np.zeros(len(names), np.bool_)
        if whole.contact is None:
            return self.find(names, masks, cameras, poses), nothing, nothing
        from mtv_world_ros.geometry.solids import find_solid

        assert self.contact is not None
        points = locate_all(cameras, poses, centroids(masks))
        before, floor = whole.contact.solids, self.contact.table_m
        rows = [
            solid and (solid, masks[:, item], points[item], cameras, poses, floor)
            for item, solid in enumerate(before)
        ]
        solids = self._shared(find_solid, rows)
        anew = self._find(names, masks, points, cameras, poses, solids)
        same = np.array([solid is not None for solid in solids], np.bool_)
        hidden = np.array([solid is not None and solid.is_hidden for solid in solids], np.bool_)
        turned = np.tile(np.eye(3), (len(names), 1, 1))
        for item in map(int, np.flatnonzero(hidden)):
            was, now = before[item], solids[item]
            assert was is not None and now is not None
            turned[item] = was.turn_to(now)
            anew.reference[item] = now.centre + turned[item] @ (whole.reference[item] - was.centre)
            anew.features[item] = whole.features[item]
        assert anew.contact is not None
        seen = Seen(
            reference=np.where(hidden[:, None], whole.reference, anew.reference),
            centres=np.where(hidden[:, None], whole.contact.centres, anew.contact.centres),
            turned=turned,
            heights=np.where(same, whole.reference[:, 2], anew.reference[:, 2]),
        )
        # one view alone tells how far away it is by its size, which is not to be relied on
        by_two = np.asarray(masks.any((-2, -1)).sum(0) > 1)
        return replace(anew, seen=seen), same & by_two, hidden

    def _shared(
        self, function: Callable[..., Answer | None], rows: Sequence[tuple[Any, ...] | None]
    ) -> list[Answer | None]:
        """What a function gives for the arguments of each row, if any; helpers do their share."""
        jobs = [row for row in rows if row is not None]
        found = iter(self.helpers.begin(function, jobs).finish())
        return [None if row is None else next(found) for row in rows]

    def _find(
        self,
        names: Sequence[str],
        masks: BoolArray,
        points: FloatArray,
        cameras: Sequence[CameraModel],
        poses: Sequence[FloatArray],
        known: Sequence[Solid | None],
    ) -> TrackedObjects:
        """What `find` returns; solids that are not known are fitted."""
        features = object_shapes(masks, points, cameras, poses)
        found = TrackedObjects(model=self, reference=points, features=features)
        response = self.members[0].response
        if self.contact is None:
            return found
        assert response is not None  # checked when it was loaded
        from mtv_world_ros.geometry.solids import fit_solid, is_vessel
        from mtv_world_ros.model.object_motion.contact_motions import ContactMotions

        floor = self.contact.table_m
        rows = [
            (masks[:, item], points[item], cameras, poses, floor, is_vessel(names[item]))
            if solid is None
            else None
            for item, solid in enumerate(known)
        ]
        fitted = self._shared(fit_solid, rows)
        solids = [solid or anew for solid, anew in zip(known, fitted, strict=True)]
        contact = ContactMotions(settings=self.contact, response=response, solids=tuple(solids))
        return replace(found, contact=contact)


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """How O objects were in the frames that their motions count from.

    Attributes:
        reference: (O, 3) where they were [m].
        centres: (O, 3) where their solids were [m].
        turned: (O, 3, 3) from there to where they were found.
        heights: (O,) of their centres when they were whole, on the table most of them [m].
    """

    reference: FloatArray
    centres: FloatArray
    turned: FloatArray
    heights: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackedObjects:
    """Objects on their way; what one chunk hands to the next.

    Attributes:
        model: says where they go.
        reference: (O, 3) where they were found [m]; NaN = not found in two views, not tracked.
        features: (O, V, F) of `object_shapes`.
        before: when they were last asked; None = nothing has moved yet.
        contact: the same objects as rigid bodies; None = networks alone.
        seen: what their motions count from; None = from where they were found.
    """

    model: ObjectMotionPredictor
    reference: FloatArray
    features: FloatArray
    before: _Before | None = None
    contact: ContactMotions | None = None
    seen: Seen | None = None

    @property
    def step_s(self) -> float:
        """Time between the rows of a motion [s]."""
        return STEP_S

    @property
    def commands_a_step(self) -> int:
        """How many joint positions `advance` takes a step: what is quick counts as well."""
        return COMMANDS_A_STEP

    @property
    def sizes(self) -> FloatArray:
        """(K, O, 3) extents in each of the motions [m].

        For the networks they are the mean of the least widths, and twice the height of the centre.
        """
        widths = self.features[..., :4]
        least = np.where((widths > 0).any(-1, keepdims=True), widths, np.inf).min(1).mean(-1)
        middle = self.reference[:, 2] if self.seen is None else self.seen.heights
        height = 2 * np.maximum(middle, _LEAST_HEIGHT_M)
        sizes = np.stack([least, least, height], axis=-1)
        sizes = np.broadcast_to(sizes, (1 + self.model.num_disturbed, *sizes.shape))
        return sizes if self.contact is None else np.concatenate([sizes, self.contact.sizes])

    @property
    def reasons(self) -> tuple[str, ...]:
        """Nothing is doubted."""
        return ()

    def advance(
        self, positions: FloatArray, should_stop: Callable[[], bool] = lambda: False
    ) -> tuple[tuple[ObjectMotion, ...], TrackedObjects]:
        """Returns where they are at each of 1 + T steps, and then.

        The first motion is the expected one, the others are of disturbed places and sizes. Row 0
        is where they are now.

        Args:
            positions: (1 + T * `commands_a_step`, J) that are commanded [rad or m].
            should_stop: not asked.
        """
        known = np.asarray(np.isfinite(self.reference).all(-1))
        places, features = self.model.disturbed(
            np.where(known[:, None], self.reference, 0.0), self.features
        )
        first = self.before.steps if self.before else 0
        count = (len(positions) - 1) // self.commands_a_step
        errors = self.model.errors(first, count, known.size)
        contact, robot, every = self.contact, self.model.robot, self.commands_a_step
        finish = contact and contact.begin(robot, positions, every, self.model.helpers)
        tools, gaps, arms = self._tools(positions)
        # a part of the batch each, of the same size; what fills it up is left out again
        most = max(map(len, self.model.shares))
        rows = np.stack([np.resize(share, most) for share in self.model.shares])
        kept = np.concatenate([np.arange(most) < len(share) for share in self.model.shares])
        rows = rows.ravel()
        scene = Scene(
            points=_tensor(places[rows]),
            features=_tensor(features[rows]),
            present=torch.from_numpy(known).expand(len(rows), -1),
            tools=_tensor(tools).repeat_interleave(most, 0),
            gaps=_tensor(gaps).repeat_interleave(most, 0),
        )
        with torch.inference_mode():
            motion, memory = self.model.network.roll(
                scene,
                self.before and self.before.memory,
                skip=1,
                errors=_tensor(errors[rows]),
            )
        ways = motion.points.double().numpy() - places[rows, None]
        points = np.where(known[:, None], self.reference + ways, np.nan)[kept]
        rotations = motion.rotations.double().numpy()[kept]
        seen = self.seen
        reference = self.reference if seen is None else seen.reference
        motions = [
            ObjectMotion(reference=reference, points=way, rotations=turns)
            for way, turns in zip(points, rotations, strict=True)
        ]
        if finish is not None:
            bodies, contact = finish()
            motions += [
                ObjectMotion(
                    reference=contact.centres if seen is None else seen.centres,
                    points=way,
                    rotations=turns,
                    openings=robot.gripper_openings(joints).T,
                    weight=_BODIES * len(motions) / len(bodies.points),
                )
                for way, turns, joints in zip(
                    bodies.points, bodies.rotations, bodies.joints, strict=True
                )
            ]
        if seen is not None:
            motions = [replace(one, rotations=one.rotations @ seen.turned) for one in motions]
        before = _Before(
            memory=memory, tools=tools[:, -2], gaps=gaps[:, -2], arms=arms, steps=first + count
        )
        return tuple(motions), replace(self, before=before, contact=contact)

    def _tools(
        self, positions: FloatArray
    ) -> tuple[FloatArray, FloatArray, tuple[ArmState | None, ...]]:
        """Tools (M, T + 2, A, 4, 4) and gaps (M, T + 2, A) of M members, and their arms' states.

        Row 0 is one step before.
        """
        robot, every = self.model.robot, self.commands_a_step
        gaps = robot.finger_gaps(positions[::every])
        rows, arms = [], []
        followed: dict[int, tuple[FloatArray, ArmState | None]] = {}
        for number, member in enumerate(self.model.members):
            response = member.response
            if id(response) not in followed:  # members share it
                last = self.before.arms[number] if self.before else None
                where, state = (
                    (positions, None)
                    if response is None
                    else response.follow(robot, positions, last)
                )
                followed[id(response)] = robot.tool_poses(where[::every]), state
            tools, state = followed[id(response)]
            rows.append(tools.transpose(1, 0, 2, 3))
            arms.append(state)
        tools, gaps = np.stack(rows), np.stack([gaps] * len(rows))
        before = (tools[:, 0], gaps[:, 0])
        if self.before:
            before = (self.before.tools, self.before.gaps)
        return (
            np.concatenate([before[0][:, None], tools], axis=1),
            np.concatenate([before[1][:, None], gaps], axis=1),
            tuple(arms),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Before:
    """What the motions go on from.

    Attributes:
        memory: of the networks.
        tools: (M, A, 4, 4) T_base_tool of each member one step before.
        gaps: (M, A) one step before [m].
        arms: where the arms really are by now, with a response.
        steps: since the objects were found.
    """

    memory: Memory
    tools: FloatArray
    gaps: FloatArray
    arms: tuple[ArmState | None, ...]
    steps: int


def _tensor(values: FloatArray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))


def save_network(
    network: ObjectMotionNetwork, folder: Path, response: ArmResponse | None = None
) -> None:
    """Writes a network into a folder; one that was there stays until the new one is complete.

    Settings of rigid bodies, which no network is trained with, stay.

    Args:
        network: trained.
        folder: of it.
        response: how the arms follow their commands, as it was trained with.
    """
    tensors = {name: value.contiguous() for name, value in network.state_dict().items()}
    with disk_errors(), whole_folder(folder) as partial:
        save_file(tensors, partial / _WEIGHTS)
        write_json(partial / _CONFIG, network.config)
        if response is not None:
            write_json(partial / _RESPONSE, response.as_json())
        if (folder / CONTACT_FILE).exists():
            shutil.copyfile(folder / CONTACT_FILE, partial / CONTACT_FILE)


def load_network(folder: Path) -> ObjectMotionNetwork:
    """Reads a network.

    Raises:
        CheckpointError: the folder is not there, or what it holds is not whole.
    """
    try:
        network = ObjectMotionNetwork(**read_json(folder / _CONFIG))
        network.load_state_dict(read_tensors(folder / _WEIGHTS))
    except (OSError, ValueError, TypeError, RuntimeError, CheckpointError) as error:
        raise CheckpointError(f"'{folder}' cannot be used: {error}; train it anew") from error
    return network


def load_response(folder: Path, robot: RobotModel) -> ArmResponse | None:
    """Reads the response that a network was trained with; None = with the commands themselves.

    Raises:
        CheckpointError: the file is not whole, or of another robot.
    """
    file = folder / _RESPONSE
    if not file.exists():
        return None
    try:
        return ArmResponse.from_json(read_json(file), robot.joint_names)
    except KeyError as error:
        raise CheckpointError(
            f"'{file}' has no {error}, which robot '{robot.name}' has; run 'mtv-world "
            "train-motion' with episodes of this robot"
        ) from error
    except (OSError, ValueError, TypeError) as error:
        raise CheckpointError(f"'{file}' cannot be used: {error}; train it anew") from error


def save_contact(contact: ContactSettings, folder: Path) -> None:
    """Writes settings of rigid bodies beside the networks of a checkpoint."""
    write_json(folder / CONTACT_FILE, contact.model_dump(mode='json'))


def add_members(folder: Path, others: Sequence[Path]) -> None:
    """Copies networks into the folder of another, which they foresee with from now on.

    Raises:
        CheckpointError: one of them is not there, not whole, or of another number of views.
    """
    views = load_network(folder).config['num_features']
    for number, other in enumerate(others, 1):
        given = load_network(other).config['num_features']
        if given != views:
            raise CheckpointError(
                f"'{other}' describes objects by {given} numbers, '{folder}' by {views}; give "
                'networks of the same views'
            )
        with disk_errors(), whole_folder(folder / f'{_MEMBER}{number}') as partial:
            for name in (_CONFIG, _WEIGHTS, _RESPONSE):
                if (other / name).exists():
                    shutil.copyfile(other / name, partial / name)


def load_predictor(folder: Path, robot: RobotModel, processes: int = 1) -> ObjectMotionPredictor:
    """Reads what `train-motion` wrote.

    Args:
        folder: that it wrote.
        robot: of the same joints.
        processes: at most, this one among them, that compute motions of rigid bodies.

    Raises:
        CheckpointError: see `load_network`, `load_response`, `load_contact`.
        RobotError: the robot cannot be computed as rigid bodies, which the checkpoint asks for.
    """
    contact = load_contact(folder)
    folders = [folder, *sorted(folder.glob(f'{_MEMBER}*'))]
    members: list[Member] = []
    for each in folders:
        response = load_response(each, robot)
        for other in members:
            if response and other.response and other.response.as_json() == response.as_json():
                response = other.response
        members.append(Member(network=load_network(each), response=response))
    helpers = None
    if contact is not None:
        from mtv_world_ros.model.object_motion.contact_motions import check_robot

        response = members[0].response
        if response is None:
            raise CheckpointError(
                f"'{folder / CONTACT_FILE}' asks for rigid bodies, but '{_RESPONSE}' beside it is "
                "missing; run 'mtv-world train-motion'"
            )
        check_robot(contact, robot, response)
        count = min(processes, contact.num_motions) - 1
        if count > 0:
            helpers = Helpers(count)
            helpers.start(check_robot)
    return ObjectMotionPredictor(members, robot, contact, helpers=helpers)


def load_contact(folder: Path) -> ContactSettings | None:
    """Reads settings of rigid bodies; None = motions of networks alone are foreseen.

    Raises:
        CheckpointError: the file cannot be used, or what computes rigid bodies is not installed.
    """
    file = folder / CONTACT_FILE
    if not file.exists():
        return None
    missing = [name for name in ('dartpy', 'scipy') if find_spec(name) is None]
    if missing:
        raise CheckpointError(
            f"'{file}' asks for rigid bodies; run 'pip install {' '.join(missing)}', or remove "
            'the file to foresee by networks alone'
        )
    try:
        values = read_json(file)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"'{file}' cannot be used: {error}; fit it anew") from error
    return validated(ContactSettings, values, f"'{file}'", error=CheckpointError)


def num_features(num_views: int) -> int:
    """Returns how many numbers describe an object that so many views see."""
    return num_views * NUM_FEATURES
