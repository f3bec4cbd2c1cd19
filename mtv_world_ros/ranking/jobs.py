"""The jobs of a ranking: one policy on one episode each, and what it reached there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from math import isfinite, nan
from typing import Annotated, Any

from pydantic import BeforeValidator, ConfigDict, TypeAdapter

from mtv_world_ros.core.data_types import SuccessEstimate
from mtv_world_ros.core.errors import ConfigError, PolicyError, SimulatorError
from mtv_world_ros.core.estimate_words import cannot_tell
from mtv_world_ros.simulation.collect.episode_jobs import episode_seed
from mtv_world_ros.simulation.expert.expert import Expert
from mtv_world_ros.simulation.expert.scripted_policy import scripted_policy
from mtv_world_ros.simulation.faults.catalogue import EXPERT, parse_variant
from mtv_world_ros.simulation.scenes.tasks import own_definition, stored_or_named, Task
from mtv_world_ros.success.estimator import verdict

#: NaN is null in a file
_Float = Annotated[float, BeforeValidator(lambda value: nan if value is None else value)]
#: tasks of a ranking on the fault catalogue: grasps across the middle, stacking, plates, two moves
BENCHMARK_TASKS = (
    'place_block_a2b_left',
    'stack_blocks_two',
    'place_bread_plate',
    'place_cup_plate',
    'move_object_two',
    'collect_toy',
)
#: policies from the expert to one that never finishes, with faults of several kinds and sizes
DEFAULT_POLICIES = (
    'expert',
    'expert-noise-0.03',
    'expert-noise-0.06',
    'expert-shift-0.01',
    'expert-shift-0.03',
    'expert-place-0.04',
    'expert-late-0.6',
    'expert-miss-0.5',
    'expert-wrong-0.5',
    'expert-stop-0.5',
)
DEFAULT_TASKS = ('place_block_a2b_left', 'place_bread_plate', 'stack_blocks_two')
#: maximum number of sampled scenes until the expert reaches all objects of a scene
_MAX_ATTEMPTS = 25
#: difference from which commands of the two worlds have parted [rad or m]
COMMANDS_PART = 0.02
#: J of an object's masks in the two worlds, in every view, below which the object has parted
OBJECTS_PART = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One policy on one episode, in the simulator and in imagination.

    Attributes:
        policy: name of the policy.
        task: name of the task.
        task_definition: definition of the task as JSON; empty = it is bundled.
        index: number of the episode within the task.
        seed: random seed of the scene, the policy and the denoising noise.
        definition: hash of the policy's configuration, as a name may have meant another policy
            before; empty = the name is enough.
    """

    policy: str
    task: str
    index: int
    seed: int
    definition: str = ''
    task_definition: str = ''

    @property
    def name(self) -> str:
        """Stem of its result's files."""
        return f'{self.task}_{self.index:05d}_{self.policy}'

    def load_task(self) -> Task:
        """Return the task with its scene."""
        where = f"definition of task '{self.task}'"
        return stored_or_named(self.task_definition, self.task, where)


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredEstimate:
    """A success estimate in a result file.

    Attributes:
        probability: NaN = abstains.
        interval: 95 % interval (low, high) of the probability.
        jaccard: (V, O) J of the objects with where they should be; NaN where not known.
        reasons: evidence of the estimate, or why it abstains.
    """

    __pydantic_config__ = ConfigDict(extra='forbid')

    probability: _Float
    interval: tuple[_Float, _Float]
    jaccard: tuple[tuple[_Float, ...], ...]
    reasons: tuple[str, ...]

    @classmethod
    def of(cls, estimate: SuccessEstimate | None) -> StoredEstimate:
        """Return an estimate in plain values; None = the policy gave no answer to judge."""
        if estimate is None:
            return cls.stated(nan, cannot_tell('the policy gave no answer'))
        return cls(
            probability=float(estimate.probability),
            interval=estimate.interval,
            jaccard=tuple(tuple(map(float, row)) for row in estimate.jaccard),
            reasons=estimate.reasons,
        )

    @classmethod
    def of_motions(cls, estimate: SuccessEstimate | None) -> StoredEstimate:
        """Return the estimate of foreseen motions alone, without the imagined frames."""
        if estimate is None or estimate.futures is None:
            return cls.stated(nan, cannot_tell('no motion was foreseen'))
        if not isfinite(estimate.probability):
            return cls.stated(nan, estimate.reasons[0])
        return cls(
            probability=estimate.futures.probability,
            interval=estimate.futures.interval,
            jaccard=(),
            reasons=('the estimate of foreseen motions alone',),
        )

    @classmethod
    def stated(cls, probability: float, reason: str) -> StoredEstimate:
        """Return a verdict without J; NaN = abstains."""
        interval = (probability, probability)
        return cls(probability=probability, interval=interval, jaccard=(), reasons=(reason,))

    @property
    def success(self) -> float:
        """1 or 0; NaN where there is no verdict, see `verdict`."""
        return verdict(self.probability, self.interval)


