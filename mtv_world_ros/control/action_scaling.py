"""Percentile scaling of the numbers that describe a state of the robot.

Shape letters: T states, D numbers of a state, J joints, A arms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.errors import CheckpointError

#: percentiles of the training set that become -1 and 1
PERCENTILES = (1.0, 99.0)
#: half of the smallest range that is stretched to [-1, 1] [m or rad]; smaller motion is noise
SMALLEST_HALF_RANGE = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionScaling:
    """Linear map of each number from the training set's percentiles to [-1, 1].

    Attributes:
        names: D names of the numbers.
        low: (D,) 1st percentiles.
        high: (D,) 99th percentiles.
        clip: scaled numbers are clipped to [-clip, clip].
    """

    names: tuple[str, ...]
    low: FloatArray
    high: FloatArray
    clip: float

    @classmethod
    def unfitted(cls, names: Sequence[str], clip: float) -> Self:
        """Return the identity, before the statistics of a training set are known."""
        ones = np.ones(len(names))
        return cls(names=tuple(names), low=-ones, high=ones, clip=clip)

    def fitted(self, features: Sequence[FloatArray]) -> ActionScaling:
        """Return the scaling of features, each (T, D)."""
        low, high = np.percentile(np.concatenate(features), PERCENTILES, axis=0)
        return ActionScaling(names=self.names, low=low, high=high, clip=self.clip)

    def apply(self, features: FloatArray) -> FloatArray:
        """Return (..., D) scaled numbers."""
        middle, half = (self.high + self.low) / 2, (self.high - self.low) / 2
        scaled = (features - middle) / np.maximum(half, SMALLEST_HALF_RANGE)
        return scaled.clip(-self.clip, self.clip)

    def check(self, names: tuple[str, ...]) -> None:
        """Raise CheckpointError if these are not the numbers that were fitted."""
        if names != self.names:
            raise CheckpointError(
                f'the model was trained on the numbers {list(self.names)}, the robot has '
                f'{list(names)}: such a control fits no other robot. Use the robot that it was '
                'trained with (robot_file of the node, video.robot of a training), or train anew'
            )

    def state(self) -> dict[str, Any]:
        """Return plain values."""
        return {'names': list(self.names), 'low': self.low.tolist(), 'high': self.high.tolist()}

    def restored(self, state: Mapping[str, Any]) -> ActionScaling:
        """Return the scaling with stored values.

        Raises:
            CheckpointError: the values are not finite, or their number differs.
        """
        low, high = (np.array(state[key], np.float64) for key in ('low', 'high'))
        names = tuple(str(name) for name in state['names'])
        if not low.shape == high.shape == (len(names),) or not np.isfinite([low, high]).all():
            raise CheckpointError(
                f'scaling of {len(names)} numbers has limits of shapes {low.shape} and '
                f'{high.shape}; they must be finite, one of each a number'
            )
        fitted = ActionScaling(names=names, low=low, high=high, clip=self.clip)
        fitted.check(self.names)
        return fitted


def joint_features(motion: Motion) -> FloatArray:
    """Return the (T, J) joint positions of a motion [rad or m]."""
    return np.asarray(motion.positions, np.float64)
