"""The frames of /tf and /tf_static: which robot link carries a camera, and its pose in it."""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict, deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
import pinocchio as pin

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.errors import CalibrationError
from mtv_world_ros.core.transforms import inverse, pose

#: variation below which a transform on /tf is static [m, entries of the rotation]
STILL = 1e-4
#: frames kept; a publisher that makes up a name a message must not fill the memory
_MOST_FRAMES = 2000
#: transforms kept from one frame to another that moves; at 1 kHz this is a quarter of a second
_NUM_RECENT = 256

_Numbers = tuple[float, ...]


#: maximum time between two transforms that are interpolated [s]
MAX_GAP_S = 0.5


class Mount(NamedTuple):
    """Link that carries a frame.

    Attributes:
        link: a link of the robot that is fixed to the frame.
        T_link_frame: (4, 4) pose of the frame in it [m]; of `pose_track` (N, 4, 4).
        stamp_ns: when the least recent transform between the two was published [ns]; None = all
            transforms are from /tf_static and do not change.
    """

    link: str
    T_link_frame: FloatArray
    stamp_ns: int | None


@dataclass(slots=True)
class _Edge:
    """The transforms from one frame to another: the first one and their span.

    Attributes:
        T: (4, 4) first transform [m].
        last: position and quaternion of the last transform.
        low: (4, 4) least value of each entry.
        high: (4, 4) greatest value of each entry.
        stamp_ns: stamp of the newest transform [ns]; None = from /tf_static.
        count: number of transforms.
        is_still: whether the transforms vary by no more than `STILL`.
        recent: stamps [ns] and numbers of the last ones while it moves, in the order received.
    """

    T: FloatArray
    last: _Numbers
    low: FloatArray
    high: FloatArray
    stamp_ns: int | None
    count: int = 1
    is_still: bool = True
    recent: deque[tuple[int, _Numbers]] = field(default_factory=lambda: deque(maxlen=_NUM_RECENT))

    def see(self, numbers: _Numbers, stamp_ns: int | None) -> None:
        """Add a transform: widen the span of an edge that has not moved yet."""
        self.count += 1
        if numbers != self.last and self.is_still:
            T = pose(numbers[:3], numbers[3:])
            self.low, self.high = np.minimum(self.low, T), np.maximum(self.high, T)
            self.is_still = bool((self.high - self.low).max() <= STILL)
            if not self.is_still:
                self.recent.append((self.stamp_ns or 0, self.last))
        self.last = numbers
        if not self.is_still:
            self.recent.append((stamp_ns or 0, numbers))

    def at(self, stamp_ns: int | None) -> FloatArray:
        """Return the interpolated transform (4, 4) at a time [ns]; None = the last one."""
        if self.is_still:
            return self.T
        if stamp_ns is None:
            return pose(self.last[:3], self.last[3:])
        recent = sorted(self.recent)
        after = bisect_left(recent, stamp_ns, key=lambda item: item[0])
        ends = recent[max(after - 1, 0)], recent[min(after, len(recent) - 1)]
        low, high = (pose(numbers[:3], numbers[3:]) for _, numbers in ends)
        return _between(low, high, stamp_ns, ends[0][0], ends[1][0])


class _Replacement(NamedTuple):
    """The last change of a static transform.

    Attributes:
        count: number of changes.
        old_parent: frame that the child was in before.
        parent: frame that the child is in now.
        before: (4, 4) transform before the change [m].
        after: (4, 4) newest transform [m].
    """

    count: int
    old_parent: str
    parent: str
    before: FloatArray
    after: FloatArray

    def text(self, child: str) -> str:
        """Return what was replaced, how often and by how much."""
        times = 'once' if self.count == 1 else f'{self.count} times'
        begin = f"/tf_static: the transform '{self.parent}' -> '{child}' was replaced {times}"
        if self.old_parent != self.parent:
            return f"{begin}, the last time that of '{self.old_parent}'; the newest holds for good"
        between = inverse(self.before) @ self.after
        away_m = float(np.linalg.norm(self.after[:3, 3] - self.before[:3, 3]))
        turn = math.acos(min(max((float(np.trace(between[:3, :3])) - 1) / 2, -1.0), 1.0))
        return (
            f'{begin}, the last time by one {1000 * away_m:.1f} mm and {math.degrees(turn):.2f} '
            'degrees away; the newest holds for good'
        )


