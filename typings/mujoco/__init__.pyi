"""MuJoCo's names come from a compiled module, where pyright does not look."""

from typing import Any

def __getattr__(name: str) -> Any: ...
