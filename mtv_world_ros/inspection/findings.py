"""What an inspection found: findings, verdicts, and the report of a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

#: from best to worst
VERDICTS = ('ok', 'suspicious', 'broken')


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Something wrong: a verdict worse than `ok`, and why in a sentence."""

    verdict: str
    text: str


def suspicious(text: str) -> Finding:
    """A finding that may be harmless."""
    return Finding(verdict='suspicious', text=text)


def broken(text: str) -> Finding:
    """A finding that makes the view or the recording useless."""
    return Finding(verdict='broken', text=text)


def worst(verdicts: Sequence[str]) -> str:
    """The worst of some verdicts; `ok` if there is none."""
    return max(verdicts, key=VERDICTS.index, default='ok')


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """One view, or what concerns all views (joints, commands, clocks).

    Attributes:
        name: of the view, or `recording`.
        measures: what was measured, as text, by name.
        findings: what is wrong.
        notes: what could not be checked and why, and other things to know.
    """

    name: str
    measures: Mapping[str, str] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """The worst of the findings."""
        return worst([finding.verdict for finding in self.findings])


@dataclass(frozen=True, slots=True, kw_only=True)
class Inspection:
    """All of a recording.

    Attributes:
        episode: its path.
        robot: name of the robot it was checked against.
        views: a section for each view.
        recording: what concerns all views.
    """

    episode: Path
    robot: str
    views: tuple[Section, ...]
    recording: Section

    @property
    def verdict(self) -> str:
        """The worst of all sections."""
        return worst([section.verdict for section in (*self.views, self.recording)])
