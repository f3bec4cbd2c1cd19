"""Writes the tables of what is bundled into their pages: `python docs/bundled_tables.py`.

A table follows a line `<!-- bundled: NAME -->` and ends at an empty line. Its rows are the files
of a folder of `config`, or the classes of a registry with their docstrings.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator, Mapping
from importlib.util import find_spec
import inspect
from pathlib import Path
import re

from mtv_world_ros.control.registry import CONTROLS
from mtv_world_ros.core.config import read_yaml
from mtv_world_ros.core.files import bundled_names, ROBOT_YAML, share_path, WORKCELL_YAML
from mtv_world_ros.policies.kinds import POLICY_KINDS
from mtv_world_ros.success.task import load_task
from mtv_world_ros.vision.segmenters.registry import SEGMENTERS

DOCS = Path(__file__).parent
PAGES = ('objects.md', 'policies.md', 'robots.md', 'tasks.md', 'training.md')
_TABLE = re.compile(r'(<!-- bundled: (\w+) -->\n\n)(?:\|.*\n)*')
#: heading of a section of a docstring
_SECTION = re.compile(r'^(Attributes|Args|Returns|Raises):$', re.M)
#: choices of `--segmenter` that are no class of the registry
_MORE_SEGMENTERS = """\
| a file `objects.safetensors` | Objects by [boxes that you drew](#boxes-drawn-once), others as \
`colour` does. Needs an import with `--objects`. |
| `module:Class`, or an entry point of `mtv_world.segmenters` | \
[Your own](#a-segmenter-of-your-own). |
""".splitlines()
_MORE_CONTROLS = """\
| `module:Class`, or an entry point of `mtv_world.controls` | \
[Your own](architecture.md#a-control-of-your-own). |
""".splitlines()


def written_page(text: str) -> str:
    """Return the page with its tables of today."""
    return _TABLE.sub(lambda match: match[1] + ''.join(f'{r}\n' for r in TABLES[match[2]]()), text)


def _tasks() -> Iterator[str]:
    folder = share_path('config', 'tasks')
    yield from ('| task | instruction | in the simulator |', '|---|---|---|')
    for path in [*sorted(folder.glob('*.yaml')), *sorted(folder.glob('*/*.yaml'))]:
        task = load_task(path)
        use = 'yes' if task.scene is not None else 'no: judged only'
        use = 'zero-shot sets only' if path.parent.name == 'zero_shot' else use
        link = f'../config/tasks/{path.relative_to(folder)}'
        yield f'| [`{task.name}`]({link}) | {task.instruction} | {use} |'


def _robots() -> Iterator[str]:
    yield from ('| robot | | views in the simulator |', '|---|---|---|')
    for name in bundled_names('robots'):
        folder = share_path('config', 'robots', name)
        views = ''
        if (folder / WORKCELL_YAML).is_file():
            cameras = read_yaml(folder / WORKCELL_YAML, 'workcell file', 'robot')['cameras']
            views = ', '.join(_view(camera) for camera in cameras)
        link = f'../config/robots/{name}/{ROBOT_YAML}'
        yield f'| [`{name}`]({link}) | {_comment(folder / ROBOT_YAML)} | {views} |'


def _view(camera: Mapping[str, str]) -> str:
    """Return a camera of a workcell in words."""
    return f'`{camera["view"]}`' + (f' (on `{camera["link"]}`)' if 'link' in camera else '')


def _comment(file: Path) -> str:
    """Return the comment at the beginning of a YAML file."""
    lines = file.read_text(encoding='utf-8').splitlines()
    count = next(k for k, line in enumerate(lines) if not line.startswith('#'))
    return ' '.join(line.removeprefix('#').strip() for line in lines[:count])


def _controls() -> Iterator[str]:
    yield from ('| `video.control` | |', '|---|---|', *_classes(CONTROLS), *_MORE_CONTROLS)


def _segmenters() -> Iterator[str]:
    yield from ('| segmenter | finds |', '|---|---|', *_classes(SEGMENTERS), *_MORE_SEGMENTERS)


def _policies() -> Iterator[str]:
    yield from ('| kind | policy | bundled examples |', '|---|---|---|')
    folder = share_path('config', 'policies')
    examples: dict[str, list[str]] = {}
    for name in bundled_names('policies'):
        kind = read_yaml(folder / f'{name}.yaml', 'policy file', 'policy')['kind']
        examples.setdefault(kind, []).append(f'[`{name}`](../config/policies/{name}.yaml)')
    for kind, row in zip(POLICY_KINDS, _classes(POLICY_KINDS), strict=True):
        yield f'{row} {", ".join(examples.get(kind, ["see below"]))} |'


def _classes(registry: Mapping[str, str]) -> Iterator[str]:
    """Return the beginning of a row for each name: what its class's docstring says."""
    for name, target in registry.items():
        yield f'| `{name}` | {_described(target).replace("|", chr(92) + "|")} |'


def _described(target: str) -> str:
    """Return the docstring of `module:Class` up to its sections; the module is not imported."""
    module, _, name = target.partition(':')
    spec = find_spec(module)
    assert spec is not None and spec.origin is not None
    tree = ast.parse(Path(spec.origin).read_text(encoding='utf-8'))
    found = next(n for n in tree.body if isinstance(n, ast.ClassDef) and n.name == name)
    text = inspect.cleandoc(ast.get_docstring(found) or '')
    return ' '.join(_SECTION.split(text)[0].split())


TABLES: Mapping[str, Callable[[], Iterator[str]]] = {
    'controls': _controls,
    'policies': _policies,
    'robots': _robots,
    'segmenters': _segmenters,
    'tasks': _tasks,
}


if __name__ == '__main__':
    for page in PAGES:
        path = DOCS / page
        path.write_text(written_page(path.read_text(encoding='utf-8')), encoding='utf-8')
