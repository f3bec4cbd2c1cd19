"""Makes one episode of a data set after the other: attempts until one is as wanted."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
import json
from typing import Any

import numpy as np

from mtv_world_ros.core.errors import EpisodeError, NoSceneError, PolicyError, SimulatorError
from mtv_world_ros.core.files import bundled
from mtv_world_ros.data.episode import NOMINAL
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.simulation.collect.dataset_card import GO_ON
from mtv_world_ros.simulation.collect.episode_jobs import CollectJob, episode_seed
from mtv_world_ros.simulation.collect.record import RecordConfig, simulate, Take, write_take
from mtv_world_ros.simulation.expert.expert import Expert, ExpertConfig
from mtv_world_ros.simulation.faults.catalogue import draw_variant, parse_variant, PolicyVariant
from mtv_world_ros.simulation.physics import physics_named
from mtv_world_ros.simulation.scenes.cameras import CameraMoves, TRAINING_MOVES
from mtv_world_ros.simulation.scenes.randomize import RandomizationConfig
from mtv_world_ros.simulation.scenes.workcell import workcell_of
from mtv_world_ros.simulation.simulator import SimEpisode
from mtv_world_ros.simulation.zero_shot import variant, with_moved_cameras

#: whose data sets the card does not name
_DEFAULT_ROBOT = 'yam_bimanual'


@dataclass(frozen=True, slots=True, kw_only=True)
class CollectConfig:
    """Settings of simulated episodes: randomisation, motion of the expert, sampling.

    Attributes:
        robot: a bundled one's name, or a robot YAML; it must have a workcell.
        randomization: objects, light, cameras and their jitter.
        expert: heights, speeds and timing.
        record: sampling and noise.
        zero_shot: ranges of the camera poses of zero-shot views.
        moved_share: share of ordinary episodes whose cameras stand elsewhere too.
        moves: ranges that such an episode chooses from; they leave zero-shot views unseen.
        policies: scripted policies that take turns, `expert-late-0.6`; none = the expert, some of
            whose grasps miss.
        kinds: fault kinds that random policies are drawn from, one an episode; none = `policies`.
        physics: physics of the simulator, a key of `config/physics.yaml`.
    """

    robot: str = _DEFAULT_ROBOT
    randomization: RandomizationConfig = field(default_factory=RandomizationConfig)
    expert: ExpertConfig = field(default_factory=ExpertConfig)
    record: RecordConfig = field(default_factory=RecordConfig)
    zero_shot: CameraMoves = CameraMoves()
    moved_share: float = 0.0
    moves: tuple[CameraMoves, ...] = TRAINING_MOVES
    policies: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ()
    physics: str = NOMINAL

    def __post_init__(self) -> None:
        if not 0 <= self.moved_share <= 1:
            raise SimulatorError(
                f'the share of episodes with moved cameras is {self.moved_share}; it must be in '
                '[0, 1]; set --moved-cameras'
            )
        physics_named(self.physics)
        for name in self.policies:
            parse_variant(name)


def plain_config(config: CollectConfig) -> dict[str, Any]:
    """Return the configuration as the card has it, with the cameras of the robot's workcell."""
    workcell = workcell_of(load_robot(bundled('robots', config.robot, '--robot')))
    config = replace(config, randomization=config.randomization.of(workcell))
    values = json.loads(json.dumps(asdict(config)))
    usual = {'robot': _DEFAULT_ROBOT, 'physics': NOMINAL}
    return {k: v for k, v in values.items() if k not in usual or v != usual[k]}


class EpisodeMaker:
    """Makes episodes one after the other in one process."""

    def __init__(self, config: CollectConfig) -> None:
        self._robot = load_robot(bundled('robots', config.robot, '--robot'))
        randomization = config.randomization.of(workcell_of(self._robot))
        config = replace(config, randomization=randomization)
        self._config = config
        self._expert = Expert(self._robot, config.expert, config.physics)

    def make(self, job: CollectJob) -> None:
        """Simulate attempts until one is as wanted, and write it.

        Raises:
            NoSceneError: none of `max_attempts` seeds gave the wanted outcome.
            SimulatorError: the episode
                cannot be written.
        """
        attempts = range(self._config.record.max_attempts)
        for attempt in attempts:
            seed = episode_seed(job.seed, job.task.name, job.index, attempt, job.zero_shot)
            sim, take = self._attempt(job, seed)
            try:
                if take is not None and take.is_as_wanted():
                    self._write(job, sim, take, seed, attempt)
                    return
            finally:
                sim.close()
        episode = f"episode {job.index} of task '{job.task.name}' (seed {job.seed})"
        if job.policy:
            raise NoSceneError(
                f"{episode}: policy '{job.policy}' cannot be carried out in any of "
                f'{len(attempts)} scenes; leave it, or the task, out (--policies, --task)'
            )
        raise NoSceneError(
            f'{episode} was {"no clean miss" if job.miss else "no success"} in {len(attempts)} '
            'scenes; another --seed draws other ones, or leave the task out (--task)'
        )

    def _attempt(self, job: CollectJob, seed: int) -> tuple[SimEpisode, Take | None]:
        """Return the episode of a seed; no take where its scene or plan is impossible."""
        config = self._config
        task, randomization = variant(
            job.zero_shot, job.task, seed, config.randomization, config.zero_shot
        )
        if job.zero_shot is None:
            randomization = cameras_of(seed, config)
        sim = self._sim(randomization)
        faulty = self._policy(job, seed)
        try:
            return sim, simulate(
                sim, self._expert, task, seed, config.record, miss=job.miss, variant=faulty
            )
        except (SimulatorError, PolicyError):
            return sim, None

    def _sim(self, randomization: RandomizationConfig) -> SimEpisode:
        home, physics = self._expert.home, self._config.physics
        return SimEpisode(self._robot, home, randomization, physics=physics)

    def _policy(self, job: CollectJob, seed: int) -> PolicyVariant | None:
        """Return the scripted policy in place of the expert; None = the expert."""
        if self._config.kinds:
            rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(5,)))
            return draw_variant(self._config.kinds, rng)
        return parse_variant(job.policy) if job.policy else None

    def _write(
        self, job: CollectJob, sim: SimEpisode, take: Take, seed: int, attempt: int
    ) -> None:
        extra = {'attempt': str(attempt), 'index': str(job.index)}
        if job.zero_shot is not None:
            extra['zero_shot'] = job.zero_shot
        policy = self._policy(job, seed)
        if policy is not None:
            extra |= {'policy': policy.name, 'fault_split': ','.join(policy.splits)}
        try:
            write_take(job.path, sim, take, seed, self._config.record, **extra)
        except (OSError, EpisodeError) as error:
            raise SimulatorError(f"cannot write '{job.path}': {error}; {GO_ON}") from error


def cameras_of(seed: int, config: CollectConfig) -> RandomizationConfig:
    """Return the randomisation of an ordinary episode; some have their cameras moved."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(3,)))
    if rng.uniform() >= config.moved_share:
        return config.randomization
    moves = config.moves[rng.integers(len(config.moves))]
    return with_moved_cameras(config.randomization, moves, rng)
