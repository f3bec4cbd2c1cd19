"""Brings `test/surface.json` to today's surface: `python test/record_surface.py`.

Rows of what is gone are removed. What is new gets a row with an empty sentence, which a test
refuses: write who sets it, and name a file of the repository that does.
"""

from __future__ import annotations

import json
from pathlib import Path
import sys

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from test.support.surface import FILE, live, written


def main() -> int:
    """Write the file; print the rows that were removed and those that need a sentence."""
    before = written()
    after = {
        kind: {name: before.get(kind, {}).get(name, '') for name in names}
        for kind, names in live().items()
    }
    FILE.write_text(json.dumps(after, indent=1, ensure_ascii=False) + '\n', encoding='utf-8')
    for kind, rows in before.items():
        print(*(f'removed: {kind}: {name}\n' for name in rows if name not in after[kind]), end='')
    for kind, rows in after.items():
        print(*(f'{kind}: {name}\n' for name, who in rows.items() if not who), sep='', end='')
    count = {kind: len(rows) for kind, rows in after.items()}
    print(', '.join(f'{number} {kind}' for kind, number in count.items()))
    return 0


if __name__ == '__main__':
    sys.exit(main())
