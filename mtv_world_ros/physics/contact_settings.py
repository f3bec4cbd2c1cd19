"""Physical parameters of the rigid bodies, which masks do not show."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.special import ndtri
from scipy.stats import qmc

from mtv_world_ros.core.config import ListOf, Metres, Schema

Friction = Annotated[float, Field(ge=0.01, le=10)]
Thickness = Annotated[float, Field(ge=1e-4, le=0.1)]


class ContactSpread(Schema):
    """Standard deviations of the quantities that differ between futures."""

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


#: range of each contact parameter; that of the stiffness is a factor of the first settings
RANGES = {
    'grip_friction': (0.03, 3.0),
    'table_friction': (0.15, 2.5),
    'density': (60.0, 3000.0),
    'finger_stiffness': (0.2, 3.0),
}
#: parameters whose range is a factor of the first settings
FACTORS = frozenset({'finger_stiffness'})
#: prior standard deviation of the logarithm of a contact parameter that was not fitted
PRIOR_LOG_STD = 1.0
#: prior standard deviation of the common camera error where the cameras were not measured [m]
PRIOR_CAMERA_M = 0.002
#: largest number of futures of a plan
MAX_MOTIONS = 64
#: recordings that must tell whether things slip before verdicts rest on numbers of contact, of
#: files that do not say within which factor it is known
ENOUGH_TELLING = 3
#: factor between the ends of the 90 % interval of what decides whether things slip, above which no
#: verdict rests on it: that of the prior of a single parameter
MAX_HOLD_FACTOR = float(np.exp(2 * ndtri(0.95) * PRIOR_LOG_STD))


#: friction x stiffness of fingers / density [N m^2/kg]
HoldParameter = Annotated[float, Field(gt=0, le=1e9)]


class ContactOrigin(Schema):
    """Recordings that contact settings were fitted to."""

    by: str = Field(description='the command')
    recordings: int = Field(ge=0, description='that were looked at')
    telling: int = Field(ge=0, description='that tell whether things slip between fingers')
    place: str | None = Field(
        default=None,
        description='robot cell of the recordings; null = older file, which holds everywhere',
    )
    hold: ListOf[HoldParameter] = Field(
        default=(),
        max_length=2,
        description='90 % interval of friction x stiffness of fingers / density, which decides '
        'whether things slip [N m^2/kg]; empty = older file',
    )


def hold_line(low: float, high: float) -> str:
    """Return within which factor it is known whether things slip, and what that is enough for.

    Args:
        low: lower end of the 90 % interval of friction x stiffness of fingers / density.
        high: upper end of that interval.
    """
    known = (
        f'whether things slip between fingers is known within a factor of {high / low:.3g} '
        f'({low:.3g} to {high:.3g} N m^2/kg, 90 %)'
    )
    if high <= MAX_HOLD_FACTOR * low:
        return f'{known}: within {MAX_HOLD_FACTOR:.0f}, so that verdicts may rest on it'
    return f'{known}, not within {MAX_HOLD_FACTOR:.0f} as verdicts need it'


class ContactDraw(Schema):
    """Joint sample of the contact parameters that make up for each other."""

    grip_friction: Friction = Field(description='of fingers on what they touch')
    table_friction: Friction = Field(description='of all else')
    density: float = Field(ge=10, le=25_000, description='of objects [kg/m^3]')
    finger_stiffness: float = Field(ge=0.1, le=1e6, description='of each finger [N/m]')


@lru_cache
def _standard_draws() -> np.ndarray:
    """Return (`MAX_MOTIONS`, P) standard normal draws of the parameters, evenly spread."""
    return ndtri(qmc.Sobol(len(RANGES), rng=np.random.default_rng(4)).random(MAX_MOTIONS))


class ContactSettings(Schema):
    """Contact parameters, found in recorded episodes (`physics/fitting/contact_fit.py`)."""

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
    stop_holds: float = Field(
        default=1.0,
        ge=0,
        le=1,
        description='with grips_hold: share of the stops of measured fingers at an object that '
        'hold it; in the other futures contact alone decides',
    )
    delay_s: float = Field(
        default=0.0, ge=0, le=1, description='by which commands take effect later [s]'
    )
    spread: ContactSpread = Field(
        default=ContactSpread(), description='how exactly all this is known'
    )
    draws: ListOf[ContactDraw] = Field(
        default=(),
        description='equally likely joint samples of friction, density and stiffness, one a '
        'future; empty = futures differ independently by `spread`',
    )
    num_motions: int = Field(
        default=4, ge=1, le=MAX_MOTIONS, description='the last ones disturbed'
    )

    def is_fitted_at(self, place: str) -> bool:
        """Return True if the parameters were fitted on recordings of a robot cell.

        Args:
            place: name of the robot cell, see `EpisodeInfo.place`; empty = not stated.
        """
        if self.fitted is None or self.fitted.place not in (None, place):
            return False
        # draws of a fit hold how little it tells; files of before have a count alone
        return bool(self.fitted.hold) or not self.doubt

    def as_prior(self) -> ContactSettings:
        """Return the settings with the wide prior of the parameters in place of their fit.

        It is the initial prior of `mtv-world fit contact`: log-normal around these
        settings, within `RANGES`. The first future keeps the settings.
        """
        factors = [getattr(self, name) if name in FACTORS else 1.0 for name in RANGES]
        low, high = np.log(np.array(list(RANGES.values())).T * factors)
        middle = np.log([getattr(self, name) for name in RANGES])
        rows = np.exp(np.clip(middle + PRIOR_LOG_STD * _standard_draws(), low, high))
        draws = [ContactDraw(**dict(zip(RANGES, row, strict=True))) for row in rows.tolist()]
        spread = self.spread.replace(camera_m=max(self.spread.camera_m, PRIOR_CAMERA_M))
        return self.model_copy(update={'draws': tuple(draws), 'spread': spread})

    @property
    def doubt(self) -> str:
        """Reason why these settings do not hold for a real place; empty if fitted there."""
        if self.fitted is None:
            return 'numbers of contact (contact.json) were never fitted on recordings'
        telling, count = self.fitted.telling, self.fitted.recordings
        if self.fitted.hold:
            low, high = self.fitted.hold
            return '' if high <= MAX_HOLD_FACTOR * low else hold_line(low, high)
        if telling >= ENOUGH_TELLING:
            return ''
        return (
            f'{telling} of the {count} recordings that numbers of contact (contact.json) were '
            'fitted on tell whether things slip between fingers, fewer than '
            f'{ENOUGH_TELLING}'
        )
