"""The node `policy`: runs a policy in the world model, or on the real robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMsg

from mtv_world_ros.core.data_types import JointTrajectory, Observation
from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.policies.policy import EpisodeOrigin
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.rollout.assembly import assemble_policy, PolicyMaker
from mtv_world_ros.rollout.candidates import (
    candidate_policy,
    check_candidates,
    comparing_pipeline,
)
from mtv_world_ros.ros import parameters
from mtv_world_ros.ros.messages.bounded import bounded
from mtv_world_ros.ros.messages.conversions import make_header, to_trajectory_message, values_of
from mtv_world_ros.ros.messages.rejection import Reason, Rejection
from mtv_world_ros.ros.policy.loop import PolicyLoop, PolicySettings, PredictedFrames
from mtv_world_ros.ros.policy.policy_thread import Actor
from mtv_world_ros.ros.qos_profiles import LATCHED, QosWatch
from mtv_world_ros.ros.receive_paths import SERVICES
from mtv_world_ros.ros.run_node import run
from mtv_world_ros.ros.sensing.observations import ObservationBuffer
from mtv_world_ros.ros.sensing.samples import NodeTime
from mtv_world_ros.ros.sensing.subscriptions import subscribe_observations
from mtv_world_ros.ros.status_publisher import StatusPublisher
from mtv_world_ros.ros.world_model.loading import check_calibration, reload_cameras

Load = Callable[[PolicySettings, RobotModel], PolicyMaker]
_TICK_S = 0.02
#: time after which a reset without an answer is asked for again [s]
_ASK_AGAIN_S = 4.0
#: number of requests whose answers are waited for: a slow answer to an earlier one counts, too
_MAX_ASKED = 3


def load_named_policy(settings: PolicySettings, robot: RobotModel) -> PolicyMaker:
    """Return a function that makes the policy of the parameters, for a robot."""
    check_candidates(settings.policy, robot, settings.candidates)
    return assemble_policy(settings.policy, robot)


def with_candidates(
    load: Load, settings: PolicySettings, checkpoint: Checkpoint, robot: RobotModel
) -> PolicyMaker:
    """Return the maker of the policy; with candidates, their plans are compared first.

    Raises:
        ConfigError: there are several candidates, and nothing that plans can be compared with.
    """
    if settings.candidates == 1:
        return load(settings, robot)
    pipeline = comparing_pipeline(checkpoint, robot)
    makers = [load(settings, robot) for _ in range(settings.candidates)]
    return lambda origin: candidate_policy([make(origin) for make in makers], pipeline)


class PolicyNode(Node):
    """Node that runs a policy: callbacks store messages, a thread asks the policy.

    Args:
        load: function that returns the maker of the policy from the parameters.
        context: ROS context of the node; default: the process' own.

    Raises:
        MtvWorldError: a parameter or a file it names cannot be used.
    """

    def __init__(self, load: Load = load_named_policy, context: Context | None = None) -> None:
        super().__init__('policy', context=context)
        parameters.declare(self, PolicySettings)
        settings = self._settings()
        self._checkpoint = checkpoint = Checkpoint.open(settings.checkpoint)
        robot = checkpoint.load_robot(settings.robot_file or None)
        self._make_policy = with_candidates(load, settings, checkpoint, robot)
        self._spec, joint_names = checkpoint.spec, robot.joint_names
        self._status = StatusPublisher(self)
        self._buffer = ObservationBuffer(
            cameras=reload_cameras(settings, self._spec, self._checkpoint),
            robot=robot,
            width=self._spec.width,
            height=self._spec.height,
            limits=self._settings,
            time=NodeTime.of(self),
        )
        frames = PredictedFrames(self._spec.views, joint_names)
        self._actor = Actor(lambda: self._answers.trigger())
        self._loop = PolicyLoop(self._spec, joint_names, self._actor, frames, self)
        self._answers = self.create_guard_condition(self._guarded(self._loop.on_answers))
        self._cameras = subscribe_observations(
            self,
            parameters.declare_camera_topics(self, self._spec.views),
            compressed=self._spec.views if settings.compressed_input else (),
            states=settings.joint_state_topics,
            buffer=self._buffer,
            guarded=self._guarded,
        )
        self._subscribe_predictions(settings.world_model, frames)
        self._plans = self.create_publisher(JointTrajectoryMsg, 'joint_trajectory', 10)
        self._reset = WorldModelReset(self, settings.world_model)
        self._instruction = self.create_publisher(String, 'instruction', LATCHED)
        self.create_service(Trigger, '~/start', self._on_start)
        self.create_service(Trigger, '~/stop', self._on_stop)
        self._watch = QosWatch(self)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_TICK_S, self._guarded(self._loop.tick), clock=steady)
        self.create_timer(settings.diagnostics_period_s, self._on_period, clock=steady)
        self.add_on_set_parameters_callback(
            parameters.refusing(
                lambda changed: check_calibration(
                    changed, self._settings(), self._spec, self._checkpoint
                )
            )
        )
        parameters.refuse_unknown(self)
        self.get_logger().info(f"ready: policy '{settings.policy}'")

    def close(self) -> None:
        """End a running episode and the node."""
        if self.context.ok():
            self._loop.end('stopped', 'the policy node ends')
        self._actor.close()
        self.destroy_node()

    # what the loop does to the world

    def send(self, trajectory: JointTrajectory, stamp_ns: int) -> None:
        """Publish an answer under the stamp of the observation that it answers."""
        self._plans.publish(to_trajectory_message(trajectory, make_header(stamp_ns)))

    def report(self, state: str, values: Mapping[str, object]) -> None:
        """Publish a report and count it."""
        kind = f'episodes_{values["how"]}' if state == 'ended' else f'{state}s'
        self._status.counts[kind] += 1
        self._status.report(state, values)

    def fault(self, kind: str, text: str) -> None:
        """Count a fault and publish `/diagnostics` at once."""
        self._status.fault(kind, text)
        self._publish_diagnostics()

    def observe(self) -> Observation:
        """Return the newest real observation.

        Raises:
            Rejection: there is none.
        """
        if self._unconnected():
            raise Rejection(
                Reason.WORLD_MODEL_MISSING,
                f'nobody is connected to {self._unconnected()}; is the world model running, and '
                "does the parameter 'world_model' name it?",
            )
        self._reset.check()
        return self._buffer.observe(self.get_clock().now().nanoseconds).observation

    # what reaches it

    def _subscribe_predictions(self, world_model: str, frames: PredictedFrames) -> None:
        profile = QoSProfile(
            depth=4 * self._spec.num_frames, reliability=ReliabilityPolicy.RELIABLE
        )
        topics: list[tuple[Any, str, Callable[[Any], None]]] = [
            (Image, f'{view}/predicted/image_raw', partial(frames.add_image, view))
            for view in self._spec.views
        ]
        topics += [
            (JointState, 'predicted/joint_states', frames.add_joint_state),
            (DiagnosticArray, 'report', self._on_report),
        ]
        self._predictions = [
            self.create_subscription(
                kind,
                f'{world_model}/{topic}',
                self._guarded(bounded(kind, handle)),
                profile,
                raw=True,
            )
            for kind, topic, handle in topics
        ]

    def _unconnected(self) -> list[str]:
        """Return topics that the world model is not connected to: messages on them are lost."""
        unconnected = [s.topic_name for s in self._predictions if not s.get_publisher_count()]
        return unconnected + (
            [] if self._plans.get_subscription_count() else [self._plans.topic_name]
        )

    def _on_report(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self._loop.on_report(values_of(status))

    def _on_start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        settings = self._settings()
        try:
            self._buffer.accept_cameras(reload_cameras(settings, self._spec, self._checkpoint))
        except MtvWorldError as error:
            response.message = f'not started: {error}'
            return response
        self._buffer.clear()
        if settings.instruction:
            self._instruction.publish(String(data=settings.instruction))
        if settings.mode == 'imagine':
            self._reset.ask()
        origin = EpisodeOrigin(
            task=settings.task,
            scene_seed=settings.scene_seed,
            recording=settings.recording,
            recording_ns=settings.recording_ns,
        )
        self._loop.start(partial(self._make_policy, origin), settings)
        response.success, response.message = True, f'episode {self._loop.episode}'
        return response

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._loop.end('stopped')
        response.success = True
        return response

    def _on_period(self) -> None:
        for subscription in self._cameras:
            subscription.refresh()
        self._watch.refresh()
        self._publish_diagnostics()

    def _publish_diagnostics(self) -> None:
        num_policies = self.count_publishers(self._plans.topic_name)
        state = {
            'phase': self._loop.phase,
            'episode': self._loop.episode,
            'num_chunks': self._loop.num_chunks,
            'policies': num_policies,
        }
        warnings = list(self._watch.mismatches)
        if num_policies > 1:
            warnings.append(
                f'{num_policies} publishers of joint trajectories, this should be the only one'
            )
        self._status.publish_diagnostics(state, ' | '.join(warnings))

    def _guarded(self, handle: Callable[..., None]) -> Callable[..., None]:
        def callback(*arguments: Any) -> None:
            try:
                handle(*arguments)
            except Rejection as error:
                self._status.fault(error.reason, str(error))
            except Exception as error:  # the node never dies of a message
                if self.context.ok():
                    self._loop.end('policy_failed', f'{type(error).__name__}: {error}')

        return callback

    def _settings(self) -> PolicySettings:
        return parameters.read(self, PolicySettings)


class WorldModelReset:
    """Resets the world model, so that an imagined episode begins at real frames.

    Args:
        node: owner of the client.
        world_model: name of the world model's node.
    """

    def __init__(self, node: Node, world_model: str) -> None:
        self._client = node.create_client(Trigger, f'{world_model}/reset')
        self._asked: list[Future] = []
        self._asked_s = 0.0

    def ask(self) -> None:
        """Ask for a reset; `check` refuses until it is done."""
        self._keep(0)
        self._send()

    def check(self) -> None:
        """Refuse to go on until the reset that was asked for is done.

        Raises:
            Rejection: the world model has not answered yet, or refused.
        """
        if not self._asked:
            return
        answers = [future.result() for future in self._asked if future.done()]
        if any(answer is not None and answer.success for answer in answers):
            self._keep(0)
            return
        if time.monotonic() > self._asked_s + _ASK_AGAIN_S:  # an answer may get lost
            self._keep(_MAX_ASKED - 1)
            self._send()
        said = next((f': {a.message}' for a in answers if a is not None and a.message), '')
        raise Rejection(
            Reason.WORLD_MODEL_MISSING,
            f"'{self._client.srv_name}' has not reset the world model yet{said}",
        )

    def _send(self) -> None:
        self._asked.append(self._client.call_async(Trigger.Request()))
        self._asked_s = time.monotonic()

    def _keep(self, num: int) -> None:
        """Give up all requests but the newest: rclpy holds a request until it has an answer."""
        given_up = self._asked[: len(self._asked) - num]
        self._asked = self._asked[len(given_up) :]
        for future in given_up:
            future.cancel()


def main(args: Sequence[str] | None = None, load: Load = load_named_policy) -> int:
    """Run the node; return the exit status."""
    help_text = parameters.help_text('python -m mtv_world_ros.ros.policy.node', PolicySettings)
    return run(
        lambda: PolicyNode(load),
        args,
        help_text=help_text,
        name='policy',
        own_paths=(('joint_states', SERVICES),),
    )


if __name__ == '__main__':
    sys.exit(main())
