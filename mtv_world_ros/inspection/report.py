"""The inspection as Markdown."""

from __future__ import annotations

from collections.abc import Mapping

from mtv_world_ros.inspection.findings import Inspection, Section

_ADVICE = {
    'ok': 'Nothing wrong was found.',
    'suspicious': 'Look at the overlay pictures before you rely on this recording.',
    'broken': 'Predictions from this recording would be wrong.',
}
_LEGEND = (
    'Pictures: a cross at each tool point and the trail of the last 2 s in the colour of the arm, '
    'and white the outline of the robot as it is drawn.'
)


def to_markdown(inspection: Inspection, pictures: Mapping[str, str]) -> str:
    """Returns the report; `pictures` has the file of each view's overlay picture."""
    lines = [
        f'# {inspection.verdict}: {inspection.episode.name}',
        '',
        f'`{inspection.episode}`, robot `{inspection.robot}`. {_ADVICE[inspection.verdict]}',
        '',
        '| | verdict | reason |',
        '|---|---|---|',
    ]
    sections = (*inspection.views, inspection.recording)
    lines += [f'| {s.name} | {s.verdict} | {_reasons(s)} |' for s in sections]
    for section in sections:
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
    """Returns a line for each section, and one for each finding."""
    lines = []
    for section in (*inspection.views, inspection.recording):
        residual = section.measures.get('residual')
        lines.append(f'{section.name}: {section.verdict}' + (f' ({residual})' if residual else ''))
        lines += [f'  {finding.verdict}: {finding.text}' for finding in section.findings]
        lines += [f'  note: {note}' for note in section.notes]
    return '\n'.join(lines)


def _reasons(section: Section) -> str:
    return '; '.join(finding.text for finding in section.findings).replace('|', '/') or '–'
