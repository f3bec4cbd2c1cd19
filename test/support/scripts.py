"""Scripts of `experiments/` as modules."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import importlib
from pathlib import Path
import sys
from types import ModuleType

import pytest

FOLDER = Path(__file__).resolve().parents[2] / 'experiments'


@contextmanager
def imported_scripts(*names: str) -> Iterator[list[ModuleType]]:
    """Yield scripts, which may import their neighbours; afterwards none is imported any more."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FOLDER))
        yield [importlib.import_module(name) for name in names]
    for file in FOLDER.glob('*.py'):
        sys.modules.pop(file.stem, None)
