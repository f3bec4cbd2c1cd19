"""The fault catalogue: what can be wrong with a scripted policy, by name, and policies by theirs.

A policy's name says its faults and their sizes: `expert-joint_noise-0.02`,
`expert-grasp_height-0.03-gripper_delay-0.3`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
import re

import numpy as np

from mtv_world_ros.core.errors import nearest, PolicyError
from mtv_world_ros.simulation.faults.drawn import drawn_kind, drawn_names, DRAWN_SETS, is_drawn
from mtv_world_ros.simulation.faults.fault import FaultKind
from mtv_world_ros.simulation.faults.kinds import (
    collision,
    height,
    joints,
    lateral,
    objects,
    opening,
    regrasp,
    release,
    speed,
    timing,
    wrist,
)

EXPERT = 'expert'
#: of fault kinds; kinds of `test` never enter training, calibration or the choice of anything
SPLITS = ('train', 'calibrate', 'test')
#: in the order of the catalogue, which random policies depend on
_FAMILIES = (
    *(timing, height, lateral, wrist, opening, release, collision, objects, speed, joints),
    regrasp,
)


class _Catalogue(dict[str, FaultKind]):
    """Kinds by name; drawn ones are made when they are asked for."""

    def __missing__(self, name: str) -> FaultKind:
        if not is_drawn(name):
            raise KeyError(name)
        return drawn_kind(name)


#: kinds by name
FAULTS: Mapping[str, FaultKind] = _Catalogue(
    {name: kind for module in _FAMILIES for name, kind in module.fault.kinds.items()}
)
_NAMES = {name: kind for kind, fault in FAULTS.items() for name in (kind, fault.alias) if name}
_ALL = f"the {len(FAULTS)} kinds that 'mtv-world rank --list-faults' prints"


def kind_named(name: str) -> str:
    """Return the kind of a name or an alias.

    Raises:
        PolicyError: no such kind; the text names the nearest known one.
    """
    if is_drawn(name):
        return name
    if name not in _NAMES:
        raise PolicyError.unknown(
            'unknown fault kind',
            name,
            _NAMES,
            listed=f'; known are the splits {", ".join(SPLITS)} and {_ALL}',
            most=0,
        )
    return _NAMES[name]


def kinds_named(text: str) -> tuple[str, ...]:
    """Return the fault kinds of a split, or of a comma-separated list, as they are called there.

    Raises:
        PolicyError: no such split or kind; the text names the nearest known one.
    """
    names = tuple(name.strip() for name in text.split(',') if name.strip())
    if not names or names[0] in SPLITS or ':' in text:
        return kinds_of(text.strip())
    for name in names:
        kind_named(name)
    return names


def kinds_of(split: str) -> tuple[str, ...]:
    """Return the fault kinds of a split, of `drawn:SEED` or of `drawn_contact:SEED`.

    Raises:
        PolicyError: no such split.
    """
    word, _, seed = split.partition(':')
    if word in DRAWN_SETS and seed.isdecimal() and len(seed) < 10:
        return drawn_names(int(seed), word)
    if split not in SPLITS:
        raise PolicyError.unknown(
            'unknown split of fault kinds',
            split,
            SPLITS,
            listed='; known are',
            advice=''.join(f', {drawn}:SEED' for drawn in DRAWN_SETS),
        )
    return tuple(name for name, kind in FAULTS.items() if kind.split == split)


@dataclass(frozen=True, slots=True)
class PolicyVariant:
    """The expert's faults; none is the expert.

    Attributes:
        sizes: (name or alias of a kind, size), each kind once, in the catalogue's order.
    """

    sizes: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        for name, value in self.sizes:
            largest = FAULTS[kind_named(name)].size.largest
            if not (isfinite(value) and 0 <= value <= largest):
                raise PolicyError(f"policy fault '{name}' is {value}; it must be 0 to {largest:g}")

    @classmethod
    def of(cls, sizes: Mapping[str, float]) -> PolicyVariant:
        """Return the variant of sizes by kind; kinds whose size means no fault are left out."""
        names = in_order(sizes)
        given = ((name, float(sizes[name])) for name in names)
        return cls(tuple((n, s) for n, s in given if s != FAULTS[kind_named(n)].size.none))

    def size(self, kind: str) -> float:
        """Return the size of one fault."""
        return dict(self.faults).get(kind_named(kind), FAULTS[kind_named(kind)].size.none)

    @property
    def faults(self) -> tuple[tuple[str, float], ...]:
        """(kind, size) of its faults."""
        return tuple((kind_named(name), size) for name, size in self.sizes)

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of its faults."""
        return tuple(kind for kind, _ in self.faults)

    @property
    def splits(self) -> tuple[str, ...]:
        """The splits of its faults."""
        return tuple(sorted({FAULTS[kind].split for kind in self.kinds}))

    @property
    def name(self) -> str:
        """The name that `parse_variant` reads, with the names that it was given."""
        return '-'.join([EXPERT, *(f'{name}-{size:g}' for name, size in self.sizes)])


