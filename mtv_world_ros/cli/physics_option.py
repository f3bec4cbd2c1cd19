"""The option `--physics`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mtv_world_ros.simulation.physics import physics_named

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import CommandParser


def add_physics(parser: CommandParser) -> None:
    """Add `--physics`."""
    parser.add_advanced(
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
