"""Parts of help texts that name what is bundled, read from its folder or registry."""

from __future__ import annotations

from mtv_world_ros.core.files import bundled_names, WORKCELL_YAML
from mtv_world_ros.vision.segmenters.registry import SEGMENTERS


def robots(*, in_simulator: bool = False) -> str:
    """Return the valid values of `--robot`.

    Args:
        in_simulator: only robots with a workcell.
    """
    holding = WORKCELL_YAML if in_simulator else ''
    return f'{", ".join(bundled_names("robots", holding))}, a robot YAML or its folder'


def presets() -> str:
    """Return the valid values of `--preset`."""
    return f'{", ".join(bundled_names("models"))}, or a YAML file'


def policies() -> str:
    """Return the names of bundled policy files."""
    return ', '.join(bundled_names('policies'))


def segmenters() -> str:
    """Return the names of bundled segmenters."""
    return ', '.join(SEGMENTERS)
