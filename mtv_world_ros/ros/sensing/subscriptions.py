"""Subscriptions of the nodes, with the quality of service that the publishers offer."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial, wraps
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from mtv_world_ros.cameras.camera_info import is_rectified
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.ros import parameters
from mtv_world_ros.ros.messages.bounded import bounded, decode
from mtv_world_ros.ros.messages.conversions import MIN_STAMPED_BYTES, NANO, read_stamp
from mtv_world_ros.ros.messages.rejection import Rejection
from mtv_world_ros.ros.node_events import NodeEvents
from mtv_world_ros.ros.qos_profiles import QosWatch
from mtv_world_ros.ros.receive_paths import PATHS, SERVICES
from mtv_world_ros.ros.sensing.observations import ObservationBuffer

Handler = Callable[[Any], None]
_RELIABILITIES = ('match', 'reliable', 'best_effort')
#: what every publisher can serve
_LOWEST = (ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE)
#: plans that wait while the node is busy: one that is dropped would get no end
PLANS_KEPT = 1000
#: small, urgent topics that have ports of their own; joint states may come at 1 kHz
OWN_PATHS = (('joint_trajectory', 'instruction', 'objects', SERVICES), ('joint_states',))
_HIGHEST = (ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)


class Inputs:
    """Subscriptions to the cameras, joint states, instruction, object names and trajectories.

    Args:
        node: owner of the subscriptions.
        views: names of the views; parameters give each its camera topic.
        compressed: whether images come as JPEG or PNG.
        states: topics of joint states.
        buffer: buffer of images, camera infos and joint states.
        events: takes instructions, names of objects and plans.

    Raises:
        ConfigError: a QoS override is invalid, or a port was taken by another program.
    """

    def __init__(
        self,
        node: Node,
        views: Sequence[str],
        *,
        compressed: bool,
        states: Sequence[str],
        buffer: ObservationBuffer,
        events: NodeEvents,
    ) -> None:
        self._observations = subscribe_observations(
            node,
            parameters.declare_camera_topics(node, views),
            compressed=views if compressed else (),
            states=states,
            buffer=buffer,
            guarded=events.guarded,
        )
        self._all = [*self._observations]
        instruction = events.guarded(bounded(String, events.on_instruction))
        objects = events.guarded(bounded(String, events.on_objects))
        self._texts = [
            MatchedSubscription(node, String, 'instruction', instruction, depth=1),
            MatchedSubscription(node, String, 'objects', objects, depth=1),
        ]
        self._all += self._texts
        take, refuse = events.guarded(events.on_plan), events.guarded(events.on_refused_plan)

        self._early: set[int] = set()

        def handle(data: bytes, info: Mapping[str, int]) -> None:
            try:
                message = decode(JointTrajectory, data)
            except Rejection as error:
                stamp_ns = read_stamp(data) if len(data) >= MIN_STAMPED_BYTES else 0
                refuse(error, stamp_ns)
                return
            if info['source_timestamp'] in self._early:
                return  # came while the node was loading, to the subscription of that time
            take(message, (info['received_timestamp'] - info['source_timestamp']) / NANO)

        self._handle = handle
        self._plans = MatchedSubscription(
            node,
            JointTrajectory,
            'joint_trajectory',
            handle,
            depth=PLANS_KEPT,
            default='reliable',
        )
        self._all.append(self._plans)
        self._watch = QosWatch(node)
        urgent = [node.resolve_topic_name(topic) for topic in ('joint_trajectory', *states)]
        self._paths = {f'receive_path.{topic}': PATHS.of(topic) for topic in urgent}

    def refresh(self) -> None:
        """Look at the publishers again; to be called now and then."""
        for subscription in self._all:
            subscription.refresh()
        self._watch.refresh()

    def take_early(self, data: bytes, info: Mapping[str, int]) -> None:
        """Take a plan, as it was sent, that another subscription received before this was made."""
        self._handle(data, info)
        self._early.add(info['source_timestamp'])

    def awaits_texts(self) -> bool:
        """Return True if a publisher holds an instruction or object names for late subscribers.

        A publisher keeps its last text for subscribers that come later (transient local).
        """
        return any(not text.num_received and text.is_kept_for_it() for text in self._texts)

    def mismatches(self) -> list[str]:
        """Return the peers whose QoS prevents messages to or from this node."""
        return self._watch.mismatches

    def unpublished(self) -> list[str]:
        """Return the topics of observations that nobody publishes."""
        return [s.topic for s in self._observations if not s.num_publishers]

    @property
    def plan_topic(self) -> str:
        """Subscription to trajectories."""
        return self._plans.topic

    def receive_paths(self) -> Mapping[str, str]:
        """Receive paths of plans and joint states, as `receive_path.<topic>`."""
        return self._paths

    def publisher_counts(self) -> dict[str, int]:
        """Publishers by topic, as `publishers.<topic>`, and messages that did not come.

        Those are `not_received.<topic>`; `policies` is the number of publishers of trajectories.
        """
        counts = {f'publishers.{i.topic}': i.num_publishers for i in self._all}
        lost = {f'not_received.{i.topic}': i.num_lost for i in self._all}
        return {**counts, **lost, 'policies': self._plans.num_publishers}


def subscribe_observations(
    node: Node,
    topics: Mapping[str, str],
    *,
    compressed: Collection[str],
    states: Sequence[str],
    buffer: ObservationBuffer,
    guarded: Callable[[Handler], Handler],
) -> list[MatchedSubscription]:
    """Subscribe to the cameras and joint states.

    Args:
        node: owner of the subscriptions.
        topics: camera topic of each view; `image_raw` and `camera_info` lie below.
        compressed: views whose images come as JPEG or PNG.
        states: topics of joint states; empty = `joint_states`.
        buffer: buffer of images, camera infos and joint states.
        guarded: returns a handler as a callback that no message makes raise.
    """
    newest: list[tuple[Any, str, Handler, int]] = []
    for view, topic in topics.items():
        is_compressed = view in compressed
        kind, suffix = (CompressedImage, '/compressed') if is_compressed else (Image, '')
        rectified = is_rectified(node.resolve_topic_name(f'{topic}/image_raw{suffix}'))
        add_info = partial(buffer.add_camera_info, view, is_rectified=rectified)
        newest += [
            (CameraInfo, f'{topic}/camera_info', add_info, 1),
            (kind, f'{topic}/image_raw{suffix}', partial(buffer.add_image, view), 1),
        ]
    buffer.image_hint = partial(_other_image_topic, node, topics, compressed)
    measured = states or ('joint_states',)
    newest += [(JointState, topic, buffer.add_joint_state, 10) for topic in measured]
    return [
        MatchedSubscription(node, kind, topic, guarded(bounded(kind, handle)), depth=depth)
        for kind, topic, handle, depth in newest
    ]


def _other_image_topic(
    node: Node, topics: Mapping[str, str], compressed: Collection[str], view: str
) -> str:
    """Return that a view's images are published in the other form alone; empty = they are not."""
    is_compressed, forms = view in compressed, ('', '/compressed')
    own, other = (
        node.resolve_topic_name(f'{topics[view]}/image_raw{forms[is_compressed == is_own]}')
        for is_own in (True, False)
    )
    if node.count_publishers(own) or not node.count_publishers(other):
        return ''
    form, value = ('raw', 'false') if is_compressed else ('compressed', 'true')
    return f"'{other}' publishes {form} images: set the parameter 'compressed_input' to {value}"


