# coal comes with Pinocchio, compiled and without stubs: everything of it is Any.
from typing import Any

def __getattr__(name: str) -> Any: ...
