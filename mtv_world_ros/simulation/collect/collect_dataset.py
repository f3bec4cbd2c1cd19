"""Collects a data set of simulated episodes: seeded, resumable, in parallel."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
import fcntl
from functools import partial
from pathlib import Path
from typing import Any

from mtv_world_ros.core.errors import NoSceneError, SimulatorError
from mtv_world_ros.core.executor import run_all
from mtv_world_ros.core.images import encode_png
from mtv_world_ros.core.progress import Progress
from mtv_world_ros.core.workers import IN_PROCESS, Workers
from mtv_world_ros.simulation.collect.contact_sheet import contact_sheet, SHEET_FILE
from mtv_world_ros.simulation.collect.dataset_card import (
    card_of,
    CardEntry,
    check_same_set,
    check_same_tasks,
    read_entries,
    read_entry,
    remove_leftovers,
    TASKS_SET,
    write_card,
    write_file,
    ZERO_SHOT_SET,
)
from mtv_world_ros.simulation.collect.dataset_readme import write_readme
from mtv_world_ros.simulation.collect.episode_jobs import (
    CollectJob,
    jobs_of,
    NUM_MISSED,
    zero_shot_jobs,
)
from mtv_world_ros.simulation.collect.episode_maker import (
    CollectConfig,
    EpisodeMaker,
    plain_config,
)
from mtv_world_ros.simulation.opengl import load_mujoco
from mtv_world_ros.simulation.scenes.tasks import tasks_named
from mtv_world_ros.simulation.zero_shot import kinds_named

#: episodes between two writings of the card
CARD_EVERY = 20
LOCK_FILE = '.lock'
SHEETS_FOLDER = 'sheets'


def collect(
    tasks: str | Sequence[str],
    num_episodes: int,
    seed: int,
    out: Path | str,
    *,
    zero_shot: str | Sequence[str] = (),
    workers: Workers = IN_PROCESS,
    config: CollectConfig | None = None,
    failures_of_ten: int = NUM_MISSED,
    sheets: bool = False,
    progress: bool = True,
    on_missing: Callable[[str], object] | None = None,
) -> list[CardEntry]:
    """Make the missing episodes of a data set, its card and its contact sheet.

    The same arguments give the same episodes, whatever the number of workers; episodes that
    are there already are kept, so an interrupted run is continued by starting it again.

    Args:
        tasks: names or YAML files of tasks, also comma-separated, or `all`.
        num_episodes: episodes per task; of zero-shot sets, in all.
        seed: the data set's random seed.
        out: folder of the data set; one episode folder appears in it at a time.
        zero_shot: kinds of a zero-shot set (`view`, `task`, `object`); none = an ordinary set.
        workers: where the episodes are simulated, each with one thread.
        config: randomisation and sampling.
        failures_of_ten: number of episodes in ten of a task that miss their grasp; none in
            zero-shot sets.
        sheets: whether a larger contact sheet of every task is written, too.
        progress: show the progress.
        on_missing: takes the reason of each episode that could not be made, after the others
            were made; None = the first reason is raised then.

    Returns:
        The entries of the episodes that were asked for and made.

    Raises:
        NoSceneError: see `on_missing`; or no episode at all could be made.
        SimulatorError: unknown task or kind, no OpenGL library, `out` holds another set or
            cannot be written.
    """
    chosen = tasks_named(tasks if isinstance(tasks, str) else ','.join(tasks))
    kinds = kinds_named(zero_shot)
    if num_episodes < 1 or workers.count < 1:
        raise SimulatorError(
            f'episodes is {num_episodes} and workers is {workers.count}; both must be at least 1'
        )
    out, config = Path(out), config or CollectConfig()
    if kinds and (config.policies or config.moved_share):
        raise SimulatorError(
            'a zero-shot set is acted by the expert and brings its own cameras; leave '
            '--policies and --moved-cameras out, or --zero-shot'
        )
    load_mujoco()
    if kinds:
        jobs = zero_shot_jobs(kinds, chosen, num_episodes, seed, out)
    else:
        num_missed = 0 if config.kinds else failures_of_ten
        jobs = jobs_of(chosen, num_episodes, seed, out, num_missed, config.policies)
    with dataset_lock(out):
        data_set = _DataSet(out, ZERO_SHOT_SET if kinds else TASKS_SET, seed, config, jobs)
        workers = replace(workers, threads=1, writes=out)
        missing = data_set.make(jobs, workers, config, progress=progress)
        remove_leftovers(out)  # of workers that died
        if missing and not data_set.entries:
            raise NoSceneError(missing[0])
        data_set.describe(sheets=sheets)
    for reason in missing:
        if on_missing is None:
            raise NoSceneError(reason)
        on_missing(reason)
    return [data_set.entries[name] for job in jobs if (name := job.path.name) in data_set.entries]


def _maker(config: CollectConfig) -> Callable[[CollectJob], str]:
    """Return what makes an episode; it returns why there is none, or an empty text."""
    maker = EpisodeMaker(config)

    def make(job: CollectJob) -> str:
        # a worker that died may have finished it; an episode gets its name when it is whole
        try:
            if not job.path.exists():
                maker.make(job)
        except NoSceneError as error:  # the others of the set are made all the same
            return str(error)
        return ''

    return make


@contextmanager
def dataset_lock(out: Path) -> Iterator[None]:
    """Hold the data set's lock, which ends with the process however that ends.

    Raises:
        SimulatorError: another process collects into the folder, or it cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        stream = (out / LOCK_FILE).open('a')
    except OSError as error:
        raise SimulatorError(
            f"cannot write into '{out}': {error}; choose another --out"
        ) from error
    with stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise SimulatorError(
                f"another `collect` is writing into '{out}'; wait for it, or choose another --out"
            ) from error
        except OSError:
            pass  # a file system without locks
        yield