class MatchedSubscription:
    """Subscription with the strongest QoS that all publishers offer.

    It starts with the weakest QoS. Nothing is lost at the change: the first subscription goes
    at a refresh after the second is connected. Until then a message may come twice, so it suits
    topics where the newest message counts. `qos_overrides.<topic>.subscription.reliability`
    (match, reliable, best_effort) and `.depth` override the reliability and the depth.

    Attributes:
        topic: resolved name of the topic.
        num_received: number of messages received.
        num_lost: number of messages that the middleware gave up, or that its publisher dropped
            before they came.

    Args:
        node: node that subscribes.
        kind: class of the message.
        topic: relative or absolute name of the topic.
        callback: receiver of the serialised messages (see `bounded`); with two arguments also of
            rclpy's information.
        depth: number of messages in the queue.
        default: `match`, or `reliable`, `best_effort` for a plain subscription.
    """

    def __init__(
        self,
        node: Node,
        kind: Any,
        topic: str,
        callback: Callable[..., None],
        *,
        depth: int,
        default: str = 'match',
    ) -> None:
        self._node, self._kind = node, kind
        self.num_received = self.num_lost = 0

        @wraps(callback)  # rclpy looks at its signature
        def count(*arguments: Any) -> None:
            self.num_received += 1
            callback(*arguments)

        self._callback = count
        self.topic = node.resolve_topic_name(topic)
        prefix = f'qos_overrides.{self.topic}.subscription'

        def declare(name: str, value: object, text: str) -> Any:
            descriptor = ParameterDescriptor(description=f'{text} of {self.topic}', read_only=True)
            if node.has_parameter(f'{prefix}.{name}'):  # a lifecycle node is configured again
                return node.get_parameter(f'{prefix}.{name}').value
            return parameters.declare_one(node, f'{prefix}.{name}', value, descriptor)

        words = ', '.join(_RELIABILITIES)
        choice = declare('reliability', default, f'{words}: reliability of the subscription')
        if choice not in _RELIABILITIES:
            raise ConfigError(
                f"parameter '{prefix}.reliability' is '{choice}'; it must be one of {words}"
            )
        self._depth = declare('depth', depth, 'Messages kept by the subscription')
        self._matches = choice == 'match'
        self._qos = _LOWEST
        if choice == 'reliable':
            self._qos = (ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE)
        self._current = self._create(self._qos)
        self._next: Subscription | None = None
        self._is_next_connected = False

    @property
    def num_publishers(self) -> int:
        """Number of connected publishers."""
        return self._current.get_publisher_count()

    def is_kept_for_it(self) -> bool:
        """Return whether a publisher keeps messages for subscribers that come later."""
        infos = self._node.get_publishers_info_by_topic(self.topic)
        return any(i.qos_profile.durability == _HIGHEST[1] for i in infos)

    def refresh(self) -> None:
        """Look at the publishers again; to be called now and then."""
        if self._next is not None and self._is_next_connected:
            self._node.destroy_subscription(self._current)
            self._current, self._next = self._next, None
        if not self._matches or self._next is not None:
            return
        offered = [
            (info.qos_profile.reliability, info.qos_profile.durability)
            for info in self._node.get_publishers_info_by_topic(self.topic)
        ]
        if not offered:
            return
        wanted = tuple(
            high if all(offer[at] == high for offer in offered) else _LOWEST[at]
            for at, high in enumerate(_HIGHEST)
        )
        if wanted != self._qos:
            self._qos = wanted
            self._is_next_connected = False
            self._next = self._create(wanted)

    def _create(self, qos: tuple[Any, ...]) -> Subscription:
        profile = QoSProfile(depth=self._depth, reliability=qos[0], durability=qos[1])
        try:
            events = SubscriptionEventCallbacks(
                matched=lambda event: self._on_matched(event, qos),
                incompatible_qos=lambda _: self.refresh(),
                message_lost=self._on_lost,
            )
            return self._node.create_subscription(
                self._kind, self.topic, self._callback, profile, event_callbacks=events, raw=True
            )
        except UnsupportedEventTypeError:
            return self._node.create_subscription(
                self._kind, self.topic, self._callback, profile, raw=True
            )

    def _on_lost(self, event: Any) -> None:
        self.num_lost += event.total_count_change

    def _on_matched(self, event: Any, qos: tuple[Any, ...]) -> None:
        if self._next is None:
            self.refresh()
        elif qos == self._qos and event.current_count:
            self._is_next_connected = True
