"""The lifecycle node `world_model`: parameters, states and diagnostics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import gc
import sys
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.ros import parameters
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.run_node import run
from mtv_world_ros.ros.sensing.subscriptions import OWN_PATHS
from mtv_world_ros.ros.world_model.configured_node import ConfiguredNode
from mtv_world_ros.ros.world_model.loading import load_named_pipeline
from mtv_world_ros.ros.world_model.loading_watch import LoadingWatch, WaitingLog
from mtv_world_ros.ros.world_model.reporter import Reporter

Load = Callable[[Settings], Pipeline]


class WorldModelNode(LifecycleNode):
    """Lifecycle node: loads the model when configured, answers plans while active.

    Args:
        load: function that returns the pipeline of the parameters.
        context: ROS context of the node; default: the process' own.

    Raises:
        MtvWorldError: a parameter cannot be used.
    """

    def __init__(self, load: Load = load_named_pipeline, context: Context | None = None) -> None:
        super().__init__('world_model', context=context)
        parameters.declare(self, Settings)
        self._settings, self._load = parameters.read(self, Settings), load
        self.add_post_set_parameters_callback(self._on_parameters)
        self._change_state: Any = self._service_change_state.callback
        self._service_change_state.callback = self._on_change_state  # type: ignore[assignment]
        self._configured: ConfiguredNode | None = None
        self._error: Exception | None = None
        self._is_starting = False
        self._loading = ''
        self._waits = WaitingLog(self.get_logger())
        self._reporter = Reporter(self, self.settings, self._state, self._missing)
        self.create_timer(
            self._settings.diagnostics_period_s,
            self._reporter.guarded(self._on_period),
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )

    def settings(self) -> Settings:
        """Return the present parameters."""
        return self._settings

    def start(self) -> None:
        """Configure and activate the node, unless a lifecycle manager is to do that.

        Raises:
            MtvWorldError: a parameter, the checkpoint or a file it names cannot be used.
        """
        if not self._settings.autostart:
            self.get_logger().info('unconfigured: waits for a lifecycle manager')
            return
        self._is_starting = True
        configured = self.trigger_configure()
        self._is_starting = False
        if configured != TransitionCallbackReturn.SUCCESS and self._error:
            raise self._error
        self.trigger_activate()

    def close(self) -> None:
        """End the threads and the node."""
        self._release()
        self.destroy_node()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the model; where that fails, says why and stays unconfigured."""
        self._error, self._loading = None, ''
        try:
            with LoadingWatch(self, f"'{self._settings.checkpoint}'", self._on_loading) as watch:
                pipeline = self._load(self._settings)
                self._reporter.name_robot(pipeline.robot.name)
                self._configured = ConfiguredNode(self, pipeline, self.settings, self._reporter)
                parameters.refuse_unknown(self)
                self._configured.take_early(watch.take())
        except Exception as error:
            self._release()
            self._error = error
            if not self._is_starting:  # then the process ends with the error
                self._say(error)
                self._reporter.publish_diagnostics()
            return TransitionCallbackReturn.FAILURE
        finally:
            self._loading = ''
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take plans from now on."""
        assert self._configured is not None
        self._configured.activate()
        self.get_logger().info(f'ready: {self._configured.description}')
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Pre-empt the plan that runs and refuse others."""
        assert self._configured is not None
        self._configured.deactivate()
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Free the memory of the model at once."""
        self._release()
        gc.collect()  # parts of the model refer to each other
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Pre-empt the plan that runs; the model is freed once its end was reported."""
        if self._configured is not None:
            self._configured.deactivate()
        return TransitionCallbackReturn.SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Free the model after a transition raised; the node can be configured again."""
        self._release()
        return TransitionCallbackReturn.SUCCESS

    def _on_change_state(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        """Refuse a transition that the present state does not have; rclpy would raise."""
        offered = [transition[0] for transition in self._state_machine.available_transitions]
        if not request.transition.label and request.transition.id not in offered:
            self.get_logger().warning(
                f'no transition {request.transition.id} in the state {self._lifecycle()}'
            )
            response.success = False
            return response
        return self._change_state(request, response)

    def _say(self, error: Exception) -> None:
        if isinstance(error, MtvWorldError):
            self.get_logger().error(f'not configured: {type(error).__name__}: {error}')
        else:
            self._reporter.crash(error)

    def _on_loading(self, text: str) -> None:
        """Say what is loaded, in the log and in `/diagnostics`; called from another thread."""
        self._loading = text
        self.get_logger().info(text)
        self._reporter.publish_diagnostics()

    def _release(self) -> None:
        if self._configured is not None:
            self._configured.close()
            self._configured = None

    def _on_parameters(self, _: object) -> None:
        self._settings = parameters.read(self, Settings)

    def _on_period(self) -> None:
        if self._lifecycle() == 'finalized':
            self._release()
        if self._configured is not None:
            self._configured.refresh()
        if self._configured is not None and self._lifecycle() == 'active':
            self._waits.update(self._configured.missing(), self._configured.has_begun)
        self._reporter.publish_diagnostics()

    def _lifecycle(self) -> str:
        """Name of the present state, such as `active`."""
        return self._state_machine.current_state[1]

    def _missing(self) -> Sequence[str]:
        """Return the reason why the node takes no plans."""
        if self._error is not None:
            return [f'not configured: {self._error}']
        if self._loading:
            return [self._loading]
        if self._configured is None or self._lifecycle() != 'active':
            return [f'the node is {self._lifecycle()}']
        return self._configured.missing()

    def _state(self) -> Mapping[str, object]:
        state = self._configured.state() if self._configured is not None else {'policies': 0}
        return {'lifecycle': self._lifecycle(), **state}


def main(args: Sequence[str] | None = None, load: Load = load_named_pipeline) -> int:
    """Run the node; return the exit status."""

    def make() -> WorldModelNode:
        node = WorldModelNode(load)
        node.start()
        return node

    return run(
        make,
        args,
        help_text=parameters.help_text('world_model', Settings),
        name='world_model',
        own_paths=OWN_PATHS,
    )


if __name__ == '__main__':
    sys.exit(main())
