"""Selection of the episodes of a data set: splits, and fault kinds of the recorded policies."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ValidationError

from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.entry_points import policy_kind
from mtv_world_ros.core.errors import ConfigError, EpisodeError, PolicyError
from mtv_world_ros.data.episode import EpisodeInfo
from mtv_world_ros.data.episode_reader import list_episodes, read_info
from mtv_world_ros.data.other_formats import conversion_hint

#: key of the metadata that names the policy of an episode
POLICY = 'policy'
#: key of the metadata that names the split of the policy's fault kinds
FAULT_SPLIT = 'fault_split'
#: name of the kind of scripted policies
_SCRIPTED_KIND = 'scripted'
#: prefix of the names of scripted policies
_SCRIPTED_PREFIX = 'expert'
#: name of the split whose fault kinds are for rankings alone
_TEST = 'test'


def recorded_policy(path: Path) -> str:
    """Return the scripted policy of an episode; empty = another one, or not recorded.

    Raises:
        EpisodeError: the episode's metadata cannot be used.
    """
    name = read_info(path).metadata.get(POLICY, '')
    return name if name.split('-')[0] == _SCRIPTED_PREFIX else ''


def recorded_kinds(paths: Iterable[Path]) -> dict[Path, tuple[str, ...]]:
    """Return the fault kinds of episodes of scripted policies.

    Raises:
        ConfigError: the simulator, which knows scripted policies, is not installed.
        EpisodeError: the metadata of an episode cannot be used.
        PolicyError: a policy has an unknown fault.
    """
    named = {Path(path): recorded_policy(path) for path in paths}
    scripted = {path: policy for path, policy in named.items() if policy}
    if not scripted:
        return {}
    kind = policy_kind(_SCRIPTED_KIND)
    return {path: kind.fault_kinds(policy) for path, policy in scripted.items()}


def refuse_test_kinds(paths: Iterable[Path], what: str) -> None:
    """Refuse episodes of policies with faults of the split `test`.

    Args:
        paths: folders of episodes.
        what: purpose that such episodes are refused for, e.g. `training`.

    Raises:
        ConfigError: an earlier episode names a policy alone, and the simulator, which knows its
            faults, is not installed.
        EpisodeError: the metadata of an episode cannot be used.
        PolicyError: names the policies and their kinds.
    """
    read = [read_info(path).metadata for path in paths]
    of_test = {m.get(POLICY, '') for m in read if _TEST in m.get(FAULT_SPLIT, '').split(',')}
    if of_test:
        raise PolicyError(
            f'fault kinds of the split {_TEST} are not for {what}: policies of these episodes '
            f'have some: {", ".join(sorted(of_test))}; leave the episodes out'
        )
    # earlier episodes do not say it: the name does
    names = {m.get(POLICY, '') for m in read if FAULT_SPLIT not in m}
    scripted = sorted(name for name in names if name.split('-')[0] == _SCRIPTED_PREFIX)
    if scripted:
        policy_kind(_SCRIPTED_KIND).refuse_test_kinds(scripted, what)


#: describes a data set; `mtv-world collect` writes it
CARD_FILE = 'dataset.json'
EVERY = 'all'


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """Episodes to score.

    Attributes:
        paths: folders of the episodes.
        split: split of the chosen episodes; `all` where the data set has no splits.
        zero_shot: property that the model was not trained for (`view`, `task` or `object`), by
            folder, where the data set states one.
        num_in_dataset: number of episodes in the data set.
    """

    paths: Sequence[Path]
    split: str
    zero_shot: Mapping[Path, str]
    num_in_dataset: int

    def __str__(self) -> str:
        return f'{len(self.paths)} of {self.num_in_dataset} episodes, split {self.split}'


def find_episodes(dataset: Path) -> list[Path]:
    """Return the episode folders anywhere in a folder, by path; see `list_episodes`.

    Raises:
        EpisodeError: there is none; says how to get some, also from other formats.
    """
    found = list_episodes(dataset)
    if not found:
        advice = conversion_hint(dataset) or (
            "; record some with 'ros2 bag record -s mcap' or 'mtv-world collect'"
        )
        raise EpisodeError(
            f"'{dataset}' holds no episodes (folders with metadata.yaml and an .mcap){advice}"
        )
    return found


def select(
    dataset: Path, split: str | None = None, limit: int | None = None, *, default: str = 'test'
) -> Selection:
    """Return the episodes of a split.

    Args:
        dataset: folder with episode folders in it; its `dataset.json`, if there is one, names the
            splits and, per episode, `zero_shot`: `view`, `task` or `object`.
        split: name of a split, or `all`; None = `default` where the data set has it, else `all`.
        limit: maximum number of episodes; the first ones are kept.
        default: name of the split where none is given, see `split`.

    Raises:
        EpisodeError: the folder holds no episodes, or none of the split.
        ConfigError: no such split, the card cannot be read, or siblings are not of one scene or
            not in one split.
    """
    found = find_episodes(dataset)
    card = _card(dataset)
    _check_siblings(dataset, card)
    if split is None:
        split = default if card.splits.get(default) else EVERY
    names = _names(dataset, card.splits, split)
    paths = [path for path in found if names is None or path.name in names][:limit]
    if not paths:
        raise EpisodeError(f"split '{split}' of '{dataset}' has no episodes in the folder")
    marks = {entry.name: entry.zero_shot or '' for entry in card.episodes}
    return Selection(
        paths=paths,
        split=split,
        zero_shot={path: marks[path.name] for path in paths if marks.get(path.name)},
        num_in_dataset=len(found),
    )


def spread(paths: Sequence[Path], count: int | None) -> list[Path]:
    """Return `count` of the paths, spread evenly.

    The first paths by name would all belong to one task.
    """
    if count is None or count >= len(paths):
        return list(paths)
    return [paths[index * len(paths) // count] for index in range(count)]


def of_physics(selection: Selection, physics: str | None = None) -> tuple[Selection, str]:
    """Return the episodes of one physics, and a text with the physics and number of episodes.

    Args:
        selection: episodes to choose from.
        physics: name given to `collect --physics`; None = all episodes.

    Raises:
        ConfigError: no episode is of this physics.
    """
    found = {path: _physics(read_info(path)) for path in selection.paths}
    if physics is None:
        counts = Counter(found.values())
        return selection, ', '.join(f'{name} ({num})' for name, num in counts.most_common())
    paths = [path for path, name in found.items() if name == physics]
    if not paths:
        known = sorted(set(found.values()))
        raise ConfigError.unknown(
            'no episode is of the physics', physics, known, listed=' (--physics); there are'
        )
    return replace(selection, paths=paths), f'{physics} ({len(paths)})'


def _physics(info: EpisodeInfo) -> str:
    """Return the name of an episode's physics; older simulated episodes do not store it."""
    return info.physics or 'not stated'


