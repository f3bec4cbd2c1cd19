"""Batches of windows of recorded tracks, drawn at random.

Shape letters: B windows of a batch, T steps, O objects, A tools; K tracks, R rows of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
import torch
from torch import Tensor

from mtv_world_ros.lab.training.object_motion.tracks import ObjectTracks
from mtv_world_ros.model.object_motion.network import Scene

#: steps of a training window
WINDOW = 48
#: share of the windows that begin where their episode does
_FROM_START = 0.35
#: standard deviation of where objects are thought to be at first [m]; masks of 384x288 pixels tell
#: it to .6 mm in the plane and 2 mm in height
_PLACE_NOISE_M = 0.001
#: relative one of their features
_SHAPE_NOISE = 0.02
#: siblings have parted where their objects are further apart [m]
_PARTED_M = 0.01
#: of batches, the share drawn as groups of siblings, and the most siblings of a group
_SIBLINGS_SHARE, _GROUP = 0.15, 4
#: rows of tracks that have no object
_OF_TOOLS = ('tools', 'gaps', 'recorded_tools', 'recorded_gaps')


@dataclass(frozen=True, slots=True, kw_only=True)
class Batch:
    """Windows, and what really happens in them.

    Attributes:
        scene: that the network is given.
        points: (B, T + 1, O, 3) [m].
        rotations: (B, T + 1, O, 3, 3) from the episode's start.
        known: (B, T + 1, O) bool.
        turns_known: (B,) bool, see `ObjectTracks`.
        parted: (B, T + 1, O) bool, where a sibling of the batch has the object elsewhere.
        tools: (B, T + 1, A, 4, 4) T_base_tool as they really are.
        gaps: (B, T + 1, A) likewise [m].
    """

    scene: Scene
    points: Tensor
    rotations: Tensor
    known: Tensor
    turns_known: Tensor
    parted: Tensor
    tools: Tensor
    gaps: Tensor


class TrackPool:
    """Tracks of one number of objects, end to end on a device.

    Args:
        tracks: of as many objects each.
        device: for their numbers.
    """

    def __init__(self, tracks: Sequence[ObjectTracks], device: torch.device | str = 'cpu') -> None:
        self.lengths = np.array([len(track.points) for track in tracks])
        self.offsets = np.cumsum(self.lengths) - self.lengths
        self._rows = {
            name: torch.from_numpy(
                np.concatenate([_single(getattr(track, name)) for track in tracks])
            ).to(device)
            for name in (*_OF_TOOLS, 'points', 'rotations', 'known')
        }
        self._features = torch.from_numpy(
            np.stack([_single(track.features) for track in tracks])
        ).to(device)
        self._turns_known = torch.tensor([track.turns_known for track in tracks]).to(device)
        scenes: dict[str, list[int]] = {}
        for number, track in enumerate(tracks):
            if track.scene:
                scenes.setdefault(track.scene, []).append(number)
        #: of each scene that several tracks share, their numbers
        self.families = [np.array(family) for family in scenes.values() if len(family) > 1]

    def __len__(self) -> int:
        return len(self.lengths)

    def draw(self, size: int, rng: np.random.Generator) -> Batch:
        """Returns a batch of windows; siblings in it begin at the same time."""
        groups = self._drawn(size, rng)
        starts = []
        for group in groups:
            last, start = int(self.lengths[group].min()) - 1, 0
            if last > WINDOW and rng.random() >= _FROM_START:
                start = int(rng.integers(0, last - WINDOW))
            starts.append(start)
        sizes = [len(group) for group in groups]
        steps = np.repeat(starts, sizes)[:, None] + np.arange(WINDOW + 1)
        batch = self._batch(
            np.concatenate(groups),
            steps,
            np.repeat(np.arange(len(groups)), sizes),
            rng,
        )
        return _turned(batch, rng)

    def whole(self, number: int) -> Batch:
        """Returns one track from its first to its last row, as it is."""
        steps = np.arange(self.lengths[number])[None]
        return self._batch(np.array([number]), steps, np.array([0]), None)

    def _drawn(self, size: int, rng: np.random.Generator) -> list[np.ndarray]:
        """A batch of `size` tracks: some in groups of siblings if there are any, others alone."""
        groups, left = [], size
        while self.families and left > size * (1 - _SIBLINGS_SHARE):
            family = self.families[int(rng.integers(len(self.families)))]
            groups.append(rng.permutation(family)[: min(_GROUP, left)])
            left -= len(groups[-1])
        return [*groups, *rng.integers(len(self), size=(left, 1))]

    def _batch(
        self,
        tracks: np.ndarray,
        steps: np.ndarray,
        groups: np.ndarray,
        rng: np.random.Generator | None,
    ) -> Batch:
        """Steps (B, T + 1) of tracks (B,) in groups (B,); past its end, a track stays.

        With `rng`, the objects in an order of their own, seen a little elsewhere.
        """
        device = self._features.device
        steps = np.minimum(steps, self.lengths[tracks, None] - 1)
        shape = (len(tracks), self._features.shape[1])
        order = np.broadcast_to(np.arange(shape[1]), shape)
        noise, scale = np.zeros((*shape, 3)), np.ones((*shape, 1, self._features.shape[3]))
        if rng is not None:
            order = rng.permuted(order, axis=1)
            noise = rng.normal(0.0, _PLACE_NOISE_M, noise.shape)
            scale = rng.normal(1.0, _SHAPE_NOISE, scale.shape)
        chosen = torch.from_numpy(tracks).to(device)
        rows = torch.from_numpy(self.offsets[tracks, None] + steps).to(device)
        first = torch.from_numpy(self.offsets[tracks]).to(device)
        picked = torch.from_numpy(order.copy()).to(device)
        moved = torch.from_numpy(_single(noise)).to(device)
        scaled = torch.from_numpy(_single(scale)).to(device)

        def of(name: str, at: Tensor) -> Tensor:
            values = self._rows[name][at]
            if name in _OF_TOOLS:
                return values
            extra = values.ndim - at.ndim - 1
            index = picked.view(len(tracks), *[1] * (at.ndim - 1), -1, *[1] * extra)
            return torch.take_along_dim(values, index, at.ndim)

        points = of('points', rows)
        features = self._features[chosen]
        scene = Scene(
            points=of('points', first) + moved,
            features=torch.take_along_dim(features, picked[..., None, None], 1) * scaled,
            present=of('known', first),
            tools=of('tools', rows),
            gaps=of('gaps', rows),
        )
        return Batch(
            scene=scene,
            points=points + moved[:, None],
            rotations=of('rotations', rows),
            known=of('known', rows),
            turns_known=self._turns_known[chosen],
            parted=_parted(self._rows['points'][rows], groups, picked),
            tools=of('recorded_tools', rows),
            gaps=of('recorded_gaps', rows),
        )


def pools_of(tracks: Sequence[ObjectTracks], device: torch.device | str) -> list[TrackPool]:
    """Returns the tracks by their number of objects, or on a GPU all of them filled up to one.

    A GPU waits for each size of a batch until its kernels are compiled, and has room.
    """
    if torch.device(device).type == 'cuda':
        most = max(len(track.features) for track in tracks)
        tracks = [filled_up(track, most) for track in tracks]
    pools: dict[int, list[ObjectTracks]] = {}
    for track in tracks:
        pools.setdefault(len(track.features), []).append(track)
    return [TrackPool(own, device) for own in pools.values()]


def filled_up(track: ObjectTracks, count: int) -> ObjectTracks:
    """Returns a track with objects that are not there, up to a count."""
    missing = count - len(track.features)
    if not missing:
        return track

    def filled(values: np.ndarray, axis: int) -> np.ndarray:
        shape = list(values.shape)
        shape[axis] = missing
        return np.concatenate([values, np.zeros(shape, values.dtype)], axis)

    return replace(
        track,
        features=filled(track.features, 0),
        points=filled(track.points, 1),
        rotations=filled(track.rotations, 1),
        known=filled(track.known, 1),
    )


def _single(values: np.ndarray) -> np.ndarray:
    return values if values.dtype == bool else values.astype(np.float32)


def _parted(points: Tensor, groups: np.ndarray, order: Tensor) -> Tensor:
    """(B, T + 1, O) of points (B, T + 1, O, 3), before the objects (B, O) were put in order."""
    parted = torch.zeros(points.shape[:3], dtype=torch.bool, device=points.device)
    shared = np.flatnonzero(np.bincount(groups)[groups] > 1)
    if len(shared):
        at, group = torch.from_numpy(shared).to(points.device), groups[shared]
        same = torch.from_numpy(group[:, None] == group).to(points.device)
        own = points[at]
        apart = (own[:, None] - own).norm(dim=-1) > _PARTED_M
        parted[at] = (apart & same[:, :, None, None]).any(1)
    return torch.take_along_dim(parted, order[:, None], 2)


def _turned(batch: Batch, rng: np.random.Generator) -> Batch:
    """The batch turned by a multiple of 45 degrees about the vertical, or mirrored as well.

    Contact does not know where on the table it happens. Mirrored tools have their x axis turned
    back, which two-fingered grippers do not notice.
    """
    turns, mirrored = int(rng.integers(8)), bool(rng.random() < 0.5)
    cos, sin = math.cos(turns * math.pi / 4), math.sin(turns * math.pi / 4)
    device = batch.points.device
    mirror = torch.diag(torch.tensor([-1.0 if mirrored else 1.0, 1.0, 1.0])).to(device)
    turn = torch.tensor([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]).to(device)
    both, scene = turn @ mirror, batch.scene
    widths, heights = scene.features[..., :4], scene.features[..., 4:6]
    if mirrored:
        widths = widths[..., [0, 3, 2, 1]]
    widths = torch.roll(widths, turns % 4, -1)
    features = torch.cat([widths, heights, scene.features[..., 6:] @ both.T], -1)

    def turned(tools: Tensor) -> Tensor:
        tools = tools.clone()
        tools[..., :3, 3] = tools[..., :3, 3] @ both.T
        tools[..., :3, :3] = both @ tools[..., :3, :3] @ mirror
        return tools

    return replace(
        batch,
        scene=replace(
            scene, points=scene.points @ both.T, features=features, tools=turned(scene.tools)
        ),
        points=batch.points @ both.T,
        rotations=both @ batch.rotations @ both.T,
        tools=turned(batch.tools),
    )
