"""Errors raised on purpose: each says the value, what would be valid, and where to set it."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from enum import StrEnum
from itertools import islice
from typing import Self, TypedDict, Unpack

from mtv_world_ros.core.extras import needs_text
from mtv_world_ros.core.shown_text import MOST_OF_ERROR, shown


class UnknownNameText(TypedDict, total=False):
    """Parts of the text on a name that is not known, each with its own punctuation.

    Attributes:
        is_not: words behind the name; ` is not one of` where `listed` is left out.
        listed: words in front of the valid names; left out = those follow `is_not`.
        advice: where to set the name, or to add one.
        most: names that are listed; 0 = none, where they are too many or stand in `listed`.
    """

    is_not: str
    listed: str
    advice: str
    most: int


class UnknownNameError(ValueError):
    """A name is not one of those that are valid: `x 'a' is not one of b, c (did you mean 'b'?)`.

    Validators of pydantic raise it; elsewhere `ConfigError.unknown` and its like make an error of
    the package of it.

    Args:
        what: words in front of the name.
        name: name that was given.
        known: valid names.
        text: further parts of the text.
    """

    def __init__(
        self, what: str, name: object, known: Iterable[object], **text: Unpack[UnknownNameText]
    ) -> None:
        names = [str(one) for one in known]
        listed, most = text.get('listed', ''), text.get('most', len(names) or 1)
        valid = f' {", ".join(islice(names, most)) or "none"}' if most else ''
        valid += ', ...' if 0 < most < len(names) else ''
        hint = nearest(str(name), names)
        given = f"'{name}'" if isinstance(name, str) else repr(name)
        is_not = text.get('is_not', '' if listed or not most else ' is not one of')
        parts = [f'{what} {given}'.lstrip(), is_not]
        parts += [hint, listed, valid] if listed else [valid, hint]
        super().__init__(''.join([*parts, text.get('advice', '')]))


class MtvWorldError(Exception):
    """Base of every error a user can cause; its text is meant to be read by that user.

    Parts of it come from files, messages and servers: control characters except line ends are
    shown as escapes, and what is longer than `MOST_OF_ERROR` is cut.
    """

    @classmethod
    def unknown(
        cls, what: str, name: object, known: Iterable[object], **text: Unpack[UnknownNameText]
    ) -> Self:
        """Return the error on a name that is not known; the arguments are `UnknownNameError`'s."""
        return cls(str(UnknownNameError(what, name, known, **text)))

    def __str__(self) -> str:
        """Return the text as it may be shown."""
        return shown(super().__str__(), MOST_OF_ERROR, '\n\t')


class ConfigError(MtvWorldError):
    """A YAML file, parameter or command-line value is wrong."""


class MissingPackageError(ConfigError):
    """A package that an extra of this one installs is not there.

    Args:
        what: thing that needs it.
        packages: names of the modules.
        instead: what to do without them.
    """

    def __init__(self, what: str, *packages: str, instead: str = '') -> None:
        super().__init__(needs_text(what, *packages, instead=instead))


class RobotError(MtvWorldError):
    """A robot description cannot be used, or joints do not belong to it."""


class CalibrationError(MtvWorldError):
    """A camera's intrinsics or pose are missing, inconsistent or have changed."""


class TrajectoryError(MtvWorldError):
    """A joint trajectory is rejected."""


class PlanFault(StrEnum):
    """Reason why a plan is rejected, as counted in `/diagnostics` and `~/report`."""

    EMPTY = 'trajectory_empty'
    MALFORMED = 'trajectory_malformed'
    NOT_FINITE = 'trajectory_not_finite'
    TIMES = 'trajectory_times'
    STALE = 'trajectory_stale'
    TOO_LONG = 'trajectory_too_long'
    NAMES = 'joint_names'
    LIMITS = 'joint_limits'
    SPEEDS = 'joint_speeds'


class PlanError(TrajectoryError):
    """A plan is rejected.

    Attributes:
        fault: the reason as it is counted.
    """

    def __init__(self, fault: PlanFault, text: str) -> None:
        super().__init__(text)
        self.fault = fault


class ObservationError(MtvWorldError):
    """Images or joint states are missing, stale, out of sync or in an unsupported form."""


class EpisodeError(MtvWorldError):
    """A recorded episode cannot be read, or lacks something."""


class DamagedFrameError(EpisodeError):
    """A single recorded frame cannot be decoded; its neighbours may be."""


class CheckpointError(MtvWorldError):
    """A checkpoint folder is incomplete or is for another model."""


class ModelMemoryError(MtvWorldError):
    """The device ran out of memory; the rollout was dropped."""


class TrainingError(MtvWorldError):
    """Training cannot go on (no clips, loss not finite)."""


class TrainingInterrupted(TrainingError):
    """A signal ended a training after it had saved its state; the text says how to go on.

    Attributes:
        signum: number of the signal.
    """

    def __init__(self, text: str, signum: int) -> None:
        super().__init__(text)
        self.signum = signum


class SimulatorError(MtvWorldError):
    """The simulator cannot render or build a scene."""


class NoSceneError(SimulatorError):
    """No scene of those that were drawn gave the wanted episode."""


class PolicyError(MtvWorldError):
    """A policy cannot answer, or its answer cannot be used."""


class PolicyServerError(PolicyError):
    """A policy's server does not start, cannot be reached, is gone or does not answer in time."""


class DescriptionError(MtvWorldError):
    """Naming the objects of a scene failed, as opposed to a scene without objects.

    Attributes:
        status: `unreachable`, `timeout`, `rate_limited`, `server_error`, `rejected`, `refused`,
            `invalid` or `unlisted`.
    """

    def __init__(self, text: str, status: str = 'invalid') -> None:
        super().__init__(text)
        self.status = status


class RolloutPreempted(MtvWorldError):
    """A newer trajectory arrived; the running rollout was given up."""


class CannotTell(Exception):
    """A quantity of a situation is unknown; the estimator abstains with this reason."""


def masked(text: str, key: str) -> str:
    """Return a server's text as it may be shown, with an API key masked, which it may quote."""
    return shown(text.replace(key, '***') if key else text)


def nearest(name: str, known: Iterable[str]) -> str:
    """Return ` (did you mean 'x'?)` for the known name nearest to `name`, else an empty text."""
    close = get_close_matches(name, list(known), n=1)
    return f" (did you mean '{close[0]}'?)" if close else ''
