"""Scripts of docs/ that write pages, as modules."""

from __future__ import annotations

import importlib.util
from pathlib import Path
import sys
from types import ModuleType

_DOCS = Path(__file__).resolve().parents[2] / 'docs'


def generator(name: str) -> ModuleType:
    """Return a module of docs/ that writes a page."""
    spec = importlib.util.spec_from_file_location(name, _DOCS / f'{name}.py')
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # type hints of its classes are looked up there
    spec.loader.exec_module(module)
    return module