class _DataSet:
    """A data set's folder: its episodes, card and contact sheets."""

    def __init__(
        self, out: Path, kind: str, seed: int, config: CollectConfig, jobs: Sequence[CollectJob]
    ) -> None:
        self._out, self._kind, self._seed = out, kind, seed
        self._config = plain_config(config)
        check_same_set(out, kind, seed, self._config)
        remove_leftovers(out)
        self.entries = read_entries(out, {job.path.name for job in jobs})
        check_same_tasks(
            out, self.entries.values(), {job.task.name: job.task for job in jobs}.values()
        )
        self._write_card()

    def make(
        self,
        jobs: Sequence[CollectJob],
        workers: Workers,
        config: CollectConfig,
        *,
        progress: bool,
    ) -> list[str]:
        """Make the missing episodes; return why some are still missing."""
        reasons: list[str] = []
        missing = [job for job in jobs if job.path.name not in self.entries]
        done = len(jobs) - len(missing)
        try:
            finished = run_all(missing, partial(_maker, config), workers)
            with Progress(total=len(jobs), initial=done, unit='episode', is_shown=progress) as bar:
                self._show(bar, jobs)
                for number, (job, reason) in enumerate(finished, 1):
                    if reason:
                        reasons.append(reason)
                        continue
                    self.entries[job.path.name] = read_entry(job.path)
                    bar.update()
                    self._show(bar, jobs)
                    if number % CARD_EVERY == 0:
                        self._write_card()
        except BaseException:
            # the first error is the one to report
            with suppress(SimulatorError):
                self._write_card()
            raise
        return reasons

    def _show(self, bar: Any, jobs: Sequence[CollectJob]) -> None:
        names = [job.path.name for job in jobs]
        outcomes = [self.entries[name].outcome for name in names if name in self.entries]
        success = outcomes.count('success')
        share = f' ({100 * success / len(outcomes):.0f} %)' if outcomes else ''
        bar.set_postfix_str(f'{success} success{share}, {len(outcomes) - success} failure')

    def describe(self, *, sheets: bool) -> None:
        """Write the card as data and as text, and the contact sheets."""
        self._write_card()
        entries = list(self.entries.values())
        write_file(self._out / SHEET_FILE, encode_png(contact_sheet(self._out, entries)))
        write_readme(self._out, self._card(), entries)
        if not sheets:
            return
        for key in sorted({(entry.zero_shot, entry.task) for entry in entries}, key=str):
            chosen = [e for e in entries if (e.zero_shot, e.task) == key]
            name = '_'.join(part for part in key if part)
            sheet = contact_sheet(self._out, chosen, pairs=4, num_frames=8, width=240)
            write_file(self._out / SHEETS_FOLDER / f'{name}.png', encode_png(sheet))

    def _card(self) -> dict[str, Any]:
        return card_of(self._kind, self._seed, self._config, self.entries.values())

    def _write_card(self) -> None:
        write_card(self._out, self._card())