class TransformTree:
    """Frames and the transforms between them, in bounded memory.

    What cannot be used (a frame's second parent, a transform that is no pose) is counted in
    `problems`, and the rest is kept. Frames in a circle and static transforms that were replaced
    are named there, too.

    Args:
        prefix: prefix of frame names, removed.
    """

    def __init__(self, prefix: str = '') -> None:
        self._prefix = prefix
        self._edges: dict[tuple[str, str], _Edge] = {}
        self._replaced: dict[str, _Replacement] = {}
        self._unusable: dict[str, int] = defaultdict(int)

    def add(self, message: Any, *, latched: bool = False) -> None:
        """Take the transforms of a tf2_msgs/TFMessage.

        Args:
            message: message of /tf or /tf_static.
            latched: whether the message is from /tf_static, whose transforms hold for all times;
                the newest wins.
        """
        for item in message.transforms:
            edge = self.name(item.header.frame_id), self.name(item.child_frame_id)
            p, q = item.transform.translation, item.transform.rotation
            numbers = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
            is_pose = _is_pose(numbers)
            num_known = len(self._edges) + len(self._unusable)
            is_room = edge in self._edges or num_known < _MOST_FRAMES
            if edge[0] != edge[1] and is_pose and is_room:
                stamp = item.header.stamp
                stamp_ns = None if latched else stamp.sec * 10**9 + stamp.nanosec
                self._add(edge, numbers, stamp_ns)
            elif is_room:
                self._unusable["'{}' -> '{}'".format(*edge)] += 1

    def _add(self, names: tuple[str, str], numbers: _Numbers, stamp_ns: int | None) -> None:
        edge = self._edges.get(names)
        is_new = edge is None or stamp_ns is None and (numbers, None) != (edge.last, edge.stamp_ns)
        if edge is None or is_new:
            T = pose(numbers[:3], numbers[3:])
            if stamp_ns is None:
                self._replace(names, T)
            self._edges[names] = _Edge(T, numbers, T, T, stamp_ns)
            return
        edge.see(numbers, stamp_ns)
        if edge.stamp_ns is not None and stamp_ns is not None:
            edge.stamp_ns = max(edge.stamp_ns, stamp_ns)

    def _replace(self, names: tuple[str, str], T: FloatArray) -> None:
        """Note that a static transform replaces others: as in tf2, the newest holds for good."""
        parent, child = names
        others = [n for n, e in self._edges.items() if n[1] == child and e.stamp_ns is None]
        for other in others:
            before = self._edges[other].T
            if other == names and np.abs(before - T).max() <= STILL:
                continue
            count = self._replaced[child].count + 1 if child in self._replaced else 1
            self._replaced[child] = _Replacement(count, other[0], parent, before, T)
            if other != names:
                del self._edges[other]

    def forget_moving(self) -> None:
        """Drop transforms of /tf (the clock jumped); those of /tf_static are kept."""
        self._edges = {k: edge for k, edge in self._edges.items() if edge.stamp_ns is None}

    def name(self, frame: str) -> str:
        """Return a frame's name without slash and prefix."""
        return frame.lstrip('/').removeprefix(self._prefix)

    @property
    def frames(self) -> set[str]:
        """Names of all frames."""
        return {name for edge in self._edges for name in edge}

    @property
    def problems(self) -> list[str]:
        """Notes on the transforms that were left out, one per line."""
        lines = [
            f'/tf: {count} transforms {edge} are no poses and were left out'
            for edge, count in self._unusable.items()
        ]
        lines += [found.text(child) for child, found in self._replaced.items()]
        kept = self._parents()
        for (parent, child), edge in self._edges.items():
            if kept[child] != parent:
                lines.append(
                    f"/tf: frame '{child}' has two parents; '{kept[child]}' is kept, "
                    f"{edge.count} transforms from '{parent}' were left out"
                )
        for circle in self._circles():
            edges = list(zip(circle, circle[1:], strict=False))
            count = sum(self._edges[names].count for names in edges)
            lines.append(
                f'/tf: frames {_quoted(circle)} go in a circle ({count} transforms); poses '
                'across it are those of the shortest way'
            )
        return lines

    def _circles(self) -> list[list[str]]:
        """Return the frames that are above themselves, from parent to child.

        The first ends each.
        """
        parents, seen, found = self._parents(), set[str](), []
        for frame in parents:
            chain: list[str] = []
            here: str | None = frame
            while here is not None and here not in seen:
                seen.add(here)
                chain.append(here)
                here = parents.get(here)
            if here in chain:
                circle = chain[chain.index(here) :]
                found.append([*reversed(circle), circle[-1]])
        return found

    def mount(self, frame: str, links: Collection[str]) -> Mount:
        """Return the nearest of the robot's links that is fixed to a frame.

        Args:
            frame: name of the frame, e.g. a camera's optical frame.
            links: links of the robot; empty = the topmost frame that is fixed to it.

        Raises:
            CalibrationError: the frame is not there, or nothing fixed to it is a link.
        """
        frame = self.name(frame)
        if frame not in self.frames:
            raise CalibrationError.unknown(
                '/tf and /tf_static have no frame',
                frame,
                sorted(self.frames),
                listed='; they have',
            )
        fixed = {}
        for mount in self._reachable(frame, only_still=True):
            if mount.link in links:
                return mount
            fixed[mount.link] = mount
        if links:
            self._refuse_circle(frame, fixed.keys())
            if not self.is_connected(frame, links):
                raise CalibrationError(
                    f"no link of the robot is fixed to frame '{frame}': TF does not connect "
                    f"'{self._top(frame)}' with the robot; mtv-world fit camera estimates the pose"
                )
            raise CalibrationError(
                f"no link of the robot is fixed to frame '{frame}': only {', '.join(fixed)} are. "
                'Is it carried by joints that are not among the robot (a camera that pans and '
                'tilts)?'
            )
        parents, top = self._parents(), frame
        while parents.get(top) in fixed:
            top = parents[top]
        return fixed[top]

    def _refuse_circle(self, frame: str, fixed: Collection[str]) -> None:
        """Raise if frames that are fixed to a frame go in a circle.

        Raises:
            CalibrationError: they do.
        """
        circle = next((c for c in self._circles() if not set(c).isdisjoint(fixed)), None)
        if circle is not None:
            raise CalibrationError(
                f"no link of the robot is fixed to frame '{frame}': it hangs in a circle, "
                f'{_quoted(circle)}'
            )

    def moving_mount(
        self, frame: str, links: Collection[str], stamp_ns: int | None = None
    ) -> Mount:
        """Return the nearest link that TF leads to, at a time [ns] or by the newest transforms.

        Raises:
            CalibrationError: TF does not lead from the frame to a link.
        """
        frame = self.name(frame)
        for mount in self._reachable(frame, only_still=False, stamp_ns=stamp_ns):
            if mount.link in links:
                return mount
        raise CalibrationError(f"/tf and /tf_static do not lead from frame '{frame}' to the robot")

    def is_moving(self, frame: str, links: Collection[str]) -> bool:
        """Return True if TF connects a frame with the robot's links, but with no link rigidly."""
        fixed = self._reachable(self.name(frame), only_still=True)
        return self.is_connected(frame, links) and all(m.link not in links for m in fixed)

    def moves_in(self, link: str, frame: str) -> bool:
        """Return True if TF has a transform from a link to a frame, and it changes over time."""
        edge = self._edges.get((self.name(link), self.name(frame)))
        return edge is not None and not edge.is_still

    def still(self, link: str, frame: str) -> FloatArray:
        """Return the transform (4, 4) from a link to a frame that does not move in it [m]."""
        return self._edges[self.name(link), self.name(frame)].T

    def path(self, frame: str, link: str) -> list[tuple[str, str]]:
        """Return the transforms, (parent, child), that lead from a frame to a link."""
        parents = self._parents()
        chains = []
        for name in (self.name(frame), link):
            chain = [name]
            while (above := parents.get(chain[-1])) is not None and above not in chain:
                chain.append(above)
            chains.append(chain)
        common = next(name for name in chains[0] if name in chains[1])
        return [
            (above, name)
            for chain in chains
            for name, above in zip(chain, chain[1:], strict=False)
            if chain.index(above) <= chain.index(common)
        ]

    def is_connected(self, frame: str, links: Collection[str]) -> bool:
        """Return True if TF connects a frame with one of the links, moving or not."""
        frame = self.name(frame)
        reached = self._reachable(frame, only_still=False)
        return frame in self.frames and any(mount.link in links for mount in reached)

    def unknown_because(self, frame: str, links: Collection[str]) -> str | None:
        """Return why TF does not have a frame's pose; '' = it lacks the frame; None = it has it.

        Args:
            frame: name of the frame, e.g. a camera's optical frame.
            links: links of the robot; empty = any frame carries it.

        Raises:
            CalibrationError: the frame hangs in a circle.
        """
        name = self.name(frame)
        if name not in self.frames:
            return ''
        if not links or self.is_connected(name, links):
            return None
        self._refuse_circle(name, {mount.link for mount in self._reachable(name, only_still=True)})
        return f"TF does not connect '{self._top(name)}' with the robot"

    def hangs_from(self, frame: str, other: str) -> bool:
        """Return whether a frame is another one, or is below it."""
        here: str | None = self.name(frame)
        seen = set[str]()
        while here is not None and here not in seen:
            if here == self.name(other):
                return True
            seen.add(here)
            here = self._parents().get(here)
        return False

    def _top(self, frame: str) -> str:
        """Return the frame that a frame hangs from and that has no parent."""
        parents = self._parents()
        while (above := parents.get(frame)) is not None:
            frame = above
        return frame

    def parent(self, frame: str) -> str | None:
        """Return a frame's parent; None = it has none."""
        return self._parents().get(self.name(frame))

    def _parents(self) -> dict[str, str]:
        """Return the parent of each frame; of several, the one that is published most."""
        ordered = sorted(self._edges, key=lambda names: self._edges[names].count)
        return {child: parent for parent, child in ordered}

    def _reachable(
        self, frame: str, *, only_still: bool, stamp_ns: int | None = None
    ) -> Iterator[Mount]:
        """Yield the frames that TF leads to as mounts, itself and the nearest first.

        A breadth-first search that visits a frame once: frames in a circle end it, too.
        """
        neighbours: dict[str, list[tuple[str, _Edge]]] = defaultdict(list)
        for child, parent in self._parents().items():
            edge = self._edges[parent, child]
            if edge.is_still or not only_still:
                neighbours[child].append((parent, edge))
                neighbours[parent].append((child, edge))
        found, queue = {frame}, deque([Mount(frame, np.eye(4), None)])
        while queue:
            here = queue.popleft()
            yield here
            for other, edge in neighbours[here.link]:
                if other not in found:
                    is_parent = self._edges.get((other, here.link)) is edge
                    T = edge.at(stamp_ns)
                    T_other_here = T if is_parent else inverse(T)
                    stamps = [s for s in (here.stamp_ns, edge.stamp_ns) if s is not None]
                    T = T_other_here @ here.T_link_frame
                    found.add(other)
                    queue.append(Mount(other, T, min(stamps, default=None)))


