"""The node `world_model`: wires topics, services and parameters to the modules beside it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
import sys
import time

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from mtv_world_ros.bounded_input import check_limit
from mtv_world_ros.pipeline import Pipeline
from mtv_world_ros.ros import parameters
from mtv_world_ros.ros.messages.rejection import bounded, Reason, Rejection
from mtv_world_ros.ros.messages.stamps import to_ns
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.run_node import run
from mtv_world_ros.ros.sensing.observations import ObservationBuffer
from mtv_world_ros.ros.sensing.subscriptions import Inputs
from mtv_world_ros.ros.world_model.adapter_parameter import AdapterSwitch
from mtv_world_ros.ros.world_model.live_fidelity import LiveFidelity
from mtv_world_ros.ros.world_model.loading import (
    check_calibration,
    load_cameras,
    load_named_pipeline,
    reload_cameras,
)
from mtv_world_ros.ros.world_model.prediction_publisher import PredictionPublisher
from mtv_world_ros.ros.world_model.reporter import Reporter
from mtv_world_ros.ros.world_model.requests import RequestMaker
from mtv_world_ros.ros.world_model.worker import RolloutWorker

Load = Callable[[Settings], Pipeline]


class WorldModelNode(Node):
    """Callbacks store; a worker thread runs the model; results are published from the executor.

    Args:
        load: makes the pipeline from the parameters.

    Raises:
        MtvWorldError: a parameter, the checkpoint or a file it names cannot be used.
    """

    def __init__(self, load: Load = load_named_pipeline) -> None:
        super().__init__('world_model')
        parameters.declare(self, Settings)
        self._settings = parameters.read(self, Settings)
        self.add_on_set_parameters_callback(self._check_calibration)
        self.add_post_set_parameters_callback(self._on_parameters)
        pipeline = load(self._settings)
        self._spec, self._robot = pipeline.spec, pipeline.robot
        self._worker = RolloutWorker(pipeline, lambda: self._results.trigger())
        self._adapter = AdapterSwitch(self, pipeline.world_model, self._worker.run_between)
        self._buffer = ObservationBuffer(
            cameras=load_cameras(self._settings, self._spec),
            joint_names=self._robot.joint_names,
            width=self._spec.width,
            height=self._spec.height,
            limits=self.settings,
            on_image=self._on_image,
        )
        self._maker = RequestMaker(
            self._robot, self._buffer, self.settings, lambda: self._worker.last_scene
        )
        self._reporter = Reporter(
            self, self._robot.name, self.settings, self._state, self._missing
        )
        self._fidelity = LiveFidelity(self, pipeline, self._reporter.scored, self._reporter.crash)
        self._publisher = PredictionPublisher(
            self,
            self._spec,
            self._robot.joint_names,
            self.settings,
            on_judged=self._reporter.judged,
            on_sent=self._reporter.sent,
            on_ended=self._reporter.ended,
            on_error=self._reporter.crash,
        )
        self._arrived: deque[tuple[float, JointTrajectory]] = deque()
        self._arrivals = self.create_guard_condition(self._start_rollouts)
        self._results = self.create_guard_condition(self._publish_results)
        self._inputs = Inputs(
            self,
            self._spec.views,
            compressed=self._settings.compressed_input,
            buffer=self._buffer,
            on_instruction=self._on_instruction,
            on_trajectory=self._on_trajectory,
            guarded=self._reporter.guarded,
        )
        served, guarded = self._reporter.served, self._reporter.guarded
        self.create_service(Trigger, '~/reset', served(self._on_reset))
        self.create_service(SetBool, '~/imagine', served(self._on_imagine))
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(
            self._settings.diagnostics_period_s, guarded(self._on_period), clock=steady
        )
        back = JumpThreshold(
            min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False
        )
        self._jumps = self.get_clock().create_jump_callback(
            back, post_callback=guarded(self._on_jump)
        )
        parameters.refuse_unknown(self)
        self._worker.start()
        self.get_logger().info(
            f'ready: {", ".join(self._spec.views)} at {self._spec.width}x{self._spec.height}, '
            f'{self._spec.num_frames} frames of {self._spec.fps:g} Hz a chunk, '
            f'robot {self._robot.name}'
        )

    def settings(self) -> Settings:
        """The present parameters."""
        return self._settings

    def close(self) -> None:
        """Ends the worker and the node."""
        self._worker.close()
        self._fidelity.close()
        self.destroy_node()

    def _on_image(self, view: str, message: Image | CompressedImage) -> None:
        """Hands real images on; an observation of all views once a frame of the model."""
        self._fidelity.see(view, message)
        if self._worker.sees(self._buffer.newest_stamp_ns):
            with suppress(Rejection):  # the plan that comes too early is told
                self._worker.see(
                    self._buffer.observe(self.get_clock().now().nanoseconds).observation
                )

    def _on_instruction(self, message: String) -> None:
        with bounded(Reason.INSTRUCTION_TOO_LONG):
            check_limit('instruction_characters', len(message.data), 'the instruction')
        self._maker.instruction = message.data

    def _on_trajectory(self, message: JointTrajectory) -> None:
        """Stores it; images that came with it are stored before it is looked at."""
        self._arrived.append((time.monotonic(), message))
        self._arrivals.trigger()

    def _start_rollouts(self) -> None:
        while self._arrived:
            self._reporter.guarded(self._start_rollout)(self._arrived.popleft())

    def _start_rollout(self, arrived: tuple[float, JointTrajectory]) -> None:
        received_s, message = arrived
        self._reporter.count('trajectories_received')
        now_ns = self.get_clock().now().nanoseconds
        try:
            request = self._maker.make(message, now_ns, received_s)
            self._worker.submit(self._fidelity.replan(request))
        except Exception as error:  # one answer a plan, whatever is wrong with it
            self._reporter.reject_trajectory(error, to_ns(message.header.stamp))

    def _publish_results(self) -> None:
        for result in self._worker.take():
            for take in (self._fidelity.expect, self._publisher.add):
                self._reporter.guarded(take)(result)

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._give_up()
        try:
            self._buffer.accept_cameras(reload_cameras(self._settings, self._spec))
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

    def _give_up(self) -> None:
        for part in (self._worker, self._fidelity, self._publisher):
            part.reset()

    def _on_jump(self, _: object) -> None:
        """The clock went back, as when a bag starts over: what is stored lies in the future."""
        self._reporter.count('clock_jumps_back')
        self._buffer.clear()
        self._give_up()

    def _check_calibration(self, changed: list[Parameter]) -> SetParametersResult:
        """Refuses a `calibration_file` that cannot be used."""
        return check_calibration(changed, self._settings, self._spec)

    def _on_parameters(self, _: object) -> None:
        self._settings = parameters.read(self, Settings)

    def _on_period(self) -> None:
        self._worker.supervise(self._settings.stuck_after_s)
        self._inputs.refresh()
        self._reporter.publish_diagnostics()

    def _missing(self) -> list[str]:
        """What the node needs and does not get; in imagine mode only to begin."""
        if self._maker.imagine and self._worker.last_scene is not None:
            return []
        silent = [f'nobody publishes {topic}' for topic in self._inputs.unpublished()]
        if not self._maker.num_requests and not self._inputs.publisher_counts()['policies']:
            silent.append(f'nobody publishes {self._inputs.plan_topic}')
        return silent or self._buffer.problems(self.get_clock().now().nanoseconds)

    def _state(self) -> Mapping[str, object]:
        return {
            'mode': 'imagine' if self._maker.imagine else 'observe',
            'checkpoint': self._settings.checkpoint,
            'adapter': self._adapter.in_use,
            'views': self._spec.views,
            'busy': self._worker.busy,
            **self._fidelity.values(),
            **self._inputs.publisher_counts(),
            **self._publisher.subscriber_counts(),
            **self._buffer.ages(self.get_clock().now().nanoseconds),
        }


def main(args: Sequence[str] | None = None, load: Load = load_named_pipeline) -> int:
    """Runs the node; returns the exit status."""
    help_text = parameters.help_text('world_model', Settings)
    return run(lambda: WorldModelNode(load), args, help_text=help_text)


if __name__ == '__main__':
    sys.exit(main())
