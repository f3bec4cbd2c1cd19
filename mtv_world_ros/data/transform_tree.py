"""The frames of /tf and /tf_static: which robot link carries a camera, and its pose in it."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Collection, Iterable
from typing import Any

import numpy as np

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import CalibrationError, nearest
from mtv_world_ros.geometry.transforms import inverse, is_rigid, pose

#: a transform on /tf that varies by less than this is static [m, entries of the rotation]
_STILL = 1e-4


class TransformTree:
    """Frames and the transforms between them.

    What cannot be used (a frame's second parent, a transform that is no pose) is counted in
    `problems`, and the rest is kept.

    Args:
        prefix: of frame names, removed.
    """

    def __init__(self, prefix: str = '') -> None:
        self._prefix = prefix
        self._seen: dict[tuple[str, str], list[FloatArray]] = defaultdict(list)
        self._unusable: dict[str, int] = defaultdict(int)

    def add(self, message: Any) -> None:
        """Takes the transforms of a tf2_msgs/TFMessage."""
        for item in message.transforms:
            parent, child = self.name(item.header.frame_id), self.name(item.child_frame_id)
            p, q = item.transform.translation, item.transform.rotation
            length = np.linalg.norm((q.x, q.y, q.z, q.w))
            usable = parent != child and np.isfinite((p.x, p.y, p.z)).all() and length > 0.5
            T = pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w)) if usable else np.zeros((4, 4))
            if usable and is_rigid(T):
                self._seen[parent, child].append(T)
            else:
                self._unusable[f"'{parent}' -> '{child}'"] += 1

    def name(self, frame: str) -> str:
        """A frame's name without slash and prefix."""
        return frame.lstrip('/').removeprefix(self._prefix)

    @property
    def frames(self) -> set[str]:
        """Names of all frames."""
        return {name for edge in self._seen for name in edge}

    @property
    def problems(self) -> list[str]:
        """What was left out, a line each."""
        lines = [
            f'/tf: {count} transforms {edge} are no poses and were left out'
            for edge, count in self._unusable.items()
        ]
        kept = self._parents()
        for (parent, child), transforms in self._seen.items():
            if kept[child] != parent:
                lines.append(
                    f"/tf: frame '{child}' has two parents; '{kept[child]}' is kept, "
                    f"{len(transforms)} transforms from '{parent}' were left out"
                )
        return lines

    def mount(self, frame: str, links: Collection[str]) -> tuple[str, FloatArray]:
        """Returns the nearest of the robot's links that is fixed to a frame, and the pose in it.

        Args:
            frame: e.g. a camera's optical frame.
            links: of the robot; empty = the topmost frame that is fixed to it.

        Returns:
            The link and T_link_frame (4, 4) [m].

        Raises:
            CalibrationError: the frame is not there, or nothing fixed to it is a link.
        """
        frame = self.name(frame)
        if frame not in self.frames:
            raise CalibrationError(
                f"/tf and /tf_static have no frame '{frame}'{nearest(frame, self.frames)}; they "
                f'have {", ".join(sorted(self.frames)) or "none"}'
            )
        fixed = self._fixed_to(frame)
        if not links:
            parents = self._parents()
            top = frame
            while parents.get(top) in fixed:
                top = parents[top]
            return top, fixed[top]
        for name, T in fixed.items():  # nearest first
            if name in links:
                return name, T
        raise CalibrationError(
            f"no link of the robot is fixed to frame '{frame}': only {', '.join(fixed)} are. Is "
            'it carried by joints that are not among the robot (a camera that pans and tilts)?'
        )

    def _parents(self) -> dict[str, str]:
        """The parent of each frame; of several, the one that is published most."""
        ordered = sorted(self._seen, key=lambda edge: len(self._seen[edge]))
        return {child: parent for parent, child in ordered}

    def _fixed_to(self, frame: str) -> dict[str, FloatArray]:
        """T_other_frame of the frames that do not move against it, the nearest first.

        A breadth-first search that visits a frame once: frames in a circle end it, too.
        """
        neighbours: dict[str, list[tuple[str, FloatArray]]] = defaultdict(list)
        for child, parent in self._parents().items():
            transforms = np.stack(self._seen[parent, child])
            if np.ptp(transforms, axis=0).max() <= _STILL:
                neighbours[child].append((parent, transforms[0]))
                neighbours[parent].append((child, inverse(transforms[0])))
        found, queue = {frame: np.eye(4)}, deque([frame])
        while queue:
            here = queue.popleft()
            for other, T_other_here in neighbours[here]:
                if other not in found:
                    found[other] = T_other_here @ found[here]
                    queue.append(other)
        return found


def read_tree(messages: Iterable[Any], prefix: str = '') -> TransformTree:
    """Returns the tree of TFMessages."""
    tree = TransformTree(prefix)
    for message in messages:
        tree.add(message)
    return tree