def _quoted(circle: Sequence[str]) -> str:
    return ' -> '.join(f"'{name}'" for name in circle)


def _is_pose(numbers: _Numbers) -> bool:
    return math.hypot(*numbers[3:]) > 0.5 and math.isfinite(sum(numbers))


def pose_track(
    messages: Sequence[Any],
    frame: str,
    links: Collection[str],
    stamps_ns: NDArray[np.int64],
    prefix: str = '',
    static: Sequence[Any] = (),
) -> Mount:
    """Return the poses of a frame that moves against every link of the robot.

    Args:
        messages: TFMessages of /tf.
        frame: name of the frame, e.g. a camera's optical frame.
        links: links of the robot; the nearest one counts.
        stamps_ns: (N,) when the poses are wanted; between two transforms they are interpolated.
        prefix: prefix of frame names, removed.
        static: TFMessages of /tf_static, in the order received.

    Raises:
        CalibrationError: TF does not lead to the robot, or has no transform near a stamp.
    """
    tree = read_tree(messages, prefix, static)
    link = tree.moving_mount(frame, links).link
    T = {name: np.tile(np.eye(4), (len(stamps_ns), 1, 1)) for name in (frame, link)}
    series = _series(messages, tree, set(tree.path(frame, link)))
    for start in (frame, link):
        name = tree.name(start)
        while True:
            edge = next((edge for edge in series if edge[1] == name), None)
            if edge is None:
                break
            T[start] = _interpolated(edge, series[edge], stamps_ns) @ T[start]
            name = edge[0]
    return Mount(link, np.linalg.inv(T[link]) @ T[frame], None)


