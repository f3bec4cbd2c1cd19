"""Tests of the package; helpers that tests share are in `test.support`."""

from mtv_world_ros.core.processes import prepare_process

prepare_process()  # as commands and nodes do, before torch is loaded
