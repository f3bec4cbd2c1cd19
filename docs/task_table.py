"""Writes the table of tasks into its page: `python docs/task_table.py`."""

from __future__ import annotations

from pathlib import Path
import re

from mtv_world_ros.core.files import share_path
from mtv_world_ros.success.task import load_task

PAGE = Path(__file__).parent / 'tasks.md'
#: lines of the page between which the table stands
_BEGIN = '<!-- written by `python docs/task_table.py` -->\n'
_END = '<!-- end of the table -->\n'


def table() -> str:
    """Return the table of the files in `config/tasks`, in the order of their names."""
    folder = share_path('config', 'tasks')
    lines = ['| task | instruction | in the simulator |', '|---|---|---|']
    for path in [*sorted(folder.glob('*.yaml')), *sorted(folder.glob('*/*.yaml'))]:
        task = load_task(path)
        use = 'yes' if task.scene is not None else 'no: judged only'
        use = 'zero-shot sets only' if path.parent.name == 'zero_shot' else use
        link = f'../config/tasks/{path.relative_to(folder)}'
        lines.append(f'| [`{task.name}`]({link}) | {task.instruction} | {use} |')
    return '\n'.join([*lines, ''])


def page() -> str:
    """Return the text of the page with the table of today."""
    text = PAGE.read_text(encoding='utf-8')
    between = re.compile(f'{re.escape(_BEGIN)}.*?{re.escape(_END)}', re.S)
    return between.sub(lambda _: f'{_BEGIN}\n{table()}\n{_END}', text)


if __name__ == '__main__':
    PAGE.write_text(page(), encoding='utf-8')
