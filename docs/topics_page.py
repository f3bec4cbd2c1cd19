"""Writes the reference of topics, services and actions: `python docs/topics_page.py`.

Both nodes are started with the bundled checkpoint, and names and types are those that ROS reports.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import os
from pathlib import Path
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.ros.policy.node import load_named_policy, PolicyNode
from mtv_world_ros.ros.world_model.loading import load_named_pipeline
from mtv_world_ros.ros.world_model.node import WorldModelNode

PAGE = Path(__file__).parent / 'topics.md'
_HEAD = """\
# Topics, services and actions

## What a client sends, in order

[`examples/ros_client.py`](../examples/ros_client.py) is such a client, in one screen. It needs rclpy and standard messages alone; the rates are those that the tests use.

| | topic | rate | what |
|---|---|---|---|
| 1 | `instruction`, `objects` | once, transient local | texts. A publisher that does not keep them must wait for the node's subscription: without an instruction there is no known task, and no verdict |
| 2 | `<camera>/image_raw`, `<camera>/camera_info` of each view | 5 Hz or more | rgb8 or another encoding of ROS, of any size from half the model's (bundled: 96x72) on; best with the pixels of the camera, since objects are found in them. Views of one moment have one stamp: the newest stamp that all views have is taken, else the nearest within `max_view_skew_s`. `frame_id` stays the same |
| 3 | `joint_states` | 10 Hz or more | all joints of the robot, by name, in one message or several; stamped by the same clock as the images |
| 4 | `joint_trajectory` | for each plan | points in joint space with `time_from_start`; stamp 0 = it begins when it arrives |

Poses of cameras come from TF where tf2_msgs is installed, else from the parameter `calibration_file`; without both they are those that the checkpoint was trained with, and `/diagnostics` (`cameras`) says how far the arm is from where they would show it.

A plan gives frames at the model's rate from the images' stamp on, up to its last point, rounded up: 3.2 s are 16 frames of 5 Hz, in chunks of the model's length. A plan that is stamped .1 s after the images ends .1 s later, and gives 17; one that is stamped .4 s before them gives 14.

The node says in its log and in `/diagnostics` what it waits for: at once, and every 5 s until the first plan. Of the plans that come while it loads it keeps the last one and answers it. A first plan waits up to a second for images, joint states and kept texts, and each plan for images of one moment. Each plan gets one end on `~/report`: `done` (with `success`, `success_reasons`), `rejected` (with `reason`, `text`), `preempted`, `failed` or `reset`; frames follow, and then `published`.

## Names

