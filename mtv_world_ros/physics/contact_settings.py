"""Physical parameters of the rigid bodies, which masks do not show."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from mtv_world_ros.core.config import Metres, Schema

Friction = Annotated[float, Field(ge=0.01, le=10)]
Thickness = Annotated[float, Field(ge=1e-4, le=0.1)]


class ContactSpread(Schema):
    """Standard deviations of what futures begin with."""

    place_m: float = Field(default=0.001, ge=0, le=1, description='of where objects are [m]')
    camera_m: float = Field(
        default=0.0,
        ge=0,
        le=0.1,
        description='of where the cameras see everything, alike for all objects [m]',
    )
    turn_rad: float = Field(default=0.02, ge=0, le=4, description='of how they are turned [rad]')
    size: float = Field(default=0.015, ge=0, le=1, description='of their sizes, relative')
    friction: float = Field(default=0.2, ge=0, le=3, description='of what rubs, relative')
    weight: float = Field(default=0.3, ge=0, le=3, description='of densities, relative')
    grip: float = Field(
        default=0.2, ge=0, le=3, description='of the friction of fingers, relative'
    )
    force: float = Field(default=0.2, ge=0, le=3, description='of the force of fingers, relative')
    zero_rad: float = Field(default=0.002, ge=0, le=1, description='of the zeros of joints [rad]')
    delay_s: float = Field(
        default=0.005, ge=0, le=1, description='of how late commands take effect [s]'
    )


#: recordings that must tell whether things slip before verdicts rest on numbers of contact
ENOUGH_TELLING = 3


class ContactOrigin(Schema):
    """Recordings that contact settings were fitted to."""

    by: str = Field(description='the command')
    recordings: int = Field(ge=0, description='that were looked at')
    telling: int = Field(ge=0, description='that tell whether things slip between fingers')


class ContactSettings(Schema):
    """Numbers of contact, found in recorded episodes (`training/object_motion/contact_fit.py`)."""

    fitted: ContactOrigin | None = Field(
        default=None, description='what compared these numbers with recordings; None = nothing did'
    )

    finger_stiffness: float = Field(ge=0.1, le=1e6, description='of each finger [N/m]')
    finger_damping: float = Field(ge=1e-3, le=1e5, description='of each finger [N s/m]')
    finger_mass_kg: float = Field(ge=1e-4, le=10, description='of its drive')
    fingers_swing: bool = Field(default=False, description='each for itself, as the hand moves')
    pad_stiffness: float | None = Field(
        default=None,
        ge=10,
        le=1e7,
        description='with which finger tips give way [N/m]; None = they do not',
    )
    grip_friction: Friction = Field(description='of fingers on what they touch')
    table_friction: Friction = Field(description='of all else')
    density: float = Field(ge=10, le=25_000, description='of objects [kg/m^3]')
    tray_kg: float = Field(ge=1e-3, le=100, description='of a wide box without a lid')
    rim_m: Thickness = Field(default=0.01, description='thickness of the rim of plates and bowls')
    wall_m: Thickness = Field(default=0.005, description='of the walls of cups and of boxes')
    table_m: Metres = Field(default=0.0, description='its height in the base frame [m]')
    table_varies: bool = Field(
        default=False,
        description='it stands at another height in each recording: it is where objects of the '
        'first frame end below, and arms do not touch it',
    )
    squeeze: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description='share of its travel by which a gripper that is not open closes further than '
        'it is told: measured positions that stand for commands stop at what is held',
    )
    grips_hold: bool = Field(
        default=False,
        description='what stops measured fingers short of shut is held until they open, whatever '
        'contact would do: of recordings whose commands are measured positions',
    )
    delay_s: float = Field(
        default=0.0, ge=0, le=1, description='by which commands take effect later [s]'
    )
    spread: ContactSpread = Field(
        default=ContactSpread(), description='how exactly all this is known'
    )
    num_motions: int = Field(default=4, ge=1, le=64, description='the last ones disturbed')

    @property
    def doubt(self) -> str:
        """Reason why these settings do not hold for a real place; empty if fitted there."""
        if self.fitted is None:
            return 'numbers of contact (contact.json) were never fitted on recordings'
        telling, count = self.fitted.telling, self.fitted.recordings
        if telling >= ENOUGH_TELLING:
            return ''
        return (
            f'{telling} of the {count} recordings that numbers of contact (contact.json) were '
            'fitted on tell whether things slip between fingers, fewer than '
            f'{ENOUGH_TELLING}'
        )
