"""The option `--physics`."""

from __future__ import annotations

import argparse

from mtv_world_ros.simulation.physics import physics_named


def add_physics(parser: argparse.ArgumentParser) -> None:
    """Add `--physics`."""
    parser.add_argument(
        '--physics',
        default='nominal',
        metavar='NAME',
        help='physics of the simulator, a name in config/physics.yaml: nominal (default), in '
        'which the bundled model was fitted, so that agreement flatters, or a shift such as bold '
        'or delay_100ms, which the world model does not know',
    )


def physics_text(name: str) -> str:
    """Return a physics' name and text, for pages.

    Raises:
        SimulatorError: unknown name.
    """
    return f'{name}: {physics_named(name).text}'
