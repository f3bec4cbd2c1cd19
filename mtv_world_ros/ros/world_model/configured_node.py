"""Resources of a configured node: pipeline, subscriptions, publishers."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
import time
from typing import NamedTuple

from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMsg

from mtv_world_ros.core.bounded_input import check_limit
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.ros.messages.conversions import to_ns
from mtv_world_ros.ros.messages.rejection import Reason, rejected_as, Rejection
from mtv_world_ros.ros.parameters import refusing, Settings
from mtv_world_ros.ros.sensing.live_robot import Extrinsics, RobotDescription
from mtv_world_ros.ros.sensing.observations import ObservationBuffer
from mtv_world_ros.ros.sensing.samples import NodeTime
from mtv_world_ros.ros.sensing.subscriptions import Inputs
from mtv_world_ros.ros.world_model.follow_joint_trajectory import (
    find_action,
    FollowJointTrajectory,
    NAME,
)
from mtv_world_ros.ros.world_model.goal import Goal
from mtv_world_ros.ros.world_model.live_fidelity import LiveFidelity
from mtv_world_ros.ros.world_model.loading import (
    AdapterSwitch,
    check_calibration,
    load_cameras,
    reload_cameras,
)
from mtv_world_ros.ros.world_model.prediction_publisher import PredictionPublisher
from mtv_world_ros.ros.world_model.reporter import Reporter
from mtv_world_ros.ros.world_model.request_maker import RequestMaker
from mtv_world_ros.ros.world_model.worker import Foreseen, RolloutWorker

#: the first plan of an imagined episode may come this long before what it answers [s]: a lost
#: message without a next one comes again after the sender's heartbeat, by default every 3 s
_EARLY_S = 5.0
#: a plan may come this long before the first images, joint states and kept texts of topics that
#: have a publisher, and before images of its moment in all views [s]
_FIRST_S = 0.5
#: a plan that is under way for longer was lost and sent again [s]
_LATE_S = 0.5
#: what a node makes and can destroy
_ENTITIES = ('publisher', 'subscription', 'service', 'timer', 'guard_condition')


class _Arrived(NamedTuple):
    """A plan that waits.

    Attributes:
        received_s: when it came [s], of `time.monotonic`.
        plan: plan of the topic or the action.
        transport_s: time between publishing and arrival [s].
    """

    received_s: float
    plan: JointTrajectoryMsg | Goal
    transport_s: float

    @property
    def message(self) -> JointTrajectoryMsg:
        """The plan as the topic has it."""
        return self.plan.message if isinstance(self.plan, Goal) else self.plan


def _with_delay(error: Exception, transport_s: float) -> Exception:
    """Return the rejection of a stale plan with the delay that the middleware made."""
    is_stale = isinstance(error, Rejection) and error.reason is Reason.TRAJECTORY_STALE
    if not is_stale or transport_s < _LATE_S:
        return error
    return Rejection(
        Reason.TRAJECTORY_STALE,
        f'{error}. It was received {transport_s:.3f} s after it was published: lost and sent '
        "again, unless the clocks of two machines differ; see 'Plans arrive late' in "
        'docs/troubleshooting.md',
    )


class ConfiguredNode:
    """Plans in, predictions out: what a node owns while it is configured.

    It is the `NodeEvents` of its parts. Callbacks store; a worker thread runs the model; results
    are published from the executor. Plans are refused until `activate`.

    Attributes:
        description: views, sizes and robot in words.

    Args:
        node: owner of all inputs and outputs.
        pipeline: the main path.
        settings: the present parameters.
        reporter: publishes results and diagnostics.

    Raises:
        MtvWorldError: a parameter or a file it names cannot be used; nothing is left on the node.
    """

    def __init__(
        self,
        node: Node,
        pipeline: Pipeline,
        settings: Callable[[], Settings],
        reporter: Reporter,
    ) -> None:
        self._node, self.settings, self._reporter = node, settings, reporter
        self.guarded, self.on_error = reporter.guarded, reporter.crash
        self.on_judged, self.on_sent = reporter.judged, reporter.sent
        self.on_ended, self.on_scored = reporter.ended, reporter.scored
        self._spec, self._robot = pipeline.spec, pipeline.robot
        self._is_active = False
        self.description = (
            f'{", ".join(self._spec.views)} at {self._spec.width}x{self._spec.height}, '
            f'{self._spec.num_frames} frames of {self._spec.fps:g} Hz a chunk, '
            f'robot {self._robot.name}'
        )
        with ExitStack() as undo:
            undo.callback(_destroy_others, node, _entities(node))
            self._build(pipeline, undo)
            self._undo = undo.pop_all()

    def _build(self, pipeline: Pipeline, undo: ExitStack) -> None:
        node, settings = self._node, self.settings
        self._checkpoint = pipeline.checkpoint or settings().checkpoint
        self._time = NodeTime.of(node)
        self._time.step_s()
        check = refusing(
            lambda changed: check_calibration(changed, settings(), self._spec, self._checkpoint)
        )
        node.add_on_set_parameters_callback(check)
        undo.callback(node.remove_on_set_parameters_callback, check)
        self._worker = RolloutWorker(pipeline, self.on_results)
        undo.callback(self._worker.close)
        self._adapter = AdapterSwitch(node, pipeline.world_model, self._worker.run_between)
        undo.callback(self._adapter.close)
        self._extrinsics = Extrinsics(
            node, self._robot.posed_links, self, publishes=settings().publish_tf
        )
        self._description: RobotDescription | None = None
        if settings().use_robot_description:
            self._description = RobotDescription(node, self._robot, self)
        self._buffer = ObservationBuffer(
            cameras=load_cameras(settings(), self._spec, self._checkpoint),
            robot=self._robot,
            width=self._spec.width,
            height=self._spec.height,
            limits=settings,
            on_image=self.on_image,
            pose=self._extrinsics.pose,
            time=self._time,
        )
        self._maker = RequestMaker(
            self._robot, self._buffer, settings, lambda: self._worker.last_scene
        )
        self._fidelity = LiveFidelity(node, pipeline, self)
        self._worker.doubt = lambda: self._fidelity.watch.doubt
        self._worker.contact = self._fidelity.trust
        self._fidelity.wait_for_verdict = self._worker.wait_for_verdict
        undo.callback(self._fidelity.close)
        self._publisher = PredictionPublisher(node, self._spec, self._robot.joint_names, self)
        self._arrived: deque[_Arrived] = deque()
        self._arrivals = node.create_guard_condition(self.start_waiting)
        self._results = node.create_guard_condition(self._publish_results)
        self._inputs = Inputs(
            node,
            self._spec.views,
            compressed=settings().compressed_input,
            states=settings().joint_state_topics,
            buffer=self._buffer,
            events=self,
        )
        self._action = self._offer_action(undo)
        node.create_service(Trigger, '~/reset', self._reporter.served(self._on_reset))
        node.create_service(SetBool, '~/imagine', self._reporter.served(self._on_imagine))
        back = JumpThreshold(
            min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False
        )
        jumps = node.get_clock().create_jump_callback(
            back, post_callback=self.guarded(self._on_jump)
        )
        undo.callback(jumps.unregister)
        self._worker.start()

    def _offer_action(self, undo: ExitStack) -> FollowJointTrajectory | None:
        kind, node = find_action(), self._node
        if kind is None:
            node.get_logger().info(f'control_msgs is not installed: no {NAME}')
            return None
        action = FollowJointTrajectory(kind, node, self._robot, self)
        undo.callback(action.close)
        return action

    def activate(self) -> None:
        """Take plans from now on."""
        self._is_active = True

    def deactivate(self) -> None:
        """Refuse plans from now on; one that runs or waits is reported as pre-empted."""
        self._is_active = False
        self.start_waiting()  # plans that came before are reported as well
        self._give_up('preempted', 'the node was deactivated')
        self._publish_results()

    def close(self) -> None:
        """End the threads and take all inputs and outputs from the node."""
        self._undo.close()

    def refresh(self) -> None:
        """Look at the worker and at the publishers again; to be called now and then."""
        self._check_clock()
        self._worker.supervise(self.settings().stuck_after_s)
        self._inputs.refresh()
        self._look_again()

    def missing(self) -> Sequence[str]:
        """Return the missing inputs; in imagine mode only those that the first plan needs."""
        if self._description is not None and self._description.problem:
            return [self._description.problem]
        return [*self._inputs.mismatches(), *self._missing_inputs()]

    def _missing_inputs(self) -> Sequence[str]:
        if self._maker.imagine and self._worker.last_scene is not None:
            return []
        silent = [f'nobody publishes {topic}' for topic in self._inputs.unpublished()]
        if not self._maker.num_requests and not self._inputs.publisher_counts()['policies']:
            silent.append(f'nobody publishes {self._inputs.plan_topic}')
        return silent or self._buffer.problems(self._node.get_clock().now().nanoseconds)

    def state(self) -> Mapping[str, object]:
        """Return the keys and values for `/diagnostics`."""
        return {
            'mode': 'imagine' if self._maker.imagine else 'observe',
            'checkpoint': self.settings().checkpoint,
            'adapter': self._adapter.in_use,
            'views': self._spec.views,
            'busy': self._worker.busy,
            'cameras': self._worker.camera_check.text,
            'physics': self._physics_text(),
            **({} if self._description is None else self._description.values()),
            **self._extrinsics.values(),
            **self._fidelity.values(),
            **self._inputs.publisher_counts(),
            **self._inputs.receive_paths(),
            **self._publisher.subscriber_counts(),
            **self._buffer.ages(self._node.get_clock().now().nanoseconds),
            **({'camera_notes': '; '.join(notes)} if (notes := self._buffer.notes) else {}),
        }

    def _physics_text(self) -> str:
        """Text about the contact parameters for `/diagnostics`."""
        return self._fidelity.physics_text(self.settings().place)

    def on_results(self) -> None:
        """Wake the executor, which publishes the results; called from any thread."""
        self._results.trigger()

    def give_up(self, rollout: int, text: str) -> None:
        """Pre-empt one plan if it still runs or waits."""
        self._worker.give_up(rollout, text)

    def on_image(self, view: str, message: Image | CompressedImage) -> None:
        """Pass real images on, and one observation of all views per frame of the model."""
        if not self._is_active or self._check_clock():
            return
        self._look_again()
        self._fidelity.see(view, message)
        if self._worker.sees(self._buffer.newest_stamp_ns):
            with suppress(Rejection):  # a plan without an observation is rejected later
                self._worker.see(
                    self._buffer.observe(self._node.get_clock().now().nanoseconds).observation
                )

    def on_instruction(self, message: String) -> None:
        """Take the instruction for the plans to come."""
        with rejected_as(Reason.INSTRUCTION_TOO_LONG):
            check_limit('instruction_characters', len(message.data), 'the instruction')
        self._maker.instruction = message.data

    def on_objects(self, message: String) -> None:
        """Take the names of the objects, comma-separated, for the plans to come."""
        with rejected_as(Reason.OBJECTS_TOO_LONG):
            check_limit('instruction_characters', len(message.data), 'the names of the objects')
        names = (name.strip() for name in message.data.split(','))
        self._maker.stored_objects = tuple(dict.fromkeys(filter(None, names)))

    def on_plan(self, plan: JointTrajectoryMsg | Goal, transport_s: float = 0.0) -> None:
        """Queue a plan; it is checked after images that arrived together with it are stored."""
        self._arrived.append(_Arrived(time.monotonic(), plan, transport_s))
        self._arrivals.trigger()

    def on_refused_plan(self, error: Exception, stamp_ns: int) -> None:
        """Answer a plan of the topic that was refused before it was decoded."""
        self._reporter.count('trajectories_received')
        self._reporter.reject_trajectory(error, stamp_ns)

    def start_waiting(self) -> None:
        """Start the plans that wait, up to one that is early."""
        while self._arrived and not (self._is_active and self._is_early(self._arrived[0])):
            self.guarded(self._start_rollout)(self._arrived.popleft())

    def take_early(self, taken: tuple[bytes, Mapping[str, int]] | None) -> None:
        """Queue the last plan that came while the node was loading; None = none came."""
        if taken is not None:
            self._inputs.take_early(*taken)

    @property
    def has_begun(self) -> bool:
        """True if a plan was taken."""
        return self._maker.num_requests > 0

    def _look_again(self) -> None:
        """Check a waiting plan again: its observation may be here, or it waited long enough."""
        if self._arrived:
            self._arrivals.trigger()

    def _is_early(self, arrived: _Arrived) -> bool:
        """Return whether a first plan arrived before the observation that it belongs to.

        Nothing orders topics: a policy may answer before this node receives the start of an
        imagined episode, and the first plan of a replay overtakes the first images.
        """
        if self._maker.is_stop(arrived.message):
            return False
        if not self.has_begun and self._inputs.awaits_texts():
            return time.monotonic() - arrived.received_s < _FIRST_S
        if not self._maker.imagine:
            is_first = self._buffer.awaits_first and not self._inputs.unpublished()
            now_ns = self._node.get_clock().now().nanoseconds
            is_early = is_first or self._buffer.are_views_apart(now_ns)
            return is_early and time.monotonic() - arrived.received_s < _FIRST_S
        if self._worker.last_scene is not None or self._worker.busy:
            return False
        is_behind = self._buffer.newest_stamp_ns < to_ns(arrived.message.header.stamp)
        now_ns = self._node.get_clock().now().nanoseconds
        return time.monotonic() - arrived.received_s < _EARLY_S and (
            is_behind or bool(self._buffer.problems(now_ns))
        )

    def _start_rollout(self, arrived: _Arrived) -> None:
        goal = arrived.plan if isinstance(arrived.plan, Goal) else None
        message = arrived.message
        self._reporter.count('trajectories_received')
        now_ns = self._node.get_clock().now().nanoseconds
        try:
            if not self._is_active:
                raise Rejection(
                    Reason.NOT_ACTIVE, 'the node is inactive; its lifecycle manager activates it'
                )
            if goal is None and self._maker.is_stop(message):
                self._stop(message)
                return
            if self._description is not None:
                self._description.check()
            if goal is not None:
                goal.check(self._robot.joint_names)
            request = self._maker.make(message, now_ns, arrived.received_s)
            self._extrinsics.show(request.scene)
            self._worker.submit(self._fidelity.replan(request))
        except Exception as raised:  # one answer a plan, whatever is wrong with it
            error = _with_delay(raised, arrived.transport_s)
            self._reporter.reject_trajectory(error, to_ns(message.header.stamp))
            if goal is not None and self._action is not None:
                self._action.refused(goal, error)
            return
        if goal is not None and self._action is not None:
            self._action.started(goal, request)

    def _stop(self, message: JointTrajectoryMsg) -> None:
        """Give up the plans before an empty trajectory, and answer it."""
        self._worker.give_up(None, 'an empty trajectory stopped it')
        if not self._maker.imagine:  # frames that are not out show what is no longer planned
            self._publisher.reset()
            self._fidelity.stop_at(self._node.get_clock().now().nanoseconds)
        self._publish_results()
        self._reporter.stopped(to_ns(message.header.stamp))

    def _publish_results(self) -> None:
        for result in self._worker.take():
            if isinstance(result, Foreseen):
                self.guarded(self._reporter.foreseen)(result)
                continue
            takers = [self._fidelity.expect, self._publisher.add]
            takers += [self._action.take] if self._action is not None else []
            for take in takers:
                self.guarded(take)(result)

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._give_up()
        try:
            self._extrinsics.accept()
            cameras = reload_cameras(self.settings(), self._spec, self._checkpoint)
            self._buffer.accept_cameras(cameras)
        except Rejection as error:
            self._reporter.reject(error)
            response.message = f'not reset: {error}'
            return response
        response.success = True
        response.message = 'the next trajectory starts from the newest real frames'
        return response

    def _on_imagine(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        if request.data != self._maker.imagine:
            self._give_up()
            self._maker.imagine = request.data
        response.success = True
        response.message = 'imagine' if request.data else 'observe'
        return response

    def on_robot(self, robot: RobotModel) -> None:
        """Take the robot as it describes itself."""
        self._maker.robot = robot
        for part in (self._buffer, self._worker, self._fidelity):
            part.use_robot(robot)

    def _give_up(self, state: str = 'reset', text: str = '') -> None:
        self._worker.reset(state, text)
        self._fidelity.reset()
        self._publisher.reset()

    def _check_clock(self) -> bool:
        """Return whether the system clock was set back; then older samples are dropped.

        rclpy tells of jumps of `/clock` only.
        """
        step_s = self._time.step_s()
        if step_s:
            self._reporter.count('clock_steps')
            self._node.get_logger().warning(
                f'the system clock was set by {step_s:+.3f} s'
                + ('; what was received before is dropped' if step_s < 0 else '')
            )
        if step_s < 0:
            self._on_jump(step_s)
        return step_s < 0

    def _on_jump(self, _: object) -> None:
        """Drop what is stored when the clock jumps back, as when a bag starts over."""
        self._reporter.count('clock_jumps_back')
        self._buffer.clear()
        self._extrinsics.forget_moving()
        self._give_up()


def _entities(node: Node) -> dict[str, list[object]]:
    """Return everything that the node has, by kind."""
    names = {kind: 'guards' if kind == 'guard_condition' else f'{kind}s' for kind in _ENTITIES}
    return {kind: list(getattr(node, name)) for kind, name in names.items()}


def _destroy_others(node: Node, kept: Mapping[str, Sequence[object]]) -> None:
    """Destroy what the node was given since."""
    for kind, entities in _entities(node).items():
        for entity in entities:
            if not any(entity is one for one in kept[kind]):
                getattr(node, f'destroy_{kind}')(entity)
