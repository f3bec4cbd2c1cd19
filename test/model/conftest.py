"""Both stems of the transformer, for tests that hold for either."""

from __future__ import annotations

import pytest


@pytest.fixture(params=['conv', 'patch'])
def kind(request) -> str:
    return request.param