def task_definitions(dataset: Path) -> dict[str, dict[str, Any]]:
    """Return the definitions of a data set's tasks that are not bundled, by name of the task.

    Args:
        dataset: folder of the data set; without `dataset.json`, or with one of an earlier
            version, it defines none.

    Raises:
        ConfigError: the card cannot be read.
    """
    return _card(dataset).task_definitions


def splits_of(dataset: Path) -> dict[str, list[str]]:
    """Return the names of a data set's episodes by split; empty if it has none.

    Raises:
        ConfigError: the card cannot be read.
    """
    return _card(dataset).splits


class _Entry(BaseModel):
    """An episode in `dataset.json`: its name, what is zero-shot in it, scene and seed if any."""

    name: str
    scene: Annotated[str, BeforeValidator(lambda given: given or '')] = ''
    zero_shot: Any = None
    seed: Any = None


class _Card(BaseModel):
    """Entries of `dataset.json` that are used; other entries are ignored."""

    splits: dict[str, list[str]] = {}
    episodes: list[_Entry] = []
    task_definitions: dict[str, dict[str, Any]] = {}


def _card(dataset: Path) -> _Card:
    file = dataset / CARD_FILE
    if not file.is_file():
        return _Card()
    try:
        card = read_json(file)
    except (OSError, ValueError) as error:
        raise ConfigError(f"'{file}' is not a data set card: {error}") from error
    try:
        return _Card.model_validate(card)
    except ValidationError as error:
        raise ConfigError(
            f"'{file}' is not a data set card: 'splits', 'episodes' or 'task_definitions' are not "
            "as 'mtv-world collect' writes them"
        ) from error


def _check_siblings(dataset: Path, card: _Card) -> None:
    """Refuse siblings of different scenes, and of different splits."""
    places = {name: split for split, names in card.splits.items() for name in names}
    firsts: dict[str, _Entry] = {}
    for entry in card.episodes:
        if not entry.scene:
            continue
        first = firsts.setdefault(entry.scene, entry)
        names = f"'{first.name}' and '{entry.name}' of '{dataset}'"
        if first.seed != entry.seed:
            raise ConfigError(
                f'{names} are called siblings of scene {entry.scene}, but their scenes are drawn '
                f'from the seeds {first.seed} and {entry.seed}; siblings share a seed'
            )
        if places.get(first.name) != places.get(entry.name):
            raise ConfigError(
                f'{names} are siblings, but in the splits {places.get(first.name)} and '
                f'{places.get(entry.name)}; keep the siblings of a scene in one split'
            )


def _names(dataset: Path, splits: Mapping[str, Any], split: str) -> set[str] | None:
    """Return the names of a split's episodes; None = all."""
    if split == EVERY:
        return None
    if split not in splits:
        raise ConfigError.unknown(
            'split', split, [*splits, EVERY], listed=f" is not one of '{dataset}', which has"
        )
    return set(splits[split])