def _series(
    messages: Sequence[Any], tree: TransformTree, edges: set[tuple[str, str]]
) -> dict[tuple[str, str], dict[int, FloatArray]]:
    """Return the transforms by stamp [ns] of each edge; a static edge has one, at stamp 0."""
    found = {edge: {} if tree.moves_in(*edge) else {0: tree.still(*edge)} for edge in edges}
    for item in (item for message in messages for item in message.transforms):
        edge = tree.name(item.header.frame_id), tree.name(item.child_frame_id)
        if edge in found and tree.moves_in(*edge):
            p, q = item.transform.translation, item.transform.rotation
            stamp = item.header.stamp.sec * 10**9 + item.header.stamp.nanosec
            if _is_pose((p.x, p.y, p.z, q.x, q.y, q.z, q.w)):
                found[edge][stamp] = pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
    return found


def _interpolated(
    edge: tuple[str, str], known: dict[int, FloatArray], stamps_ns: NDArray[np.int64]
) -> FloatArray:
    """Return the interpolated poses (N, 4, 4)."""
    if list(known) == [0]:
        return np.repeat(known[0][None], len(stamps_ns), axis=0)
    times = np.array(sorted(known), np.int64)
    after = np.searchsorted(times, stamps_ns).clip(0, len(times) - 1)
    before = np.where(times[after] <= stamps_ns, after, (after - 1).clip(0))
    apart_s = np.maximum(times[after] - stamps_ns, stamps_ns - times[before]) * 1e-9
    lost = apart_s > MAX_GAP_S
    if lost.any():
        raise CalibrationError(
            f"/tf has no transform from '{edge[0]}' to '{edge[1]}' within {MAX_GAP_S:g} s before "
            f'and after {lost.sum()} of {len(stamps_ns)} images, the first at '
            f'{stamps_ns[lost][0] * 1e-9:.3f} s; cut the recording there'
        )
    found = []
    for stamp, low, high in zip(stamps_ns, before, after, strict=True):
        ends = int(times[low]), int(times[high])
        found.append(_between(known[ends[0]], known[ends[1]], int(stamp), *ends))
    return np.array(found)


def _between(
    low: FloatArray, high: FloatArray, stamp_ns: int, low_ns: int, high_ns: int
) -> FloatArray:
    """Return the pose (4, 4) interpolated between two poses; outside of their times the nearer."""
    span_ns = high_ns - low_ns
    share = min(max((stamp_ns - low_ns) / span_ns, 0.0), 1.0) if span_ns > 0 else 0.0
    return np.array(pin.SE3.Interpolate(pin.SE3(low), pin.SE3(high), share).homogeneous)


def read_tree(
    messages: Iterable[Any], prefix: str = '', static: Iterable[Any] = ()
) -> TransformTree:
    """Return the tree of TFMessages of /tf and, in the order received, of /tf_static."""
    tree = TransformTree(prefix)
    for message in static:
        tree.add(message, latched=True)
    for message in messages:
        tree.add(message)
    return tree
