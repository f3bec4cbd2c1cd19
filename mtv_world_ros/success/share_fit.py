"""Probability of success from the share of simulated futures that succeed, with an interval."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite, nan
from typing import Annotated, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.special import betaincinv, expit, logit, ndtri

from mtv_world_ros.core.config import ListOf, Number, Schema
from mtv_world_ros.core.data_types import FloatArray

#: pseudo-count of each outcome: the uniform prior of a share (the rule of succession)
PSEUDO_COUNT = 1.0
#: coverage of intervals
COVERAGE = 0.95
#: number of quantiles of the share over which an interval is computed
_NUM_SHARES = 199
#: number of quantiles of the logistic over which an interval is computed
_NUM_FITS = 19
#: distance of an object between the imagined frames and the drawn motion beyond which the frames
#: contradict the motion, where no calibration states one [m]
MAX_PICTURE_GAP_M = 0.06


class ShareEstimate(NamedTuple):
    """Probability of success with its 95 % interval."""

    probability: float
    low: float
    high: float


def shrunk_share(share: float, num_futures: float) -> float:
    """Return the posterior mean of the success rate, given a share of successful futures."""
    return (share * num_futures + PSEUDO_COUNT) / (num_futures + 2 * PSEUDO_COUNT)


def share_logit(features: Mapping[str, float]) -> float:
    """Return the log odds of the shrunk share of features; NaN = no motion was simulated."""
    share, number = features.get('foreseen', nan), features.get('futures', nan)
    if not isfinite(share) or not isfinite(number):
        return nan
    return float(logit(shrunk_share((1 + share) / 2, number)))


class ShareFit(Schema):
    """Logistic regression on the log odds of the share of successful futures.

    The default is the share itself. The fit to episodes of known outcome corrects what futures do
    not know: shapes, masks, an engine that is not the world.

    Attributes:
        bias: logit at even odds.
        slope: logit per log odds of the share.
        covariance: covariance of bias and slope: variance, covariance, variance.
        num_episodes: number of episodes behind it; 0 = it is stated.
        max_picture_gap_m: distance of an object between the imagined frames and the drawn motion
            beyond which the frames contradict the motion [m].
    """

    bias: Number = 0.0
    slope: Annotated[Number, Field(ge=0)] = 1.0
    covariance: ListOf[Number] = (0.0, 0.0, 0.0)
    num_episodes: Annotated[int, Field(ge=0)] = 0
    max_picture_gap_m: Annotated[Number, Field(gt=0)] = MAX_PICTURE_GAP_M

    @model_validator(mode='after')
    def _is_a_covariance(self) -> Self:
        if len(self.covariance) != 3:
            raise ValueError('covariance has three numbers: variance, covariance, variance')
        bias, both, slope = self.covariance
        if min(bias, slope) < 0 or both**2 > bias * slope + 1e-9:
            raise ValueError(f'{self.covariance} is no covariance of two numbers')
        return self

    def estimate(
        self, share: float, num_futures: float, *, is_fitted: bool = True
    ) -> ShareEstimate:
        """Return the probability of success, and its interval.

        The interval holds what is unknown of the share, as few futures were drawn (a beta
        distribution), and of this logistic (normal). Where contact parameters are drawn from a
        prior, this robot has one value of each: if futures disagree, either side may be what it
        does every time, and the interval reaches from one to the other.

        Args:
            share: weighted share of the futures that succeed.
            num_futures: effective number of futures, see `ForeseenEnds.num_effective`.
            is_fitted: contact parameters were fitted in this robot cell.
        """
        middle = float(expit(self._logits(logit(shrunk_share(share, num_futures)))))
        sides = (share, share)
        if not is_fitted and 0 < share < 1:
            sides = (0.0, 1.0)
        low, high = (
            self._quantile(side, num_futures, level)
            for side, level in zip(sides, (0.5 - COVERAGE / 2, 0.5 + COVERAGE / 2), strict=True)
        )
        return ShareEstimate(middle, min(low, middle), max(high, middle))

    def _logits(self, odds: FloatArray | float) -> FloatArray:
        return np.asarray(self.bias + self.slope * np.asarray(odds))

    def _quantile(self, share: float, num_futures: float, level: float) -> float:
        """Return a quantile of the probability of success."""
        counts = np.array([share, 1 - share]) * num_futures + PSEUDO_COUNT
        rates = betaincinv(*counts, (np.arange(_NUM_SHARES) + 0.5) / _NUM_SHARES)
        odds = logit(np.clip(rates, 1e-9, 1 - 1e-9))
        bias, both, slope = self.covariance
        deviations = np.sqrt(np.maximum(bias + 2 * odds * both + odds**2 * slope, 0.0))
        errors = ndtri((np.arange(_NUM_FITS) + 0.5) / _NUM_FITS)
        logits = self._logits(odds)[:, None] + deviations[:, None] * errors
        return float(expit(np.quantile(logits, level)))