def in_order(names: Iterable[str]) -> list[str]:
    """Return names of kinds in the order of the catalogue; drawn kinds follow."""
    order = {kind: number for number, kind in enumerate(FAULTS)}
    return sorted(names, key=lambda name: (order.get(kind_named(name), len(order)), name))


def parse_variant(text: str) -> PolicyVariant:
    """Return the variant of a name: `expert`, then any of its faults, each with its size.

    Raises:
        PolicyError: no such name, a fault twice or without a size, a size out of range.
    """
    name = text.strip()
    if not re.fullmatch(rf'{EXPERT}(-[a-z][a-z_0-9]*-\d*\.?\d+)*', name):
        raise PolicyError(
            f"'{text}' is no scripted policy{_near(name)}; they are called '{EXPERT}', followed "
            f"by faults with their sizes, like '{EXPERT}-joint_noise-0.02' or "
            f"'{EXPERT}-gripper_delay-0.3-grasp_missed-0.5'; {_ALL}"
        )
    sizes: dict[str, float] = {}
    for fault, size in re.findall(r'-([a-z][a-z_0-9]*)-([\d.]+)', name):
        if fault not in _NAMES and not is_drawn(fault):
            raise PolicyError.unknown(
                f"policy '{text}': unknown fault",
                fault,
                _NAMES,
                listed=f'; known are {_ALL}',
                most=0,
            )
        if kind_named(fault) in map(kind_named, sizes):
            raise PolicyError(f"policy '{text}': fault '{fault}' is given twice")
        sizes[fault] = float(size)
    PolicyVariant(tuple(sizes.items()))  # sizes that mean no fault are checked, too
    return PolicyVariant.of(sizes)


def draw_variant(kinds: Sequence[str], rng: np.random.Generator) -> PolicyVariant:
    """Return a random policy: the expert, or one or two faults of sizes around the typical one.

    Args:
        kinds: fault kinds to choose from.
        rng: generator that draws.
    """
    count = int(rng.choice([0, 1, 2], p=[0.12, 0.5, 0.38]))
    chosen = rng.choice(kinds, size=min(count, len(kinds)), replace=False)
    sizes = {}
    for kind in map(str, chosen):
        allowed = FAULTS[kind_named(kind)].size
        size = min(allowed.typical * 2 ** rng.normal(0.0, 0.9), allowed.largest)
        sizes[kind] = float(f'{size:.3g}')
    return PolicyVariant.of(sizes)


def policies_of(split: str) -> tuple[str, ...]:
    """Return the policies of a ranking: the expert, and kinds of a split in their sizes.

    Raises:
        PolicyError: no such split.
    """
    faults = ((kind, size) for kind in kinds_of(split) for size in FAULTS[kind].size.ranked)
    return (EXPERT, *(PolicyVariant.of({kind: size}).name for kind, size in faults))


def refuse_test_kinds(names: Iterable[str], what: str) -> None:
    """Refuse policies with faults of the split `test`.

    Args:
        names: names of policies.
        what: purpose that they are refused for, e.g. `training`.

    Raises:
        PolicyError: names the policies and their kinds.
    """
    test, *others = SPLITS[::-1]
    found = {
        name: bad
        for name in names
        if (bad := [k for k in parse_variant(name).kinds if FAULTS[k].split == test])
    }
    if found:
        listed = '; '.join(f"'{name}' has {', '.join(kinds)}" for name, kinds in found.items())
        raise PolicyError(
            f'fault kinds of the split {test} are not for {what}: {listed}; choose kinds of '
            f'{", ".join(others[::-1])}, which mtv-world rank --list-faults prints'
        )


def _near(name: str) -> str:
    """Return a hint on the first word of a name alone, because the other words may be right."""
    first = name.split('-')[0]
    return '' if first == EXPERT else nearest(first, [EXPERT])
