"""Table of bad input in docs/mistakes.md: what was once an accident, and what is answered now.

    python -m robustness.bad_input_table

writes it anew from `ACCIDENTS`; `test_fuzz.py` compares each row with what is answered.
"""

from __future__ import annotations

from pathlib import Path
import re
import tempfile
import textwrap

from mtv_world_ros.core.errors import MtvWorldError
from robustness import fuzz
from robustness.accidents import ACCIDENTS
from robustness.file_kinds import Kind, KINDS

PAGE = Path(__file__).parents[1] / 'docs/mistakes.md'
BEGIN, END = '<!-- bad input: begin -->\n', '<!-- bad input: end -->\n'
HEAD = '| input | read as | answer | at most [s] |\n|---|---|---|---|\n'
#: characters of an answer in the table
MOST_SHOWN = 110
#: folders of absolute paths, and numbers of digits that no reader needs
_FOLDER = re.compile(r'(?<![\w.])/(?:[\w.+-]+/)+')
_LONG = re.compile(r'\d{20,}')


def answer(kind: Kind, data: object, folder: Path) -> str:
    """Return the error with which a case is refused, without places of this run; `read` if none.

    Raises:
        Exception: it is neither read nor refused with an error of the package.
    """
    fuzz.silence()
    try:
        kind.read(data, folder)
    except MtvWorldError as error:
        text = _LONG.sub('9...9', _FOLDER.sub('.../', ' '.join(str(error).split())))
        for mark, instead in (('|', '/'), ('`', "'"), ('<', '‹'), ('>', '›')):
            text = text.replace(mark, instead)
        return textwrap.shorten(text, MOST_SHOWN, placeholder=' ...')
    return 'read'


def row(name: str, text: str) -> str:
    """Return the line of an accident."""
    kind, _ = ACCIDENTS[name]
    name = _LONG.sub('9...9', name)
    return f'| {name} | {kind} | {text} | {KINDS[kind].most_s:g} |'


def written_rows() -> list[str]:
    """Return the rows of the page."""
    text = PAGE.read_text().partition(BEGIN)[2].partition(END)[0]
    return [line for line in text.splitlines() if line.startswith('|')][2:]


def main() -> None:
    """Write the table."""
    lines = []
    for name, (kind, make) in ACCIDENTS.items():
        with tempfile.TemporaryDirectory() as folder:
            fuzz.warm_up(KINDS[kind], KINDS[kind].samples(), Path(folder))
            lines.append(row(name, answer(KINDS[kind], make(), Path(folder))))
    before, _, rest = PAGE.read_text().partition(BEGIN)
    table = HEAD + '\n'.join(lines) + '\n'
    PAGE.write_text(f'{before}{BEGIN}\n{table}\n{END}{rest.partition(END)[2]}')


if __name__ == '__main__':
    main()
