"""What rigid bodies are given beside the shapes that masks show."""

from __future__ import annotations

from pydantic import Field

from mtv_world_ros.config import NotNegative, Positive, Schema


class ContactSpread(Schema):
    """How exactly what futures begin with is known: standard deviations."""

    place_m: NotNegative = Field(default=0.001, description='of where objects are [m]')
    turn_rad: NotNegative = Field(default=0.02, description='of how they are turned [rad]')
    size: NotNegative = Field(default=0.015, description='of their sizes, relative')
    friction: NotNegative = Field(default=0.2, description='of what rubs, relative')
    weight: NotNegative = Field(default=0.3, description='of densities, relative')
    grip: NotNegative = Field(default=0.2, description='of the friction of fingers, relative')
    force: NotNegative = Field(default=0.2, description='of the force of fingers, relative')
    zero_rad: NotNegative = Field(default=0.002, description='of the zeros of joints [rad]')
    delay_s: NotNegative = Field(default=0.005, description='of how late commands take effect [s]')


class ContactSettings(Schema):
    """Numbers of contact, found in recorded episodes (`training/object_motion/contact_fit.py`)."""

    finger_stiffness: Positive = Field(description='of each finger [N/m]')
    finger_damping: Positive = Field(description='of each finger [N s/m]')
    finger_mass_kg: Positive = Field(description='of its drive')
    fingers_swing: bool = Field(default=False, description='each for itself, as the hand moves')
    pad_stiffness: Positive | None = Field(
        default=None, description='with which finger tips give way [N/m]; None = they do not'
    )
    grip_friction: Positive = Field(description='of fingers on what they touch')
    table_friction: Positive = Field(description='of all else')
    density: Positive = Field(description='of objects [kg/m^3]')
    tray_kg: Positive = Field(description='of a wide box without a lid')
    rim_m: Positive = Field(default=0.01, description='thickness of the rim of plates and bowls')
    wall_m: Positive = Field(default=0.005, description='of the walls of cups and of boxes')
    table_m: float = Field(default=0.0, description='its height in the base frame [m]')
    spread: ContactSpread = Field(
        default=ContactSpread(), description='how exactly all this is known'
    )
    num_motions: int = Field(default=4, ge=1, le=64, description='the last ones disturbed')
