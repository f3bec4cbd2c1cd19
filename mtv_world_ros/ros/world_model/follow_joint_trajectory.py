"""The action `~/follow_joint_trajectory`: controller clients execute on the imagination."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
import importlib
from math import isnan
from typing import Any

from builtin_interfaces.msg import Duration
import numpy as np
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.exceptions import InvalidHandle
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from trajectory_msgs.msg import JointTrajectoryPoint

from mtv_world_ros.core.bounded_input import limits
from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.ros.messages.conversions import make_header, NANO
from mtv_world_ros.ros.messages.rejection import Reason, Rejection
from mtv_world_ros.ros.messages.request_limits import bounded_action, RefusedRequest
from mtv_world_ros.ros.node_events import NodeEvents
from mtv_world_ros.ros.world_model.goal import Goal
from mtv_world_ros.ros.world_model.worker import Chunk, Ended, Request, Result

NAME = '~/follow_joint_trajectory'
#: positions are compared to the digits that a message keeps
_ROUNDING = 1e-9


class FollowJointTrajectory:
    """Action server whose goals are handled like plans on the topic.

    A chunk gives one feedback, of its last frame. The goal ends when the plan does, which is as
    soon as it is computed.

    Args:
        action: the type of the action.
        node: owner of the server.
        robot: whose joints goals move.
        events: takes goals as plans, to hand them back by `started` or `refused`.
    """

    def __init__(
        self,
        action: Any,
        node: Node,
        robot: RobotModel,
        events: NodeEvents,
    ) -> None:
        self._action, self._robot, self._events = action, robot, events
        self._goals: dict[int, Goal] = {}
        self._server = _Server(
            node,
            action,
            NAME,
            execute_callback=_never,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=self._on_cancel,
        )
        self._server.refuse = events.guarded(_refuse)

    def close(self) -> None:
        """End the server."""
        self._server.destroy()

    def started(self, goal: Goal, request: Request) -> None:
        """Store the request that was made from a goal."""
        goal.request = request
        self._goals[request.rollout] = goal

    def refused(self, goal: Goal, error: Exception) -> None:
        """Abort a goal whose trajectory was rejected, with the reason."""
        reason = error.reason if isinstance(error, Rejection) else None
        self._conclude(goal, 'abort', _code(reason), str(error))

    def take(self, result: Result) -> None:
        """Send the feedback of a chunk, or the result, if the plan came from a goal."""
        goal = self._goals.get(result.request.rollout)
        if goal is None:
            return
        if isinstance(result, Chunk):
            self._follow(goal, result)
            return
        del self._goals[result.request.rollout]
        self._conclude(goal, *self._outcome(goal, result))

    def _on_accepted(self, handle: ServerGoalHandle) -> None:
        handle.execute()
        self._events.on_plan(Goal(handle=handle))

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        self._events.start_waiting()  # it may have come with the goal
        for rollout, goal in self._goals.items():
            if goal.handle == handle:
                self._events.give_up(rollout, 'cancelled by its client')
                return CancelResponse.ACCEPT
        return CancelResponse.REJECT

    def _follow(self, goal: Goal, chunk: Chunk) -> None:
        """Publish the feedback of a chunk and hold it to the goal's tolerances."""
        prediction, request, plan = chunk.prediction, chunk.request, chunk.plan
        path, offset_s = plan.trajectory, (plan.given_ns - plan.stamp_ns) / NANO
        times, actual = prediction.video.times, prediction.positions
        if prediction.chunk == 0:  # where the robot is when the plan begins
            times = np.concatenate([[0.0], times])
            actual = np.vstack([plan.start_positions, actual])
        desired = plan.positions_at(times)
        is_over = prediction.chunk == prediction.num_chunks - 1
        goal.violation = _violation(
            'PATH', goal.handle.request.path_tolerance, path.joint_names, desired, actual
        ) or (
            _violation(
                'GOAL', goal.handle.request.goal_tolerance, path.joint_names,
                path.positions[-1:], actual[-1:],
            ) if is_over else None
        )  # fmt: skip
        time_s, names = float(times[-1]), self._robot.joint_names
        moved = [at for at, name in enumerate(names) if name in plan.given.joint_names]
        feedback = self._action.Feedback(
            header=make_header(prediction.stamp_ns + round(time_s * NANO)),
            joint_names=[names[column] for column in moved],
            desired=_point(desired[-1, moved], time_s - offset_s),
            actual=_point(actual[-1, moved], time_s - offset_s),
            error=_point((desired - actual)[-1, moved], time_s - offset_s),
        )
        goal.handle.publish_feedback(feedback)
        if goal.violation:
            self._events.give_up(request.rollout, goal.violation[1])

    def _outcome(self, goal: Goal, ended: Ended) -> tuple[str, str, str]:
        """Return the goal's last event, the name of its code, and why in words."""
        verdict = _verdict(ended)
        if goal.violation:
            code, text = goal.violation
            return 'abort', code, f'{text}; {verdict}'
        if ended.state == 'done':
            least = self._events.settings().least_goal_success
            probability = ended.success.probability if ended.success else float('nan')
            if least and not probability >= least:
                text = f"'least_goal_success' asks for {least:g}"
                return 'abort', 'GOAL_TOLERANCE_VIOLATED', f'{verdict}; {text}'
            return 'succeed', 'SUCCESSFUL', verdict
        why = ended.text or _WHY.get(ended.state, ended.state)
        if goal.handle.is_cancel_requested:
            return 'canceled', 'SUCCESSFUL', f'{why}; {verdict}'
        return 'abort', _code(ended.reason), f'{why}; {verdict}'

    def _conclude(self, goal: Goal, event: str, code: str, text: str) -> None:
        result = self._action.Result(error_code=getattr(self._action.Result, code))
        result.error_string = text

        def conclude(handle: ServerGoalHandle) -> Any:
            getattr(handle, event)()
            return result

        self._server.conclude(goal.handle, conclude)


