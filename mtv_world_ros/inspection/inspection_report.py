"""Findings and verdicts of an inspection, and its report as Markdown and text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

#: file of a folder's report: what is broken, by episode and view
BROKEN = 'broken.json'
#: from best to worst
VERDICTS = ('ok', 'not checked', 'suspicious', 'broken')
_ADVICE = {
    'ok': 'Everything was checked, and nothing wrong was found.',
    'not checked': 'Nothing wrong was found, but not everything could be checked.',
    'suspicious': 'Look at the overlay pictures before you rely on this recording.',
    'broken': 'Predictions from this recording would be wrong.',
}
_LEGEND = (
    'Pictures: a cross at each tool point and the trail of the last 2 s in the colour of the arm, '
    'and white the outline of the robot as it is drawn.'
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """A verdict worse than `ok`, and why in a sentence."""

    verdict: str
    text: str


def not_checked(text: str) -> Finding:
    """Return a check that could not be made, and why."""
    return Finding(verdict='not checked', text=text)


def suspicious(text: str) -> Finding:
    """Return a finding that may be harmless."""
    return Finding(verdict='suspicious', text=text)


def broken(text: str) -> Finding:
    """Return a finding that makes the view or the recording useless."""
    return Finding(verdict='broken', text=text)


def worst(verdicts: Sequence[str]) -> str:
    """Return the worst of some verdicts; `ok` if there is none."""
    return max(verdicts, key=VERDICTS.index, default='ok')


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """One view, or what concerns all views (joints, commands, clocks).

    Attributes:
        name: of the view, or `recording`.
        measures: measured values as text, by name.
        findings: faults, and checks that were not possible with the reason.
        notes: other things to know.
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
    """The inspection of a whole recording.

    Attributes:
        episode: its path.
        robot: name of the robot it was checked against.
        views: a section for each view.
        recording: findings that concern all views.
    """

    episode: Path
    robot: str
    views: tuple[Section, ...]
    recording: Section

    @property
    def sections(self) -> tuple[Section, ...]:
        """Those of the views, then the recording's."""
        return (*self.views, self.recording)

    @property
    def verdict(self) -> str:
        """The worst of all sections."""
        return worst([section.verdict for section in self.sections])


def to_markdown(inspection: Inspection, pictures: Mapping[str, str]) -> str:
    """Return the report; `pictures` has the file of each view's overlay picture."""
    lines = [
        f'# {inspection.verdict}: {inspection.episode.name}',
        '',
        f'`{inspection.episode}`, robot `{inspection.robot}`. {_ADVICE[inspection.verdict]}',
        '',
        '| | verdict | reason |',
        '|---|---|---|',
    ]
    lines += [f'| {s.name} | {s.verdict} | {_reasons(s)} |' for s in inspection.sections]
    for section in inspection.sections:
        lines += ['', f'## {section.name}', '']
        if section.name in pictures:
            lines += [f'![{section.name}]({pictures[section.name]})', '']
        lines += [f'- {finding.verdict}: {finding.text}' for finding in section.findings]
        lines += [f'- note: {note}' for note in section.notes]
        lines += ['', '| measured | |', '|---|---|']
        lines += [f'| {name} | {value} |' for name, value in section.measures.items()]
    lines += ['', _LEGEND, '']
    return '\n'.join(lines)


def to_text(inspection: Inspection) -> str:
    """Return a line for each section, and one for each finding."""
    lines = []
    for section in inspection.sections:
        residual = section.measures.get('residual')
        lines.append(f'{section.name}: {section.verdict}' + (f' ({residual})' if residual else ''))
        lines += [f'  {finding.verdict}: {finding.text}' for finding in section.findings]
        lines += [f'  note: {note}' for note in section.notes]
    return '\n'.join(lines)


def _reasons(section: Section) -> str:
    return '; '.join(finding.text for finding in section.findings).replace('|', '/') or '–'
