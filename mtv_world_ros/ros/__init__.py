"""The ROS 2 shell: the only part that imports rclpy and messages."""

import sys

from mtv_world_ros.core.processes import end_on_signals, prepare_process

if sys.argv[:1] == ['-m']:  # `python -m` is about to run a node, whose imports take seconds
    end_on_signals('mtv_world_ros')
    prepare_process()


def run_world_model() -> int:
    """Run the node `world_model`."""
    end_on_signals('world_model')
    prepare_process()
    from mtv_world_ros.ros.world_model.node import main

    return main()


def run_policy() -> int:
    """Run the command `policy_node`; return its exit status."""
    end_on_signals('policy_node')
    prepare_process()
    from mtv_world_ros.ros.policy.node import main

    return main()
