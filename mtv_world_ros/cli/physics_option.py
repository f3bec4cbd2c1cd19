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
        help="what is true in the simulator, of config/physics.yaml: 'nominal', which flatters, "
        'or a shift such as bold or delay_100ms; the world model is told nothing of it',
    )


def physics_text(name: str) -> str:
    """Return a physics' name and text, for pages.

    Raises:
        SimulatorError: unknown name.
    """
    return f'{name}: {physics_named(name).text}'
