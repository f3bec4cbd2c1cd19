"""Siblings: episodes of one scene under the expert's commands and under slightly wrong ones.

The size of each fault is searched by bisection, with physics alone, so that the outcomes of a pair
lie on both sides of the boundary between success and failure.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
from pydantic import ConfigDict, TypeAdapter
from tqdm import tqdm

from mtv_world_ros.bench.collect.episode_jobs import CollectJob, episode_seed
from mtv_world_ros.bench.collect.record import RecordConfig, simulate
from mtv_world_ros.bench.expert.expert import Expert
from mtv_world_ros.bench.expert.faults.catalogue import EXPERT, FAULTS, kind_named, PolicyVariant
from mtv_world_ros.bench.expert.scripted_policy import scripted_policy
from mtv_world_ros.bench.tasks.tasks import Task, task_named
from mtv_world_ros.bench.world.simulator import SimEpisode
from mtv_world_ros.bounded_input import read_json
from mtv_world_ros.errors import PolicyError, SimulatorError
from mtv_world_ros.files import write_json
from mtv_world_ros.processes import run_all

#: what the search found, in the folder of the data set
SIBLINGS_FILE = 'siblings.json'
#: halvings between no fault and a size that fails
NUM_HALVINGS = 6
#: sizes that may fail, tried in turn, as multiples of the typical one; the largest one comes first
_MULTIPLES = (4.0, 2.0, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sibling:
    """One command for a scene.

    Attributes:
        scene: its name, `<task>_<index>`.
        number: 0 is the expert.
        seed: random seed of the scene and the policy.
        attempt: seeds dropped before this one.
        policy: its name.
        kind: its fault kind; empty = none.
        size: size of its fault.
        diverges_s: time of the first command that is not the expert's [s]; 0 for the expert.
    """

    __pydantic_config__ = ConfigDict(extra='forbid')

    scene: str
    number: int
    seed: int
    attempt: int
    policy: str
    kind: str = ''
    size: float = 0.0
    diverges_s: float = 0.0

    def metadata(self) -> dict[str, str]:
        """Returns it as text, for the metadata of an episode."""
        return {
            'scene': self.scene,
            'sibling': str(self.number),
            'kind': self.kind,
            'size': f'{self.size:g}',
            'diverges_s': f'{self.diverges_s:.2f}',
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneJob:
    """A scene whose siblings are searched; see `jobs.Job`."""

    task: str
    index: int
    seed: int

    @property
    def name(self) -> str:
        """Of the scene."""
        return f'{self.task}_{self.index:05d}'


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchedScene:
    """What the search found in a scene.

    Attributes:
        siblings: the expert, then pairs that just succeed and just fail.
        skipped: fault kinds without a boundary here, and why.
    """

    __pydantic_config__ = ConfigDict(extra='forbid')

    siblings: tuple[Sibling, ...]
    skipped: Mapping[str, str]


class BoundarySearch:
    """Searches the siblings of one scene after the other in one process.

    Args:
        expert: the scripted expert, which plans.
        make_sim: seed -> physics of an episode, as it will be recorded.
        kinds: fault kinds to choose from.
        num_siblings: number of siblings of a scene, the expert included.
        config: sampling of episodes, and the largest number of seeds tried.
    """

    def __init__(
        self,
        expert: Expert,
        make_sim: Callable[[int], SimEpisode],
        kinds: Sequence[str],
        num_siblings: int,
        config: RecordConfig,
    ) -> None:
        self._expert, self._make_sim, self._config = expert, make_sim, config
        self._kinds, self._num_siblings = kinds, num_siblings

    def search(self, job: SceneJob) -> SearchedScene:
        """Returns the siblings of a scene, as many as there are boundaries for.

        Raises:
            SimulatorError: the expert succeeds in no scene.
        """
        task = task_named(job.task)
        for attempt in range(self._config.max_attempts):
            seed = episode_seed(job.seed, job.task, job.index, attempt)
            try:
                if self._succeeds(task, seed, PolicyVariant()):
                    return self._pairs(job, task, seed, attempt)
            except (SimulatorError, PolicyError):
                continue
        raise SimulatorError(
            f'scene {job.name} (seed {job.seed}): the expert did not succeed in '
            f'{self._config.max_attempts} attempts; choose another --seed'
        )

    def _pairs(self, job: SceneJob, task: Task, seed: int, attempt: int) -> SearchedScene:
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(6,)))
        variants, skipped = [PolicyVariant()], {}
        for kind in map(str, rng.permutation(list(self._kinds))):
            if len(variants) >= self._num_siblings:
                break
            found = find_boundary(kind, partial(self._succeeds, task, seed))
            if isinstance(found, str):
                skipped[kind] = found
            else:
                # where only one more is wanted, the one that fails
                variants += found[-(self._num_siblings - len(variants)) :]
        siblings = tuple(
            Sibling(
                scene=job.name,
                number=number,
                seed=seed,
                attempt=attempt,
                policy=variant.name,
                kind=''.join(variant.kinds),
                size=variant.sizes[0][1] if variant.sizes else 0.0,
                diverges_s=self._divergence(task, seed, variant.name),
            )
            for number, variant in enumerate(variants)
        )
        return SearchedScene(siblings=siblings, skipped=skipped)

    def _succeeds(self, task: Task, seed: int, variant: PolicyVariant) -> bool:
        sim = self._make_sim(seed)
        take = simulate(sim, self._expert, task, seed, self._config, miss=False, variant=variant)
        return take.ever and take.final

    def _divergence(self, task: Task, seed: int, name: str) -> float:
        plans = []
        for policy_name in (EXPERT, name):
            policy = scripted_policy(policy_name, task.name, seed, self._expert)
            policy.reset(seed=seed)
            plans.append(policy.plan)
        num = min(len(plan.times) for plan in plans)
        differs = np.abs(plans[0].positions[:num] - plans[1].positions[:num]).max(1) > 1e-6
        return float(plans[1].times[int(np.argmax(differs))]) if differs.any() else 0.0


def find_boundary(
    kind: str, succeeds: Callable[[PolicyVariant], bool]
) -> tuple[PolicyVariant, PolicyVariant] | str:
    """Returns a fault that just succeeds and one that just fails, or why there is no boundary.

    Args:
        kind: the fault kind.
        succeeds: whether a variant succeeds; may raise PolicyError where there is no plan.
    """
    fault = FAULTS[kind_named(kind)].size
    if fault.typical == fault.largest:
        return 'it is there or not, and has no size'
    if fault.none:
        sizes = [0.0]
    else:
        sizes = sorted({min(m * fault.typical, fault.largest) for m in _MULTIPLES}, reverse=True)
    try:
        failing = next((s for s in sizes if not _tried(kind, s, succeeds)), None)
        if failing is None:
            return f'it always succeeds, up to {sizes[0]:g} {fault.unit}'.rstrip()
        good, bad = fault.none, failing
        for _ in range(NUM_HALVINGS):
            middle = float(f'{(good + bad) / 2:.3g}')
            if succeeds(PolicyVariant.of({kind: middle})):
                good = middle
            else:
                bad = middle
    except PolicyError as error:
        return f'no plan: {error}'
    if good == fault.none:
        return f'it always fails, down to {bad:g} {fault.unit}'.rstrip()
    return PolicyVariant.of({kind: good}), PolicyVariant.of({kind: bad})


def _tried(kind: str, size: float, succeeds: Callable[[PolicyVariant], bool]) -> bool:
    """Whether it succeeds; without a plan it counts as a success: a smaller size is tried."""
    try:
        return succeeds(PolicyVariant.of({kind: size}))
    except PolicyError:
        return True


def search_siblings(
    scenes: Sequence[SceneJob],
    make_search: Callable[[], Callable[[SceneJob], SearchedScene]],
    out: Path,
    workers: int,
    *,
    progress: bool,
) -> dict[str, SearchedScene]:
    """Returns the siblings by scene; what was found by an earlier run is not searched again.

    Args:
        scenes: the scenes to search.
        make_search: called once in every process; picklable.
        out: folder of the data set; gets `SIBLINGS_FILE`.
        workers: processes.
        progress: show a progress bar, on a terminal.
    """
    found = _read(out / SIBLINGS_FILE)
    missing = [scene for scene in scenes if scene.name not in found]
    done = run_all(missing, make_search, workers)
    with tqdm(total=len(missing), unit='scene', disable=None if progress else True) as bar:
        for scene, searched in done:
            found[scene.name] = searched
            write_json(out / SIBLINGS_FILE, {name: asdict(one) for name, one in found.items()})
            bar.update()
    return {scene.name: found[scene.name] for scene in scenes}


_SCENES = TypeAdapter(dict[str, SearchedScene])


def _read(path: Path) -> dict[str, SearchedScene]:
    if not path.is_file():
        return {}
    try:
        return _SCENES.validate_python(read_json(path))
    except (OSError, ValueError) as error:
        reason = f'{type(error).__name__}: {" ".join(str(error).split())}'
        raise SimulatorError(
            f"'{path}' is not what 'collect --siblings' writes ({reason}); move it away"
        ) from error


def sibling_jobs(
    found: Mapping[str, SearchedScene], scenes: Sequence[SceneJob], out: Path
) -> list[CollectJob]:
    """Returns the episodes to make, scene by scene."""
    return [
        CollectJob(
            task=scene.task,
            index=scene.index,
            seed=scene.seed,
            miss=False,
            path=out / f'{scene.name}_{sibling.number:02d}',
            policy=sibling.policy,
            attempt=sibling.attempt,
            more=tuple(sibling.metadata().items()),
        )
        for scene in scenes
        for sibling in found[scene.name].siblings
    ]


def skipped_text(found: Mapping[str, SearchedScene]) -> str:
    """Returns which fault kinds were skipped in how many scenes, and why in the first."""
    reasons: dict[str, list[str]] = {}
    for scene in found.values():
        for kind, reason in scene.skipped.items():
            reasons.setdefault(kind, []).append(reason)
    return '\n'.join(
        f'skipped {kind} in {len(why)} of {len(found)} scenes: {why[0]}'
        for kind, why in sorted(reasons.items())
    )