_NOT_MEASURED = StoredEstimate.stated(nan, cannot_tell('it was not measured'))


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredFutures:
    """Outcomes of an imagined rollout in simulated futures, in a result file.

    Attributes:
        key: digest of the futures; rollouts with equal keys met common futures.
        outcomes: outcome in each future; null = the future was lost.
        is_fitted: contact parameters were fitted in this robot cell.
    """

    __pydantic_config__ = ConfigDict(extra='forbid')

    key: str
    outcomes: tuple[bool | None, ...]
    is_fitted: bool

    @classmethod
    def of(cls, estimate: SuccessEstimate | None, key: str) -> StoredFutures | None:
        """Return the outcomes of an estimate; None = nothing was foreseen, or it abstains.

        Args:
            estimate: the estimate at the end of the rollout.
            key: digest of its futures.
        """
        if estimate is None or estimate.futures is None or not key:
            return None
        if not isfinite(estimate.probability):  # e.g. cameras that are elsewhere than told
            return None
        futures = estimate.futures
        return cls(key=key, outcomes=futures.outcomes, is_fitted=futures.is_fitted)


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldComparison:
    """Comparison of a rollout in both worlds, by frame of the model.

    Attributes:
        times: (T,) since the first observation [s].
        command_gaps: (T,) largest difference between the commands of a joint in the two worlds
            [rad or m]; NaN = one world has ended.
        overlaps: (T,) least J of an object's masks in the two worlds, in the view in which it is
            largest; NaN = one world has ended, or no object is seen.
        ends: times at which an estimate was made [s].
        seen: estimates on the simulator's frames at these times; NaN = it abstains or has ended.
        imagined: estimates on the imagined frames.
        commands_part_s: when commands first differ by more than `COMMANDS_PART`; NaN = never.
        objects_part_s: when an object's overlap falls below `OBJECTS_PART`; NaN = never.
        parted_object: name of that object.
        verdicts_part_s: when one estimate first calls a success what the other calls a failure,
            and their intervals do not overlap;
            NaN = never.
    """

    __pydantic_config__ = ConfigDict(extra='forbid')

    times: tuple[_Float, ...]
    command_gaps: tuple[_Float, ...]
    overlaps: tuple[_Float, ...]
    ends: tuple[_Float, ...]
    seen: tuple[_Float, ...]
    imagined: tuple[_Float, ...]
    commands_part_s: _Float = nan
    objects_part_s: _Float = nan
    parted_object: str = ''
    verdicts_part_s: _Float = nan

    @property
    def part_s(self) -> float:
        """When commands or objects first part [s]; NaN = never."""
        known = [t for t in (self.commands_part_s, self.objects_part_s) if isfinite(t)]
        return min(known, default=nan)


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """One policy on one episode.

    Attributes:
        policy: name of the policy.
        task: name of the task.
        index: number of the episode within the task.
        seed: random seed of the episode, the policy and the denoising noise.
        ever: whether the task was done at some time, in the simulator.
        final: whether the task was done at the end, in the simulator; this counts as success.
        imagined: the estimate at the end of the imagined episode.
        foreseen: the estimate of its foreseen motions alone.
        pictures: the estimate from the imagined frames alone, with no motion foreseen.
        seen: estimate on the simulator's own frames: its errors are not the world model's.
        no_picture: the rule that sees the commands and the first frame alone.
        num_chunks: answers executed in the simulator.
        num_imagined: answers executed in imagination.
        is_over: whether something else than the limit ended the episode, in both worlds.
        seconds: time by stage [s].
        end: reason why the simulated episode ended; empty = not known.
        imagined_end: reason why the imagined episode ended.
        futures: outcomes in simulated futures; None = nothing was foreseen, or an earlier version
            wrote the result.
        course: commands, overlaps and estimates over time in both worlds; None = not known.
        files: files of the rollout in base64 by suffix; empty once they are written to disk.
    """

    __pydantic_config__ = ConfigDict(extra='forbid')

    policy: str
    task: str
    index: int
    seed: int
    ever: bool
    final: bool
    imagined: StoredEstimate
    seen: StoredEstimate
    no_picture: StoredEstimate
    foreseen: StoredEstimate = _NOT_MEASURED
    pictures: StoredEstimate = _NOT_MEASURED
    num_chunks: int
    num_imagined: int
    is_over: bool
    seconds: Mapping[str, float]
    end: str = ''
    imagined_end: str = ''
    futures: StoredFutures | None = None
    course: WorldComparison | None = None
    files: Mapping[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Stem of its files."""
        return f'{self.task}_{self.index:05d}_{self.policy}'

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Result:
        """Read what `as_json` returned, NaN as null.

        Raises:
            ValueError: a key is unknown or missing, or a value is wrong.
        """
        return _RESULT.validate_python(values)


_RESULT = TypeAdapter(Result)


def policies_named(text: str) -> tuple[str, ...]:
    """Return the policies of a comma-separated list, as they are called.

    Raises:
        ConfigError: none, or one twice.
        PolicyError: no such policy.
    """
    names = [parse_variant(name).name for name in text.split(',') if name.strip()]
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled or not names:
        what = f"'{doubled[0]}' is listed twice" if doubled else 'no policy is listed'
        raise ConfigError(f'{what} in --policies; give each once, e.g. {DEFAULT_POLICIES[:2]}')
    return tuple(names)


def make_jobs(
    policies: Sequence[str], tasks: Sequence[Task], num_episodes: int, seed: int, expert: Expert
) -> list[Job]:
    """Return the jobs; all policies meet the same episodes.

    Episodes alternate between policies and tasks, so that partial results are always balanced.

    Raises:
        ConfigError: less than one episode, no task, or a task twice.
        SimulatorError: no scene of a task is in the expert's reach.
    """
    if num_episodes < 1:
        raise ConfigError(f'--episodes is {num_episodes}; it must be at least 1')
    names = [task.name for task in tasks]
    if len(set(names)) != len(names) or not names:
        raise ConfigError(f"--tasks is '{','.join(names)}'; give at least one task, each once")
    definitions = {task.name: own_definition(task) for task in tasks}
    return [
        Job(
            policy=policy,
            task=task.name,
            index=index,
            seed=episode,
            task_definition=definitions[task.name],
        )
        for index in range(num_episodes)
        for task in tasks
        for episode in [_seed(task, index, seed, expert)]
        for policy in policies
    ]


def _seed(task: Task, index: int, seed: int, expert: Expert) -> int:
    """Return the first seed whose scene exists and is in the expert's reach."""
    reason = ''
    for attempt in range(_MAX_ATTEMPTS):
        found = episode_seed(seed, task.name, index, attempt)
        try:
            scripted_policy(EXPERT, task, found, expert).reset(seed=found)
        except (SimulatorError, PolicyError) as error:
            reason = str(error)
        else:
            return found
    raise SimulatorError(
        f"task '{task.name}', episode {index}: no scene in the expert's reach in {_MAX_ATTEMPTS} "
        f'draws ({reason}); choose another --seed'
    )
