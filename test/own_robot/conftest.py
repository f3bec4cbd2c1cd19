"""The robot that `config/` knows nothing of, for the tests of its recordings."""

import pytest

from test.support.crane import load


@pytest.fixture(scope='module')
def robot(tmp_path_factory):
    return load(tmp_path_factory.mktemp('robot'))
