"""The scripted expert and its faulty variants as policies: chunks of a plan by elapsed time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from mtv_world_ros.core.data_types import FloatArray, JointTrajectory, Observation
from mtv_world_ros.core.errors import PolicyError, SimulatorError
from mtv_world_ros.robot.resample import resample
from mtv_world_ros.simulation.expert.expert import Expert
from mtv_world_ros.simulation.faults.catalogue import parse_variant, PolicyVariant
from mtv_world_ros.simulation.faults.variant_faults import (
    refuse_robot,
    WayPointFaults,
    with_faults,
)
from mtv_world_ros.simulation.recorded_scene import recorded_scene
from mtv_world_ros.simulation.scenes.placement import goals_of
from mtv_world_ros.simulation.scenes.randomize import draw_scene, instruction_of
from mtv_world_ros.simulation.scenes.scene import Place, Scene
from mtv_world_ros.simulation.scenes.shapes import SHAPES
from mtv_world_ros.simulation.scenes.tasks import Move, PickPlace, START, Task, task_named
from mtv_world_ros.simulation.simulator import scene_generator

#: horizon of a chunk [s]
_CHUNK_S = 3.2
#: time between the points of a chunk [s]
_POINT_PERIOD_S = 0.1
#: default time from the end of the plan to the end of the episode [s]
HOLD_S = 0.6
#: draws of a faulty plan before the policy gives up: faults drawn at random may bring a way point
#: out of reach
_MAX_DRAWS = 20


def fault_generator(seed: int) -> np.random.Generator:
    """Return the generator that draws which move of an episode goes wrong, and to which side."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(4,)))


class ScriptedPolicy:
    """Carries out the expert's plan for one scene, with the faults of a variant.

    It knows the scene instead of looking at it, and answers by the time of the observation since
    the episode's first one. The same variant, scene and seed give the same plan.

    Args:
        variant: faults of the policy.
        expert: the scripted expert, which plans.
        task: the task to carry out.
        scene: scene with the poses of all objects.
        hold_s: time from the end of the plan to the end of the episode [s].
    """

    def __init__(
        self,
        variant: PolicyVariant,
        expert: Expert,
        task: Task,
        scene: Scene,
        hold_s: float = HOLD_S,
    ) -> None:
        self.variant, self.task, self.scene = variant, task, scene
        self._expert, self._hold_s = expert, hold_s
        self._plan: JointTrajectory | None = None
        self._first_ns: int | None = None

    @property
    def name(self) -> str:
        """Name of the variant."""
        return self.variant.name

    @property
    def instruction(self) -> str:
        """The instruction, with the names of the scene's objects."""
        return instruction_of(self.task, self.scene)

    @property
    def plan(self) -> JointTrajectory:
        """All commands of the episode, from its first observation on."""
        if self._plan is None:
            raise PolicyError(f"policy '{self.name}' was not reset; reset it before it acts")
        return self._plan

    def reset(self, *, seed: int) -> None:
        """Plan the next episode.

        Args:
            seed: seed of the plan's tempo and heights, and of the faults.

        Raises:
            PolicyError: no plan within the arms' reach, or the task has no other object to take.
        """
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(3,)))
        self._first_ns = None
        refuse_robot(self.variant, self._expert.robot)
        faults = WayPointFaults(self.variant, fault_generator(seed))
        plan = self._draw_plan(rng, faults)
        self._plan = with_faults(plan, self.variant, self._expert.robot, rng)

    def act(self, observation: Observation, instruction: str = '') -> JointTrajectory | None:
        """Return the next commands, or None where the episode is over.

        Args:
            observation: observation; only its stamp is used, which counts from the episode's first
                one.
            instruction: not used: the scene's instruction is carried out.

        Raises:
            PolicyError: not reset, or the observation is older than the episode.
        """
        del instruction
        plan = self.plan
        if self._first_ns is None:
            self._first_ns = observation.stamp_ns
        elapsed = (observation.stamp_ns - self._first_ns) / 1e9
        if elapsed < 0:
            raise PolicyError(
                f"policy '{self.name}' got an observation {-elapsed:.3f} s older than its "
                "episode's first one; reset it where an episode begins"
            )
        if elapsed >= self.seconds - 1e-6:
            return None
        num = round(_CHUNK_S / _POINT_PERIOD_S)
        times = np.linspace(_POINT_PERIOD_S, num * _POINT_PERIOD_S, num)
        return JointTrajectory(
            joint_names=plan.joint_names,
            times=times,
            positions=resample(plan, self._expert.home, elapsed + times),
            velocities=_velocities(plan, elapsed + times),
        )

    @property
    def seconds(self) -> float:
        """Duration of the episode [s]."""
        return float(self.plan.times[-1]) + self._hold_s

    def _draw_plan(self, rng: np.random.Generator, faults: WayPointFaults) -> JointTrajectory:
        is_wrong, is_miss = rng.uniform(size=2) < (
            self.variant.size('wrong_object'),
            self.variant.size('grasp_missed'),
        )
        reason = ''
        for _ in range(_MAX_DRAWS):
            for task, scene in self._intentions(rng, is_wrong=bool(is_wrong)):
                try:
                    seen = self._seen(scene, rng)
                    return self._expert.plan(task, seen, rng, miss=bool(is_miss), faults=faults)
                except SimulatorError as error:
                    reason = str(error)
        raise PolicyError(
            f"policy '{self.name}' finds no plan for task '{self.task.name}' in this scene in "
            f'{_MAX_DRAWS} draws ({reason or "it has no other object to take"}); '
            'take another seed, or smaller faults'
        )

    def _intentions(
        self, rng: np.random.Generator, *, is_wrong: bool
    ) -> Iterator[tuple[Task, Scene]]:
        """Yield the tasks and scenes that it may plan for, in order of preference."""
        if not is_wrong:
            size = self.variant.size('goal_object_moved_after')
            yield self._with_goal_object_moved(size, rng) if size else (self.task, self.scene)
            return
        number = int(rng.integers(len(self.task.moves)))
        for move in self._wrong_moves(self.task.moves[number], rng):
            moves = list(self.task.moves)
            moves[number] = move
            task = replace(self.task, moves=tuple(moves))
            items = {item.role: item for item in self.scene.objects}
            goals = list(self.scene.goals)
            goals[number] = goals_of(task, items, [(0.0, 0.0)] * len(moves))[number]
            yield task, replace(self.scene, goals=tuple(goals))

    def _with_goal_object_moved(self, size: float, rng: np.random.Generator) -> tuple[Task, Scene]:
        """Return the task with one more move, which shifts a goal object by `size` [m].

        If the goal object cannot be grasped, the subject of another move is shifted; if there is
        none, the subject of the same move is shifted once more.
        """
        own = np.random.default_rng(rng.integers(2**32))
        moves, places = self.task.moves, {i.role: i.position for i in self.scene.objects}
        places |= {m.subject: goal for m, goal in zip(moves, self.scene.goals, strict=True)}
        can_be_held = {i.role for i in self.scene.objects if SHAPES[i.shape].grasp is not None}
        move = moves[int(own.integers(len(moves)))]
        role = move.reference if isinstance(move, PickPlace) else START
        if role not in can_be_held:
            others = (other.subject for other in moves if other is not move)
            role = next(others, move.subject)
        angle, (x, y, z) = own.uniform(0, 2 * np.pi), places[role]
        goal = (x + size * float(np.cos(angle)), y + size * float(np.sin(angle)), z)
        more = PickPlace(subject=role, reference=START)
        return (
            replace(self.task, moves=(*moves, more)),
            replace(self.scene, goals=(*self.scene.goals, goal)),
        )

    def _wrong_moves(self, move: Move, rng: np.random.Generator) -> list[Move]:
        """Return the move with another object: put where the right one belongs, else put back."""
        others = [
            item.role
            for item in self.scene.objects
            if item.role != move.subject and SHAPES[item.shape].grasp is not None
        ]
        if not others:
            return []
        other = str(rng.choice(others))
        back = PickPlace(subject=other, reference=START)
        if not isinstance(move, PickPlace):
            return [back]
        reference = move.subject if move.reference == other else move.reference
        return [move.replace(subject=other, reference=reference), back]

    def _seen(self, scene: Scene, rng: np.random.Generator) -> Scene:
        """Return the scene with the policy's errors of object and goal positions."""
        subjects = {move.subject for move in self.task.moves}

        def moved(place: Place, deviation: float) -> Place:
            x, y = rng.normal(0.0, deviation, 2) if deviation else (0.0, 0.0)
            return (place[0] + float(x), place[1] + float(y), place[2])

        return replace(
            scene,
            objects=tuple(
                replace(
                    item, position=moved(item.position, self.variant.size('object_position_noise'))
                )
                if item.role in subjects
                else item
                for item in scene.objects
            ),
            goals=tuple(
                moved(goal, self.variant.size('goal_position_noise')) for goal in scene.goals
            ),
        )


