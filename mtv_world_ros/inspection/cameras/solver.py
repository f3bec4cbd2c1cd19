"""Robust least-squares problem of camera poses and one lens, solved by SciPy.

Unknown are the pose of the camera at each place, which is a pose in the base link or in the link
that carries the camera, and the lens that all places share. Residuals are whatever was seen:
silhouettes, clicked points, tracks of a scene. All unknowns are in one vector.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix, vstack

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.inspection.camera_pose import displaced_pose, UNITS

#: units of a lens: logarithms of fx and of fy / fx, and k1; images that were resized to another
#: aspect have pixels that are not square
LENS_UNITS = np.array([0.02, 0.02, 0.02])
#: standard deviation of where a place is, against where the background says [`UNITS`]
_OWN_STD = np.array([3.0] * 3 + [2.0] * 3)
#: first radius of the trust region, and length of the longest whitened step [`UNITS`]
_FIRST_RADIUS = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraState:
    """Poses and lens of a camera.

    Attributes:
        poses: (4, 4) T_base_camera, or T_link_camera [m], by place.
        lens: (3,) logarithms of factors of fx and of fy / fx, and what is added to k1.
        steps: (6,) sum of the steps of each place since its pose was derived from that of another
            place by the background, in `UNITS`.
    """

    poses: Mapping[int, FloatArray]
    lens: FloatArray = field(default_factory=lambda: np.zeros(3))
    steps: Mapping[int, FloatArray] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Residual:
    """Errors of the camera at one place, under Cauchy's loss.

    Attributes:
        place: number of the place.
        errors: function of T (4, 4) and lens (3,) that returns N errors.
        outlier: errors above this count less.
        weight: weight of the mean loss.
        step: step of the finite differences, in `UNITS`. Silhouettes are drawn in whole pixels
            and need a step that moves them by about one.
    """

    place: int
    errors: Callable[[FloatArray, FloatArray], NDArray[np.floating]]
    outlier: float
    weight: float = 1.0
    step: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Unknowns:
    """Unknowns of a camera problem, with their priors.

    Attributes:
        centre: (3,) point that poses are turned about; None = the camera.
        free_lens: numbers of the lens parameters that are estimated.
        lens_std: (3,) prior standard deviation of the lens.
        view_of: number of the view of each place. Places of one view are moved together; their
            own steps have a prior. Empty = all places are of one view.
        stiffness: weight of these priors.
    """

    centre: FloatArray | None = None
    free_lens: Sequence[int] = ()
    lens_std: FloatArray = field(default_factory=lambda: np.ones(3))
    view_of: Mapping[int, int] = field(default_factory=dict)
    stiffness: float = 0.0


def solve(
    residuals: Sequence[Residual],
    unknowns: Unknowns,
    start: CameraState,
    *,
    evaluations: int = 10,
    tolerance: float = 1e-4,
    whiten: bool = False,
) -> tuple[CameraState, float]:
    """Return the state near a start with the least loss, and that loss.

    Args:
        residuals: residuals of one place or of several; the other places stay.
        unknowns: unknowns and their priors.
        start: state to start from.
        evaluations: maximum number of evaluations of the residuals, without those of their slopes.
        tolerance: relative gain of the loss, and relative step, below which the search ends.
        whiten: take steps along the directions in which the residuals of a place change by equal
            amounts. A camera that circles a robot while it looks at it hardly changes the picture;
            only a large step along such a direction shows whether it is better.
    """
    problem = _Problem(residuals, unknowns, start)
    if whiten:
        problem.whiten()
    x = np.zeros(problem.size)
    found = least_squares(
        problem.errors,
        x,
        jac=problem.jacobian,  # type: ignore[arg-type]
        loss=problem.loss,  # type: ignore[arg-type]
        x_scale=(1.0 if whiten else _FIRST_RADIUS) * np.sqrt(problem.size / 6),
        ftol=tolerance,
        xtol=tolerance,
        max_nfev=evaluations,
    )
    return problem.state(found.x), float(found.cost)


def linearize(
    residual: Residual, T: FloatArray, lens: FloatArray, unknowns: Unknowns
) -> tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]:
    """Return errors (N,), their weights (N,), and their change by each of `UNITS` (6, N)."""
    errors = residual.errors(T, lens)
    slopes = _slopes(residual, T, lens, np.eye(6), unknowns, with_lens=False)
    return errors, 1 / (1 + (errors / residual.outlier) ** 2), slopes


class _Problem:
    """Residuals of a vector of unknowns: six steps of each place, then the free lens."""

    def __init__(
        self, residuals: Sequence[Residual], unknowns: Unknowns, start: CameraState
    ) -> None:
        self._residuals, self._unknowns, self._start = residuals, unknowns, start
        self._places = list(dict.fromkeys(residual.place for residual in residuals))
        self._bases = {place: np.eye(6) for place in self._places}
        self._free = list(unknowns.free_lens)
        self.size = 6 * len(self._places) + len(self._free)
        self._own = self._own_rows()
        self._at: tuple[FloatArray, list[NDArray[np.floating]]] | None = None

    def _own_rows(self) -> FloatArray:
        """Return (R, P) what makes the own steps of the places of each view of their steps.

        The step that the places of a view have in common is their mean, which minimizes the sum
        of the squared own steps.
        """
        views = np.array([self._unknowns.view_of.get(place, 0) for place in self._places])
        same = (views[:, None] == views).astype(float)
        own = np.eye(len(views)) - same / same.sum(axis=1, keepdims=True)
        return own[same.sum(axis=1) > 1]

    def whiten(self) -> None:
        """Choose the directions of the steps of each place by the residuals at the start."""
        state = self._start
        for place in self._places:
            normal = np.zeros((6, 6))
            for residual in self._residuals:
                if residual.place == place:
                    _, weights, slopes = linearize(
                        residual, state.poses[place], state.lens, self._unknowns
                    )
                    normal += residual.weight * np.asarray((weights * slopes) @ slopes.T)
            values, vectors = np.linalg.eigh(normal)
            self._bases[place] = _FIRST_RADIUS * (vectors * np.sqrt(values[0] / values)).T

    def state(self, x: FloatArray) -> CameraState:
        """Return the state of a vector of unknowns."""
        start = self._start
        poses, steps = dict(start.poses), dict(start.steps)
        for place, part in zip(self._places, x.reshape(-1)[: 6 * len(self._places)].reshape(-1, 6),
                               strict=True):  # fmt: skip
            step = part @ self._bases[place]
            poses[place] = _moved(start.poses[place], step, self._unknowns)
            steps[place] = start.steps.get(place, np.zeros(6)) + step
        lens = start.lens.copy()
        lens[self._free] += x[6 * len(self._places) :] * LENS_UNITS[self._free]
        return CameraState(poses=poses, lens=lens, steps=steps)

    def errors(self, x: FloatArray) -> FloatArray:
        """Return all errors, then those of the priors."""
        state = self.state(x)
        seen = [r.errors(state.poses[r.place], state.lens) for r in self._residuals]
        self._at = x.copy(), seen
        return np.concatenate([*seen, self._prior_errors(state)]).astype(np.float64)

    def _prior_errors(self, state: CameraState) -> FloatArray:
        steps = np.stack([state.steps[place] for place in self._places])
        own = self._own @ steps / _OWN_STD
        lens = (state.lens / self._unknowns.lens_std)[self._free]
        return np.concatenate([own.ravel(), lens])

    def loss(self, squared: FloatArray) -> FloatArray:
        """Return the loss of squared errors, and its first two derivatives (3, N).

        The second one is left out, as in iteratively reweighted least squares.
        """
        assert self._at is not None
        found = np.zeros((3, len(squared)))
        first = 0
        for residual, seen in zip(self._residuals, self._at[1], strict=True):
            rows = slice(first, first + len(seen))
            first += len(seen)
            weight, outlier = residual.weight / len(seen), residual.outlier**2
            found[0, rows] = weight * np.log1p(squared[rows] / outlier)
            found[1, rows] = weight / (outlier + squared[rows])
        found[0, first:] = self._unknowns.stiffness * squared[first:]
        found[1, first:] = self._unknowns.stiffness
        return found

    def jacobian(self, x: FloatArray) -> csr_matrix | FloatArray:
        """Return the slopes of all errors (N, size), sparse if there are several places."""
        state = self.state(x)
        blocks = []
        num_lens = len(self._free)
        for residual in self._residuals:
            slopes = _slopes(
                residual, state.poses[residual.place], state.lens, self._bases[residual.place],
                self._unknowns, with_lens=True,
            ).T  # fmt: skip
            first = 6 * self._places.index(residual.place)
            columns = [*range(first, first + 6), *range(self.size - num_lens, self.size)]
            ends = np.arange(len(slopes) + 1) * len(columns)
            indices = np.tile(columns, len(slopes))
            blocks.append(
                csr_matrix(
                    (slopes.ravel().astype(np.float64), indices, ends),
                    shape=(len(slopes), self.size),
                )
            )
        found = csr_matrix(vstack([*blocks, csr_matrix(self._prior_slopes())], format='csr'))
        return found.toarray() if len(self._places) == 1 else found

    def _prior_slopes(self) -> FloatArray:
        num = len(self._places)
        own = np.zeros((len(self._own), 6, self.size))
        for column, place in enumerate(self._places):
            slopes = self._bases[place].T / _OWN_STD[:, None]
            own[:, :, 6 * column : 6 * column + 6] = self._own[:, column, None, None] * slopes
        lens = np.zeros((len(self._free), self.size))
        lens[:, 6 * num :] = np.diag((LENS_UNITS / self._unknowns.lens_std)[self._free])
        return np.concatenate([own.reshape(-1, self.size), lens])


def _moved(T: FloatArray, step: FloatArray, unknowns: Unknowns) -> FloatArray:
    """Return a pose after a step in `UNITS`."""
    centre = T[:3, 3] if unknowns.centre is None else unknowns.centre
    return displaced_pose(T, step * UNITS, centre)


def _slopes(
    residual: Residual,
    T: FloatArray,
    lens: FloatArray,
    basis: FloatArray,
    unknowns: Unknowns,
    *,
    with_lens: bool,
) -> NDArray[np.floating]:
    """Return (6 + L, N) central differences of the errors, per unit of a step or of the lens."""
    size = residual.step
    turns = [
        residual.errors(_moved(T, size * row, unknowns), lens)
        - residual.errors(_moved(T, -size * row, unknowns), lens)
        for row in basis
    ]
    bends = [
        residual.errors(T, lens + size * step) - residual.errors(T, lens - size * step)
        for step in np.diag(LENS_UNITS)[list(unknowns.free_lens) if with_lens else []]
    ]
    return np.stack([*turns, *bends]) / (2 * size)
