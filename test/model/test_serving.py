"""What makes serving faster or smaller: its settings, and that it predicts the same."""

from __future__ import annotations

import pytest

from mtv_world_ros.errors import ConfigError
from mtv_world_ros.model.serving import ServingOptions


def test_settings_are_read_from_a_text() -> None:
    assert ServingOptions.parse('') == ServingOptions()
    options = ServingOptions.parse(' fuse_lora=true  context_parallel=2 ')
    assert options == ServingOptions(fuse_lora=True, context_parallel=2)


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('fuse_lorra=true', r"'fuse_lorra' is not one of .*did you mean 'fuse_lora'"),
        ('fuse_lora=yes', r"fuse_lora is 'yes'; it must be true or false"),
        ('context_parallel', r"context_parallel is ''; it must be a whole number"),
        ('context_parallel=0', 'context_parallel is 0; it must be 1 or more'),
        ('context_parallel=2 fuse_lora=false', 'context_parallel needs fuse_lora=true'),
    ],
)
def test_wrong_settings_are_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ServingOptions.parse(text)
