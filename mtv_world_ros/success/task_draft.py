"""Draft of a task from an instruction and the names of its objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import re
from string import ascii_lowercase

import yaml

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.success.relations import KINDS
from mtv_world_ros.success.task import stored_task, TaskSpec

#: words of an instruction -> relation that they mean, the first that occurs
_MEANINGS = (
    (r'left of', 'left_of'),
    (r'right of', 'right_of'),
    (r'shake', 'shaken'),
    (r'on|onto|on top of|over|in|into|inside|stack', 'rests_on'),
    (r'apart|away from', 'apart'),
    (r'move|push|pull|slide|lift|pick|take|bring|remove', 'moved'),
)


@dataclass(frozen=True, slots=True)
class TaskDraft:
    """A drafted task.

    Attributes:
        task: the task.
        text: its file, with what was guessed in comments.
    """

    task: TaskSpec
    text: str


def draft_task(instruction: str, objects: Sequence[str], relation: str = '') -> TaskDraft:
    """Return a task in which the objects of an instruction are placeholders.

    Args:
        instruction: text for the robot.
        objects: names of its objects, as the instruction says them. The last one is what the
            others are placed by, where the relation has a target.
        relation: kind of the relation; empty = guessed from the words of the instruction.

    Raises:
        ConfigError: the instruction lacks an object, or no relation can be guessed.
    """
    said = ' '.join(instruction.lower().split()).rstrip('.! ')
    template, roles = _template(said, [name.lower().strip() for name in objects])
    kind = relation or _guessed(template)
    if kind not in KINDS:
        words = 'which is not known' if relation else 'which its words do not tell'
        raise ConfigError(
            f"'{instruction}': the draft needs a relation between the objects, {words}; give "
            f'--relation, one of {", ".join(sorted(KINDS))} (docs/tasks.md)'
        )
    values = {
        'name': re.sub(r'\W+', '_', template).strip('_'),
        'instruction': template,
        'relations': _relations(kind, roles),
        'gripper': 'released',
    }
    named = ', '.join(f'{role}: {name}' for name, role in roles.items())
    source = 'given' if relation else 'guessed from the words'
    notes = [f'# {named}', f'# all relations must hold; {kind} is {source} (docs/tasks.md)']
    text = '\n'.join([*notes, yaml.safe_dump(values, sort_keys=False, width=95)])
    return TaskDraft(stored_task(values, 'the draft'), text)


def _template(said: str, names: Sequence[str]) -> tuple[str, dict[str, str]]:
    """Return the instruction with placeholders, and their letters by object."""
    absent = [name for name in names if not _whole(name).search(said)]
    if absent or not names:
        raise ConfigError(
            f"'{said}' does not hold {absent[0] if absent else 'an object'!r}; give the objects "
            'with --objects as the instruction says them, e.g. --objects "red cube,plate"'
        )
    roles = dict(zip(dict.fromkeys(names), ascii_lowercase, strict=False))
    for name in sorted(roles, key=len, reverse=True):  # 'cup' is in 'red cup', too
        said = _whole(name).sub(f'{{{roles[name]}}}', said)
    return said, roles


def _whole(name: str) -> re.Pattern[str]:
    return re.compile(rf'(?<!\w){re.escape(name)}(?!\w)')


def _guessed(template: str) -> str:
    found = (kind for words, kind in _MEANINGS if re.search(rf'\b({words})\b', template))
    return next(found, '')


def _relations(kind: str, roles: dict[str, str]) -> list[dict[str, object]]:
    """Return a relation for each object that is moved."""
    letters = list(roles.values())
    if 'target' not in KINDS[kind].model_fields:
        return [{'kind': kind, 'subject': letter} for letter in letters]
    if len(letters) < 2:
        raise ConfigError(
            f"the relation '{kind}' needs a second object, which the first is placed by; name it "
            'in --objects, or give another --relation'
        )
    return [{'kind': kind, 'subject': a, 'target': letters[-1]} for a in letters[:-1]]
