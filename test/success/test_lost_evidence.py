"""Losing evidence widens: the interval without it holds the one with it, or there is no verdict.

Each kind of evidence that an estimate is made of is removed or damaged, with paths and ends that
are drawn at random. A field of the evidence that no case here names fails the first test.
"""

from dataclasses import fields, replace

import numpy as np
import pytest

from mtv_world_ros.core.data_types import SuccessEstimate
from mtv_world_ros.core.files import share_path
from mtv_world_ros.physics.foreseen_motions import ForeseenMotions
from mtv_world_ros.success.calibration import Calibration, load_fit
from mtv_world_ros.success.doubts import Grounds, widened
from mtv_world_ros.success.estimator import load_tasks, SuccessEstimator
from mtv_world_ros.success.footage_memory import Footage
from test.support.drawn_blocks import BLUE, footage, LEFT, masks, NAMES, path, RED, STACK

TASKS = load_tasks(share_path('config', 'tasks'))
FIT = load_fit(share_path('resource', 'checkpoint'), Calibration).replace(fitted_to=None)
GOALS = {LEFT: (BLUE[0] - 0.13, BLUE[1], 0.025), STACK: (BLUE[0], BLUE[1], 0.065)}
SEEDS = range(6)


class Colour:
    name = 'colour'


def estimator(fit=FIT):
    return SuccessEstimator(TASKS, calibration=fit, segmenter=Colour())


def assert_holds(new: SuccessEstimate, old: SuccessEstimate, tolerance: float = 1e-9) -> None:
    """Fail unless the new interval holds the old one, or there is no verdict."""
    if np.isnan(new.probability) or np.isnan(old.probability):
        assert np.isnan(new.probability)
        return
    (low, high), (old_low, old_high) = new.interval, old.interval
    assert low <= old_low + tolerance and high >= old_high - tolerance, (new, old)
    assert low <= new.probability <= high


