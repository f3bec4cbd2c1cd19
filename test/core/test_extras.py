"""What is optional says which extra installs it."""

import sys

import pytest

from mtv_world_ros.core import ray_actors
from mtv_world_ros.core.errors import ConfigError, MissingPackageError
from mtv_world_ros.core.extras import extra_of, install_command, needs_text
from mtv_world_ros.importing.parquet_tables import pyarrow_modules
from mtv_world_ros.model.tensor_files import import_transformers
from mtv_world_ros.viewing.rerun_log import check_installed


@pytest.mark.parametrize(
    ('needs', 'package'),
    [
        (pyarrow_modules, 'pyarrow'),
        (check_installed, 'rerun'),
        (ray_actors._ray, 'ray'),
        (import_transformers, 'transformers'),
    ],
)
def test_a_missing_package_is_named_with_what_installs_it(monkeypatch, needs, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingPackageError) as error:
        needs()
    assert isinstance(error.value, ConfigError)
    assert f' needs {package}: pip install ' in str(error.value)
    assert f"'mtv_world_ros[{extra_of(package)}]'" in str(error.value)


def test_packages_of_several_extras_are_one_command():
    assert install_command(['h5py', 'matplotlib', 'pyarrow']) == (
        "pip install 'mtv_world_ros[import,evaluate]'"
    )
    assert install_command(['nowhere']) == 'pip install nowhere'
    assert needs_text('it', 'a', 'b', instead='go') == 'it needs a and b: pip install a b, or go'
