"""How often something that swings turns back."""

from __future__ import annotations

import numpy as np

from mtv_world_ros.data_types import FloatArray


def count_reversals(angles: FloatArray, swing: float) -> FloatArray:
    """Returns (T,) how often the angle has turned back by more than `swing` so far.

    Args:
        angles: (T,) without jumps of whole turns [rad].
        swing: smaller turns are noise [rad].
    """
    counts, count, heading = np.zeros(len(angles)), 0, 0
    extreme = angles[0] if len(angles) else 0.0
    for k, angle in enumerate(angles):
        if heading == 0:
            if abs(angle - extreme) > swing:
                heading, extreme = int(np.sign(angle - extreme)), angle
        elif heading * (angle - extreme) > 0:
            extreme = angle
        elif heading * (extreme - angle) > swing:
            count, heading, extreme = count + 1, -heading, angle
        counts[k] = count
    return counts