class _Server(ActionServer):
    """An action server whose goals end by `conclude`.

    rclpy's own way, a coroutine that waits, keeps the executor busy.

    Attributes:
        refuse: called with a goal that has too many points or tolerances to be read.
    """

    refuse: Callable[[RefusedRequest], None]

    def __init__(self, node: Node, action: Any, name: str, **callbacks: Any) -> None:
        super().__init__(node, action, name, **callbacks)
        self._action_type = bounded_action(action, limits().trajectory_points)

    async def _execute_goal_request(self, taken: Any) -> None:
        header, request = taken
        if not isinstance(request, RefusedRequest):
            await super()._execute_goal_request(taken)
            return
        self.refuse(request)
        response = self._action_type.Impl.SendGoalService.Response(accepted=False)
        with suppress(rclpy_implementation.RCLError):  # the client may have gone away
            self._handle.send_goal_response(header, response)

    def notify_execute(self, goal_handle: ServerGoalHandle, execute_callback: Any) -> None:
        """Do nothing yet."""

    def conclude(self, handle: ServerGoalHandle, conclude: Callable[[Any], Any]) -> None:
        """Run what sets the goal's last state and return its result."""
        super().notify_execute(handle, conclude)

    def _send_result_response(self, request_header: Any, future: Any) -> None:
        with suppress(InvalidHandle):  # closed before it was sent
            super()._send_result_response(request_header, future)


def find_action() -> Any:
    """Return the type of the action; None = control_msgs is not installed."""
    try:
        return importlib.import_module('control_msgs.action').FollowJointTrajectory
    except ImportError:
        return None


#: why a plan ended that has no text of its own
_WHY = {
    'preempted': 'pre-empted by a newer plan',
    'reset': 'the node was reset',
}


def _code(reason: Reason | None) -> str:
    """Name of the code for a plan that was refused or failed."""
    if reason is Reason.JOINT_NAMES:
        return 'INVALID_JOINTS'
    return 'OLD_HEADER_TIMESTAMP' if reason is Reason.TRAJECTORY_STALE else 'INVALID_GOAL'


def _verdict(ended: Ended) -> str:
    """Return the state of the plan of a goal."""
    success, last = ended.success, ended.last
    known = 'nothing was imagined'
    if last is not None:
        known = f'{ended.num_chunks} of {last.prediction.num_chunks} chunks imagined'
    if success is None:
        return known
    reasons = '; '.join(success.reasons)
    if isnan(success.probability):
        return f'{known}; {reasons}'
    low, high = success.interval
    return f'{known}; success {success.probability:.2f} ({low:.2f} to {high:.2f}): {reasons}'


def _violation(
    kind: str, tolerances: Any, names: tuple[str, ...], desired: FloatArray, actual: FloatArray
) -> tuple[str, str] | None:
    """Name of the code and text of the first tolerance on a position that is violated."""
    for tolerance in tolerances:
        column = names.index(tolerance.name)
        far = float(np.abs(desired[:, column] - actual[:, column]).max())
        if 0 < tolerance.position < far - _ROUNDING:
            text = (
                f"joint '{tolerance.name}' is {far:.4f} from the {kind.lower()}; "
                f'{kind.lower()}_tolerance allows {tolerance.position:g} (rad or m)'
            )
            return f'{kind}_TOLERANCE_VIOLATED', text
    return None


def _point(positions: FloatArray, seconds: float) -> JointTrajectoryPoint:
    sec, nanosec = divmod(max(0, round(seconds * NANO)), NANO)
    return JointTrajectoryPoint(
        positions=[float(x) for x in positions],
        time_from_start=Duration(sec=sec, nanosec=nanosec),
    )


def _refuse(request: RefusedRequest) -> None:
    raise Rejection(Reason.MESSAGE_TOO_LARGE, f'{NAME}: {request}')


def _never(_: ServerGoalHandle) -> None:
    """Goals end by `conclude`."""
    raise AssertionError