Names that begin with `~` are below the node's name, `/world_model` or `/policy`; the others are in
its namespace. `<view>` is a view of the checkpoint, `<camera>` the topic prefix of its camera: the
view's name, or the parameter `camera_topics.<view>`. With `compressed_input` images are taken from
`<camera>/image_raw/compressed` (sensor_msgs/CompressedImage). What the messages mean in detail,
and their quality of service, is on the page of [the node](node.md). This page is written by
`python docs/topics_page.py`.
"""  # noqa: E501
#: namespace of the nodes while names are read; the page leaves it out
_NAMESPACE = f'/topics_page_{os.getpid()}'
#: names that every ROS 2 node has
_EVERY_NODE = ('parameter', 'rosout', 'type_description', 'transition_event')
#: meaning by name; a name without one is an error
TOPICS = {
    '<camera>/image_raw': 'images of a camera',
    '<camera>/camera_info': 'intrinsics of a camera',
    'joint_states': 'measured joint positions, by name',
    'joint_trajectory': 'plan that is imagined: commanded joint positions',
    'instruction': 'text for the robot (transient local)',
    'objects': 'names of the objects, comma-separated; empty = none are known (transient local)',
    'robot_description': 'URDF, as `robot_state_publisher` publishes it (transient local)',
    '/tf': 'poses of moving frames, where tf2_msgs is installed',
    '/tf_static': 'poses of fixed frames, where tf2_msgs is installed; the node adds frames of '
    'views that TF lacks',
    '~/<view>/predicted/image_raw': 'predicted frames',
    '~/<view>/predicted/image_raw/compressed': 'predicted frames as JPEG',
    '~/<view>/predicted/camera_info': 'intrinsics at the size of the predicted frames',
    '~/<view>/trajectory/image_raw': 'trajectory video',
    '~/<view>/trajectory/camera_info': 'intrinsics at its size',
    '~/<view>/mask/image_raw': 'object masks',
    '~/<view>/mask/camera_info': 'intrinsics at their size',
    '~/predicted/joint_states': 'commanded positions at the predicted times; lets a policy close '
    'the loop on the imagination',
    '~/success': 'probability of success, NaN where the estimate abstains; reasons: `~/report`',
    '~/jaccard': '[J](glossary.md#frames), view x object; NaN where an object is absent',
    '~/fidelity': 'J of an imagined chunk against the real frames that arrived later for the same '
    'times, view x object; mode `observe` only',
    '~/report': 'one message per chunk, end of a rollout or episode, and rejection',
    '/diagnostics': 'health and state of the node, counts by reason, latencies',
    '/world_model/<view>/predicted/image_raw': 'predicted frames, which the policy sees',
    '/world_model/predicted/joint_states': 'joint positions at the predicted times',
    '/world_model/report': 'ends of rollouts',
}
SERVICES = {
    '~/reset': 'give up the running rollout; the next trajectory starts from the newest real '
    'frames. Reads `calibration_file` again',
    '~/imagine': 'true: mode `imagine`; false: mode `observe`',
    '~/start': 'begin an episode',
    '~/stop': 'end the episode',
    '~/change_state': 'configure, activate, deactivate, clean up, shut down ([lifecycle]'
    '(node.md#lifecycle))',
    '~/get_state': 'present state',
    '~/get_available_states': 'all states',
    '~/get_available_transitions': 'transitions of the present state',
    '~/get_transition_graph': 'all transitions',
}
#: rows of packages that only a native ROS 2 has
OPTIONAL_TOPICS = {
    ('in', '/tf'): 'tf2_msgs/TFMessage',
    ('in', '/tf_static'): 'tf2_msgs/TFMessage',
    ('out', '/tf_static'): 'tf2_msgs/TFMessage',
}
ACTION = (
    '| `~/follow_joint_trajectory` | control_msgs/FollowJointTrajectory | imagines a goal as a '
    'plan on `joint_trajectory`, where control_msgs is installed ([results](node.md#action)) |'
)


def page(
    load_model: Callable[..., Any] = load_named_pipeline,
    load_policy: Callable[..., Any] = load_named_policy,
) -> str:
    """Return the text of the page.

    Args:
        load_model: maker of the pipeline; a test has a faster one, with the same views.
        load_policy: maker of the policy.
    """
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    context = rclpy.Context()
    # ROS finds nodes by name: another '/world_model' in this domain must not answer
    remapped = ['--ros-args', '-r', f'__ns:={_NAMESPACE}']
    options = SignalHandlerOptions.NO
    rclpy.init(args=remapped, context=context, signal_handler_options=options)
    world_model = WorldModelNode(load_model, context)
    policy = PolicyNode(load_policy, context)
    views = Checkpoint.open('bundled').card.views
    lines = [_HEAD]
    try:
        world_model.start()
        for node in (world_model, policy):
            lines += [f'## {node.get_name()}', '', *_described(node, views), '']
    finally:
        world_model.close()
        policy.close()
        rclpy.shutdown(context=context)
    return '\n'.join(lines)


def _described(node: Node, views: tuple[str, ...]) -> Iterator[str]:
    is_world_model = isinstance(node, WorldModelNode)
    own = node.get_name(), node.get_namespace()
    found = {
        ('in', name): kind
        for name, kind in _named(node.get_subscriber_names_and_types_by_node(*own), node, views)
    } | {
        ('out', name): kind
        for name, kind in _named(node.get_publisher_names_and_types_by_node(*own), node, views)
    }
    if is_world_model:
        found |= OPTIONAL_TOPICS
    order = list(TOPICS)
    for heading, way in (('subscribed topic', 'in'), ('published topic', 'out')):
        yield from (f'| {heading} | type | |', '|---|---|---|')
        for name in sorted((n for w, n in found if w == way), key=order.index):
            yield f'| `{name}` | {found[way, name]} | {TOPICS[name]} |'
        yield ''
    yield from ('| service | type | |', '|---|---|---|')
    services = dict(_named(node.get_service_names_and_types_by_node(*own), node, views))
    for name in sorted(services, key=list(SERVICES).index):
        yield f'| `{name}` | {services[name]} | {SERVICES[name]} |'
    if is_world_model:
        yield from ('', '| action | type | |', '|---|---|---|', ACTION)


def _named(
    entries: list[tuple[str, list[str]]], node: Node, views: tuple[str, ...]
) -> Iterator[tuple[str, str]]:
    """Yield names and types as the page has them, without those that every node has."""
    for name, kinds in entries:
        if any(word in name for word in _EVERY_NODE) or '/_action/' in name:
            continue
        name = name.removeprefix(_NAMESPACE)
        for view in views:
            name = name.replace(f'/{view}/', '/<view>/')
        name = name.replace(f'/{node.get_name()}/', '~/')
        if name.startswith('/<view>/'):
            name = name.replace('/<view>/', '<camera>/')
        if f'{name[1:]}' in TOPICS and name not in TOPICS:
            name = name[1:]
        package, _, kind = kinds[0].split('/')
        yield name, f'{package}/{kind}'


if __name__ == '__main__':
    PAGE.write_text(page(), encoding='utf-8')
