"""Findings and verdicts of an inspection, and its report as Markdown and text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mtv_world_ros.core.shown_text import markdown_cell

#: file of a folder's report: what is broken, by episode and view
BROKEN = 'broken.json'
#: from best to worst
NOT_CHECKED = 'not checked'
VERDICTS = ('ok', NOT_CHECKED, 'suspicious', 'broken')
#: exit status of the command by verdict; 2 is argparse's
EXIT_STATUS = {'ok': 0, NOT_CHECKED: 3, 'suspicious': 1, 'broken': 1}
#: numbers of a view: head and format of their column in tables
NUMBERS = {
    'residual_px': ('residual [px]', '{:.1f}'),
    'match': ('match', '{:.2f}'),
    'delay_s': ('delay [s]', '{:+.1f}'),
}
#: file with the numbers and findings of every view
CHECKED = 'check.json'
_ADVICE = {
    'ok': 'Every camera was checked, and nothing wrong was found.',
    NOT_CHECKED: 'Nothing wrong was found, but not everything could be checked.',
    'suspicious': 'Look at the overlay pictures before you rely on this recording.',
    'broken': 'Predictions from this recording would be wrong.',
}
_LEGEND = (
    'Pictures: a cross at each tool point and the trail of the last 2 s in the colour of the arm, '
    'and white the outline of the robot as it is drawn.'
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """A verdict worse than `ok`, and why in a sentence.

    Attributes:
        verdict: one of `VERDICTS`.
        text: why.
        of_a_part: it is of a part of the view, e.g. one of two arms: it is named, and the view
            keeps the verdict of the rest.
    """

    verdict: str
    text: str
    of_a_part: bool = False


def not_checked(text: str) -> Finding:
    """Return a check that could not be made, and why."""
    return Finding(verdict=NOT_CHECKED, text=text)


def part_not_checked(text: str) -> Finding:
    """Return the finding that a part of a view was not checked."""
    return Finding(verdict=NOT_CHECKED, text=text, of_a_part=True)


def suspicious(text: str) -> Finding:
    """Return a finding that may be harmless."""
    return Finding(verdict='suspicious', text=text)


def broken(text: str) -> Finding:
    """Return a finding that makes the view or the recording useless."""
    return Finding(verdict='broken', text=text)


def worst_verdict(verdicts: Sequence[str]) -> str:
    """Return the worst of some verdicts; `ok` if there is none."""
    return max(verdicts, key=VERDICTS.index, default='ok')


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """Findings on one view, or on joints, commands and clocks of all views.

    Attributes:
        name: name of the view, or `recording`.
        measures: measured values as text, by name.
        numbers: values of `NUMBERS` that were measured.
        findings: faults, and checks that were not possible with the reason.
        notes: other things to know.
    """

    name: str
    measures: Mapping[str, str] = field(default_factory=dict)
    numbers: Mapping[str, float] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """Worst verdict of the findings that concern the whole section."""
        return worst_verdict([f.verdict for f in self.findings if not f.of_a_part])

    @property
    def wrong(self) -> list[str]:
        """Texts of the faults."""
        return [finding.text for finding in self.findings if finding.verdict != NOT_CHECKED]

    @property
    def unchecked(self) -> list[str]:
        """Texts of the checks that could not be made."""
        return [finding.text for finding in self.findings if finding.verdict == NOT_CHECKED]

    def cells(self) -> list[str]:
        """Return the numbers as cells of a table, in the order of `NUMBERS`; `-` = not known."""
        return [
            form.format(self.numbers[key]) if key in self.numbers else '-'
            for key, (_, form) in NUMBERS.items()
        ]

    def as_json(self) -> dict[str, Any]:
        """Return the entry of `check.json`; faults and impossible checks are separate lists."""
        return {
            'verdict': self.verdict,
            **{key: self.numbers.get(key) for key in NUMBERS},
            'wrong': self.wrong,
            'not_checked': self.unchecked,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Inspection:
    """The inspection of a whole recording.

    Attributes:
        episode: path of the episode.
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
        """Sections of the views, then that of the recording."""
        return (*self.views, self.recording)

    @property
    def verdict(self) -> str:
        """The worst of all sections."""
        return worst_verdict([section.verdict for section in self.sections])


def to_markdown(inspection: Inspection, pictures: Mapping[str, str]) -> str:
    """Return the report; `pictures` has the file of each view's overlay picture."""
    findings = [finding for section in inspection.sections for finding in section.findings]
    parts = dict.fromkeys(finding.text for finding in findings if finding.of_a_part)
    lines = [
        f'# {inspection.verdict}: {inspection.episode.name}',
        '',
        f'`{inspection.episode}`, robot `{inspection.robot}`. {_ADVICE[inspection.verdict]}',
        '',
        *(f'- {markdown_cell(text)}' for text in parts),
        *([''] if parts else []),
        f'| | verdict | {" | ".join(name for name, _ in NUMBERS.values())} | reason |',
        f'|---|---|{"---|" * len(NUMBERS)}---|',
    ]
    lines += [
        f'| {markdown_cell(s.name)} | {s.verdict} | {" | ".join(s.cells())} | {_reasons(s)} |'
        for s in inspection.sections
    ]
    for section in inspection.sections:
        lines += ['', f'## {section.name}', '']
        if section.name in pictures:
            lines += [f'![{section.name}]({pictures[section.name]})', '']
        lines += [
            f'- {finding.verdict}: {markdown_cell(finding.text)}' for finding in section.findings
        ]
        lines += [f'- note: {note}' for note in section.notes]
        lines += ['', '| measured | |', '|---|---|']
        lines += [f'| {name} | {value} |' for name, value in section.measures.items()]
    lines += ['', _LEGEND, '']
    return '\n'.join(lines)


def to_text(inspection: Inspection) -> str:
    """Return a table, a row a view with its numbers, and a line for each finding and note."""
    head = ['view', 'verdict', *(name for name, _ in NUMBERS.values())]
    rows = [[s.name, s.verdict, *s.cells()] for s in inspection.sections]
    lines = aligned_rows([head, *rows])
    for section in inspection.sections:
        lines += [f'{section.name}: {f.verdict}: {f.text}' for f in section.findings]
        lines += [f'{section.name}: note: {note}' for note in section.notes]
    return '\n'.join(lines)


def to_json(
    inspections: Mapping[str, Inspection], failed: Mapping[str, str] = {}
) -> dict[str, Any]:
    """Return the content of `check.json`: verdicts, numbers, faults, skipped checks.

    Args:
        inspections: inspection of each episode, by name.
        failed: reasons why episodes could not be inspected, by name.
    """
    episodes: dict[str, Any] = {}
    for name, inspection in inspections.items():
        episodes[name] = {
            'verdict': inspection.verdict,
            'views': {section.name: section.as_json() for section in inspection.views},
            'recording': inspection.recording.as_json(),
        }
    for name, why in failed.items():
        episodes[name] = {'verdict': 'broken', 'views': {}, 'recording': {'wrong': [why]}}
    return episodes


def aligned_rows(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the rows of a table as lines; the last column is not filled up."""
    widths = [max(len(row[n]) for row in rows) for n in range(len(rows[0]) - 1)]
    lines = [
        '  '.join(
            [*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[-1]]
        )
        for row in rows
    ]
    return [line.rstrip() for line in lines]


def _reasons(section: Section) -> str:
    return markdown_cell('; '.join(finding.text for finding in section.findings)) or '–'
