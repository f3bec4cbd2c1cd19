"""Scenes that masks may show where something is wrong with them, foreseen by the bundled model.

Objects overlap, stand in the table or in the robot, are tiny or huge. What is foreseen of them is
where objects on a table can be, or does not count.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from robustness import wild_plans

#: time that is foreseen, and how long it may take [s of the processor]
SECONDS, MOST_S = 2.0, 12.0
#: what counts is not thrown further [m], and is no quicker than this between two rows [m/s]
FARTHEST_M, FASTEST_M_S = 4.0, 25.0


def samples() -> list[Any]:
    """A block on the table."""
    return [[_solid(np.array([0.4, 0.0, 0.025]), np.full(3, 0.05), 0.0, False, False)]]


def _solid(centre: Any, size: Any, yaw: float, is_round: bool, is_open: bool) -> Any:
    from mtv_world_ros.physics.solids import Solid

    return Solid(centre=centre, size=size, yaw=yaw, is_round=is_round, is_open=is_open)


def damaged(_: list[Any], rng: np.random.Generator) -> Any:
    """Up to twenty solids, near to each other or to the robot."""
    count = int(rng.choice([1, 2, 5, 20]))
    spread = float(rng.choice([0.005, 0.05, 0.3]))
    middle = np.array([0.35, 0.0, 0.03]) + rng.normal(0, 0.1, 3) * [1, 1, 0]
    solids = []
    for _row in range(count):
        size = 10.0 ** rng.uniform(-3 if rng.random() < 0.3 else -1.7, -0.5, 3)
        centre = middle + rng.normal(0, spread, 3)
        if rng.random() < 0.5:
            centre[2] = size[2] / 2
        is_round = bool(rng.random() < 0.3)
        size[1] = size[0] if is_round else size[1]
        solids.append(
            _solid(centre, size, float(rng.uniform(-3, 3)), is_round, bool(rng.random() < 0.3))
        )
    return solids


def foresee(solids: Any, _: Any) -> None:
    """Foresee what happens to the solids while the arms stand still.

    Raises:
        AssertionError: something that counts is where nothing can be.
    """
    from mtv_world_ros.physics.solid_foresight import TrackedSolids

    observation, _instruction = wild_plans.first_scene()
    foresight = wild_plans.bundled().judge.object_motion
    assert foresight is not None
    names = tuple(f'block {number}' for number in range(len(solids)))
    tracked = TrackedSolids(foresight=foresight, names=names, solids=tuple(solids))
    count = round(SECONDS / tracked.step_s) * tracked.commands_a_step
    commands = np.repeat(observation.positions[None], count + 1, axis=0)
    motions, then = tracked.advance(commands)
    for motion in motions:
        if not motion.weight:
            continue
        far = np.linalg.norm(motion.points - motion.points[:1], axis=-1)
        step = np.linalg.norm(np.diff(motion.points, axis=0), axis=-1) / tracked.step_s
        assert np.nanmax(far, initial=0.0) < FARTHEST_M, 'an object left, and it counts'
        assert np.nanmax(step, initial=0.0) < FASTEST_M_S, 'an object was shot, and it counts'
    lost = [motion for motion in motions if not motion.weight]
    assert not lost or then.reasons, 'futures do not count, and no word says why'