def scripted_policy(
    name: str,
    task: str | Task,
    seed: int,
    expert: Expert,
    hold_s: float = HOLD_S,
) -> ScriptedPolicy:
    """Return the policy of a name, for the scene that the simulator draws for a task and a seed.

    Args:
        name: name of the policy, e.g. `expert` or `expert-miss-0.5`; see `parse_variant`.
        task: the task, or the name of a bundled one.
        seed: seed of the episode, as `SimEpisode.reset` takes it and a recorded episode has it.
        expert: the scripted expert, which plans.
        hold_s: time from the end of the plan to the end of the episode [s].

    Raises:
        PolicyError: no such policy.
        SimulatorError: no such task, or no scene for this seed.
    """
    variant, kind = parse_variant(name), task_named(task) if isinstance(task, str) else task
    scene = draw_scene(kind, scene_generator(seed), expert.workcell)
    return ScriptedPolicy(variant, expert, kind, scene, hold_s)


def policy_of_recording(
    name: str, recording: Path, expert: Expert, hold_s: float = HOLD_S
) -> ScriptedPolicy:
    """Return the policy of a name, for the scene of a simulated episode.

    Args:
        name: name of the policy, as in `scripted_policy`.
        recording: the episode's folder.
        expert: the scripted expert, which plans.
        hold_s: time from the end of the plan to the end of the episode [s].

    Raises:
        PolicyError: no such policy.
        EpisodeError: it is no simulated episode, or its scene is not known any more.
    """
    task, scene = recorded_scene(recording, expert.workcell)
    return ScriptedPolicy(parse_variant(name), expert, task, scene, hold_s)


def _velocities(plan: JointTrajectory, times: FloatArray) -> FloatArray:
    """Return (N, J) commanded velocities at the times; none after the end."""
    assert plan.velocities is not None
    columns = [np.interp(times, plan.times, column, right=0.0) for column in plan.velocities.T]
    return np.stack(columns, axis=1)
