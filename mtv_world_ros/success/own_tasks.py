"""Tasks that are not bundled: in an episode's metadata, or in its data set's `dataset.json`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

from mtv_world_ros.core.errors import ConfigError, EpisodeError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode import EpisodeInfo, TASK_DEFINITION
from mtv_world_ros.data.episode_reader import read_info
from mtv_world_ros.data.splits import CARD_FILE, task_definitions
from mtv_world_ros.success.task import load_task, load_tasks, stored_task, TaskSpec

#: ends of the names of task files
YAML = ('.yaml', '.yml')


def bundled_tasks() -> tuple[TaskSpec, ...]:
    """Return the bundled tasks that an instruction may match.

    Tasks of objects of any size come last: an instruction that fits one of the benchmark's is
    judged with the benchmark's thresholds.
    """
    folders = (('config', 'tasks'), ('config', 'tasks', 'any_size'))
    return tuple(task for folder in folders for task in load_tasks(share_path(*folder)))


class _DatasetTasks(dict[Path, Mapping[str, TaskSpec]]):
    """Tasks that `dataset.json` defines, by name, of each data set's folder; read when asked."""

    def __missing__(self, dataset: Path) -> Mapping[str, TaskSpec]:
        where = f"'{dataset / CARD_FILE}': task"
        found = task_definitions(dataset)
        self[dataset] = {name: stored_task(v, f"{where} '{name}'") for name, v in found.items()}
        return self[dataset]


def own_task(
    info: EpisodeInfo, datasets: Mapping[Path, Mapping[str, TaskSpec]] | None = None
) -> TaskSpec | None:
    """Return the task that an episode or its data set defines; None = neither does.

    Args:
        info: metadata of the episode.
        datasets: tasks by name, by folder of the data set; None = they are read.

    Raises:
        ConfigError: the definition cannot be used, or that of the episode and that of its data
            set differ.
    """
    text, card = info.metadata.get(TASK_DEFINITION), Path(info.path).parent / CARD_FILE
    own = None if text is None else stored_task(text, f"'{TASK_DEFINITION}' of '{info.path}'")
    listed = (_DatasetTasks() if datasets is None else datasets)[card.parent].get(info.task)
    if own is not None and listed is not None and own != listed:
        raise ConfigError(
            f"'{info.path}' and '{card}' define the task '{info.task}' differently; remove "
            f"'{info.task}' from 'task_definitions' of the latter if the episode is right"
        )
    return own or listed


def own_tasks(episodes: Iterable[Path]) -> dict[Path, TaskSpec]:
    """Return the tasks that episodes or their data sets define, by path of the episode.

    Episodes whose metadata cannot be read are left out: their reader says why.

    Args:
        episodes: folders of the episodes.

    Raises:
        ConfigError: a definition cannot be used, or two of one name differ.
    """
    found: dict[Path, TaskSpec] = {}
    firsts, datasets = dict[str, Path](), _DatasetTasks()
    for path in episodes:
        with suppress(EpisodeError):
            task = own_task(read_info(path), datasets)
            if task is None:
                continue
            first = firsts.setdefault(task.name, path)
            if found.get(first, task) != task:
                raise ConfigError(
                    f"'{first}' and '{path}' define the task '{task.name}' differently; use them "
                    'one after the other, or give --task FILE to judge both by one definition'
                )
            found[path] = task
    return found


def named_here(word: str | None, episodes: Iterable[Path]) -> str | TaskSpec | None:
    """Return a task that a user names, as `Pipeline.load` takes it; None = the user names none.

    Args:
        word: YAML file of a task, name of a bundled task, or name of a task that the episodes
            define.
        episodes: folders of the episodes.

    Raises:
        ConfigError: see `own_tasks` and `chosen_task`.
    """
    if word is None or word.endswith(YAML):
        return word
    own = tuple(own_tasks(episodes).values())
    found = chosen_task(word, own)
    return found if found in own else word


def chosen_task(word: str | None, own: Iterable[TaskSpec]) -> TaskSpec | None:
    """Return the task that a user names; None = the user names none.

    Args:
        word: YAML file of a task, name of a bundled task, or name of one of `own`.
        own: tasks that the episodes define.

    Raises:
        ConfigError: there is no such task, the file cannot be used, or the name has two
            different definitions.
    """
    if word is None:
        return None
    if word.endswith(YAML):
        return load_task(Path(word).expanduser())
    known = {task.name: task for task in bundled_tasks()}
    defined = {task.name: task for task in own}
    if word in known and defined.get(word, known[word]) != known[word]:
        raise ConfigError(
            f"task '{word}' is a bundled one, and the episodes define another one of this name; "
            'give --task the YAML file of the one that is meant'
        )
    found = {**known, **defined}
    if word not in found:
        raise ConfigError.unknown(
            'task',
            word,
            sorted(found),
            is_not=' is not known',
            listed='; known are',
            advice=' (or give the YAML file of a task)',
        )
    return found[word]
