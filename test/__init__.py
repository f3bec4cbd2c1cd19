"""Tests of the package; helpers that tests share are in `test.support`."""

from mtv_world_ros.core.processes import let_threads_sleep

let_threads_sleep()  # as commands and nodes do, before torch is loaded
