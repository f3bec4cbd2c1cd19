"""Depth of measured fingers below the table that objects show, in recordings.

Fingers cannot get below a table. Where joint states say that they do, springs in the gripper gave
way, the gripper of the URDF is too long, or the cameras of a recording are off.

Shape letters: T rows, J joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.physics.engine.contact_scene import CompiledScene

#: smallest depth that is no error of the outlines that show the table [m]
MIN_DEPTH_M = 0.005
#: errors of the cameras, in standard deviations, that explain a depth
CAMERA_DEVIATIONS = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FingerDepth:
    """Deepest place of the fingers of a recording.

    Attributes:
        recording: name of the recording.
        depth_m: depth of the lowest finger below the table; negative = above it [m].
        time_s: time of the deepest place [s].
        link: link of the URDF whose shape is lowest then.
    """

    recording: str
    depth_m: float
    time_s: float
    link: str


def find_finger_depth(
    recording: str, scene: CompiledScene, positions: FloatArray, period_s: float, table_m: float
) -> FingerDepth | None:
    """Return the deepest place of the fingers of a recording; None = no table, or no fingers.

    Args:
        recording: name of the recording.
        scene: scene of the robot alone.
        positions: (T, J) measured joint positions [rad or m].
        period_s: time between two rows [s].
        table_m: height of the table as objects show it [m]; NaN = not known.
    """
    heights, links = scene.lowest_fingers(scene.arms.drives.spread(positions))
    row = int(heights.argmin())
    if not np.isfinite(table_m - heights[row]):
        return None
    return FingerDepth(
        recording=recording,
        depth_m=float(table_m - heights[row]),
        time_s=row * period_s,
        link=links[row],
    )


def depth_lines(depths: Sequence[FingerDepth], camera_m: float) -> tuple[str, ...]:
    """Return the depths in words, and what to do about them; empty = cameras explain them.

    Args:
        depths: depth of each recording.
        camera_m: error of the cameras [m].
    """
    explained = max(MIN_DEPTH_M, CAMERA_DEVIATIONS * camera_m)
    deep = [one for one in depths if one.depth_m > explained]
    if not deep:
        return ()
    each = ', '.join(
        f'{one.recording} {1e3 * one.depth_m:.0f} (at {one.time_s:.1f} s)' for one in deep
    )
    links = ', '.join(sorted({one.link for one in deep}))
    least, most = (1e3 * end(one.depth_m for one in deep) for end in (min, max))
    what = (
        f'measured fingers get below the table that objects show by [mm]: {each}; '
        f'{len(deep)} of {len(depths)} recordings, and the error of the cameras explains '
        f'{1e3 * explained:.0f}. Contact simulated there is wrong'
    )
    look = (
        'look at these frames. Where fingers are pressed on the table, springs of the gripper '
        'give way, which no joint state shows: nothing to mend. Where fingers are free, '
    )
    if len(deep) == 1:
        cause = f'the cameras of {deep[0].recording} are off: run mtv-world fit camera again'
    else:
        cause = (
            f'the link {links} of the URDF is {least:.0f} to {most:.0f} mm too long or its joint '
            'too far down: mend its <collision> or the <origin> of its joint'
        )
    return what, look + cause
