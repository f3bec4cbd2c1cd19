"""Writes the tables of node parameters into the pages: `python docs/parameter_tables.py`.

A table follows a line `<!-- parameters: NAME -->` and ends at an empty line; `NAME basic` are the
parameters that most users set, `NAME advanced` the others.
"""

from __future__ import annotations

from pathlib import Path
import re

from mtv_world_ros.core.config import Schema
from mtv_world_ros.ros.parameters import is_read_only, Settings, shown_default, valid_values
from mtv_world_ros.ros.policy.loop import PolicySettings
from mtv_world_ros.ros.sensing.live_start import StartSettings

NODES: dict[str, type[Schema]] = {
    'world_model': Settings,
    'policy': PolicySettings,
    'imagine': StartSettings,
}
PAGES = ('parameters.md', 'policies.md')
_TABLE = re.compile(r'(<!-- parameters: (\w+)(?: (basic|advanced))? -->\n\n)(?:\|.*\n)*')


def filled(page: str) -> str:
    """Return the page with its tables as the nodes' settings have them."""
    return _TABLE.sub(lambda match: match[1] + _table(NODES[match[2]], match[3]), page)


def _table(kind: type[Schema], tier: str | None) -> str:
    rows = ['| parameter | default | valid | |', '|---|---|---|---|']
    for name, field in sorted(
        kind.model_fields.items(), key=lambda item: not is_read_only(item[1])
    ):
        if tier and (name in kind.basic) != (tier == 'basic'):
            continue
        star = '*' if is_read_only(field) else ''
        default, valid = shown_default(field), valid_values(field)
        rows.append(f'| `{name}`{star} | {default} | {valid} | {field.description} |')
    return '\n'.join([*rows, ''])


if __name__ == '__main__':
    for name in PAGES:
        path = Path(__file__).parent / name
        path.write_text(filled(path.read_text(encoding='utf-8')), encoding='utf-8')
