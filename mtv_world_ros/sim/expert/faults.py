"""What is wrong with a scripted policy, and the names that say so: `expert-noise-0.02`."""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import isfinite
import re

from mtv_world_ros.errors import nearest, PolicyError

EXPERT = 'expert'
#: largest size of each fault
_LARGEST = {
    'noise': 0.5,
    'miss': 1.0,
    'shift': 0.1,
    'place': 0.1,
    'wrong': 1.0,
    'late': 3.0,
    'stop': 1.0,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyVariant:
    """The expert's faults; all at their defaults is the expert.

    Attributes:
        noise: standard deviation of a slow error of every arm joint [rad].
        miss: probability that an episode's plan has one grasp that closes beside its object.
        shift: standard deviation, in x and in y, of where objects to be grasped are thought to
            be [m]; small ones are taken off centre, large ones missed.
        place: standard deviation, in x and in y, of where they are put down [m].
        wrong: probability that an episode's plan takes another object than the one named.
        late: the grippers follow this much later [s].
        stop: share of the plan after which the arms stand still; 0 = they never move.
    """

    noise: float = 0.0
    miss: float = 0.0
    shift: float = 0.0
    place: float = 0.0
    wrong: float = 0.0
    late: float = 0.0
    stop: float = 1.0

    def __post_init__(self) -> None:
        for fault, largest in _LARGEST.items():
            value = getattr(self, fault)
            if not (isfinite(value) and 0 <= value <= largest):
                raise PolicyError(
                    f"policy fault '{fault}' is {value}; it must be 0 to {largest:g}"
                )

    @property
    def name(self) -> str:
        """The name that `parse_variant` reads."""
        faults = [
            f'{item.name}-{getattr(self, item.name):g}'
            for item in fields(self)
            if getattr(self, item.name) != item.default
        ]
        return '-'.join([EXPERT, *faults])


def parse_variant(text: str) -> PolicyVariant:
    """Returns the variant of a name: `expert`, then any of its faults, each with its size.

    Raises:
        PolicyError: no such name, a fault twice or without a size, a size out of range.
    """
    name = text.strip()
    if not re.fullmatch(rf'{EXPERT}(-[a-z]+-\d*\.?\d+)*', name):
        raise PolicyError(
            f"'{text}' is no scripted policy{_near(name)}; they are called '{EXPERT}', followed "
            f"by faults with their sizes, like '{EXPERT}-noise-0.02' or "
            f"'{EXPERT}-late-0.3-miss-0.5'; faults are {', '.join(_LARGEST)}"
        )
    sizes: dict[str, float] = {}
    for fault, size in re.findall(r'-([a-z]+)-([\d.]+)', name):
        if fault not in _LARGEST:
            raise PolicyError(
                f"policy '{text}': unknown fault '{fault}'{nearest(fault, _LARGEST)}; known are "
                f'{", ".join(_LARGEST)}'
            )
        if fault in sizes:
            raise PolicyError(f"policy '{text}': fault '{fault}' is given twice")
        sizes[fault] = float(size)
    return PolicyVariant(**sizes)


def _near(name: str) -> str:
    """Of the first word alone: what follows may be right."""
    first = name.split('-')[0]
    return '' if first == EXPERT else nearest(first, [EXPERT])