class Case:
    """A rollout whose objects, grippers and futures are drawn at random."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.instruction = (LEFT, STACK)[seed % 2]
        goal = np.array(GOALS[self.instruction])
        self.rng, self.end = rng, goal + rng.normal(0, [0.03, 0.03, 0.002]) * rng.integers(0, 2)
        moving = path(RED, self.end)
        shown = masks(moving, [BLUE] * 9)
        opening = rng.choice([0.1, 1.0])
        openings = np.linspace([1.0, 1.0], [opening, 1.0], 10).T
        tools = np.stack([np.concatenate([[RED], moving]), np.full((10, 3), 0.5)])
        self.footage = replace(
            footage(shown, masks([RED], [BLUE])), openings=openings, tools=tools
        )
        self.foreseen = self.futures(rng)

    def futures(self, rng) -> ForeseenMotions:
        share = rng.choice([0.0, 0.3, 0.9, 1.0])
        ends = [GOALS[self.instruction] if rng.random() < share else RED for _ in range(16)]
        points = []
        for end in ends:
            red = path(RED, end)
            points.append([[at, BLUE] for at in (*red, *[red[-1]] * 10)])
        points = np.array(points, float)
        return ForeseenMotions(
            names=NAMES,
            points=points,
            rotations=np.broadcast_to(np.eye(3), (*points.shape, 3)),
            sizes=np.broadcast_to([[0.05] * 3, [0.04] * 3], (16, 2, 3)),
            openings=np.ones((16, 2, points.shape[1])),
            weights=np.ones(16),
            tools=np.full((2, points.shape[1], 3), 0.5),
        )

    def judged(self, *, foreseen=None, is_real=False, fit=FIT, **changes) -> SuccessEstimate:
        return (
            estimator(fit)
            .estimate(
                replace(self.footage, **changes),
                self.instruction,
                foreseen=foreseen,
                is_real=is_real,
            )
            .estimate
        )


def lost_masks(found, rng):
    """Masks without one object in one view, by their status."""
    view, item = rng.integers(0, 2, 2)
    status = [list(row) for row in found.status]
    status[view][item] = 'lost'
    return replace(found, status=tuple(map(tuple, status)))


def empty_masks(found, rng):
    """Masks without one object at the end of one view."""
    view, item = rng.integers(0, 2, 2)
    shown = found.masks.copy()
    shown[view, item, -rng.integers(1, shown.shape[2] + 1) :] = False
    return replace(found, masks=shown)


def removed(case: Case, name: str):
    """Changes of the footage without one kind of evidence."""
    return {
        'masks': {'masks': lost_masks(case.footage.masks, case.rng)},
        'empty masks': {'masks': empty_masks(case.footage.masks, case.rng)},
        'start_masks': {'start_masks': lost_masks(case.footage.start_masks, case.rng)},
        'tools': {'tools': None},
        'openings': {'openings': None},
        'tools and openings': {'tools': None, 'openings': None},
    }[name]


OF_FOOTAGE = (
    'masks', 'empty masks', 'start_masks', 'tools', 'openings', 'tools and openings',
)  # fmt: skip
#: those of frames after the start
OF_PICTURES = ('masks', 'empty masks')


def test_every_field_of_the_evidence_has_a_case():
    """Cameras and their poses are the frame that the rest is told in; see `camera_check`."""
    known = {'cameras', 'poses', *OF_FOOTAGE}
    assert {field.name for field in fields(Footage)} <= known
    # what a future is: its outcome, or none; the clock and the pictures' choice are no evidence
    of_futures = {'names', 'points', 'rotations', 'sizes', 'openings', 'weights', 'tools'}
    no_evidence = {'step_s', 'shown'}
    assert {f.name for f in fields(ForeseenMotions)} == of_futures | no_evidence | {
        'is_begun', 'is_fitted',
    }  # fmt: skip


@pytest.mark.parametrize('seed', SEEDS)
@pytest.mark.parametrize(
    ('name', 'kind'),
    [
        (name, kind)
        for kind in ('foreseen', 'imagined', 'real')
        for name in OF_FOOTAGE
        # imagined frames are no evidence for futures: they can only widen, see below
        if not (kind == 'foreseen' and name in OF_PICTURES)
    ],
)
def test_footage(name, kind, seed):
    case = Case(seed)
    options = {
        'foreseen': case.foreseen if kind == 'foreseen' else None,
        'is_real': kind == 'real',
    }
    assert_holds(case.judged(**options, **removed(case, name)), case.judged(**options))


@pytest.mark.parametrize('seed', SEEDS)
def test_futures_that_are_lost(seed):
    """A simulation that diverged may have succeeded, or failed."""
    case = Case(seed)
    lost = case.foreseen.weights.copy()
    lost[case.rng.choice(16, case.rng.integers(1, 15), replace=False)] = 0.0
    new = case.judged(foreseen=replace(case.foreseen, weights=lost))
    assert_holds(new, case.judged(foreseen=case.foreseen))
    # those that spoke against the rest
    done = np.array(case.judged(foreseen=case.foreseen).futures.outcomes)
    if done.any() and not done.all():
        for kept in (done, ~done):
            new = case.judged(foreseen=replace(case.foreseen, weights=kept.astype(float)))
            assert_holds(new, case.judged(foreseen=case.foreseen))


@pytest.mark.parametrize('seed', SEEDS)
def test_the_robot_cell_and_the_fit(seed):
    case = Case(seed)
    old = case.judged(foreseen=case.foreseen)
    new = case.judged(foreseen=replace(case.foreseen, is_fitted=False))
    assert_holds(new, old)
    assert not new.is_calibrated
    # another task or segmenter than those of the fit
    for change in ({'tasks': ('shake_bottle',)}, {'segmenter': 'sam2'}):
        assert_holds(case.judged(foreseen=case.foreseen, fit=FIT.replace(**change)), old)


@pytest.mark.parametrize('seed', SEEDS)
@pytest.mark.parametrize('foreseen', [True, False])
def test_doubts(seed, foreseen):
    case = Case(seed)
    old = case.judged(foreseen=case.foreseen if foreseen else None)
    assert_holds(widened(old, 'the physics here is not the one that was fitted'), old)
    assert_holds(Grounds.of('guessed', is_calibrated=False).bear(old), old)


@pytest.mark.parametrize('seed', SEEDS)
def test_pictures_can_only_widen_what_is_foreseen(seed):
    """Those that agree leave it, those that contradict or show nothing do not make it surer."""
    case = Case(seed)
    futures = case.judged(foreseen=case.foreseen).futures
    elsewhere = masks(path(RED, RED), [BLUE] * 9)
    for shown in (case.footage.masks, elsewhere, empty_masks(case.footage.masks, case.rng)):
        found = case.judged(foreseen=case.foreseen, masks=shown)
        (low, high), (alone_low, alone_high) = found.interval, futures.interval
        assert low <= alone_low + 1e-9 and high >= alone_high - 1e-9
