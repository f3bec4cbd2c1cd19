"""Templates of MuJoCo's scene description (MJCF), in `config/mjcf`."""

from __future__ import annotations

from functools import cache
import math

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template

from mtv_world_ros.core.files import share_path


def template(name: str) -> Template:
    """Return the template `config/mjcf/<name>.xml.j2`."""
    return _environment().get_template(f'{name}.xml.j2')


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(share_path('config', 'mjcf')),
        undefined=StrictUndefined,
        autoescape=False,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters['numbers'] = lambda values: ' '.join(f'{value:.9g}' for value in values)
    environment.filters['shaded'] = lambda rgb, factor: [channel * factor for channel in rgb]
    names = ('pi', 'tan', 'sin', 'cos', 'atan2', 'hypot')
    environment.globals |= {name: getattr(math, name) for name in names}
    return environment
