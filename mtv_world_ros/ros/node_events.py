"""Events of a configured node: one object that its parts report to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMsg

from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.ros.parameters import LiveSettings, Settings
from mtv_world_ros.ros.world_model.chunk_outcomes import ScoredChunk, Sent
from mtv_world_ros.ros.world_model.goal import Goal
from mtv_world_ros.ros.world_model.worker import Chunk, Ended


class SensingEvents(Protocol):
    """Events of a node that takes the robot's description and TF."""

    def settings(self) -> LiveSettings:
        """Return the present parameters."""
        ...

    def guarded(self, handle: Callable[..., None]) -> Callable[..., None]:
        """Return a callback that counts exceptions of the handler and does not raise."""
        ...

    def on_robot(self, robot: RobotModel) -> None:
        """Use the kinematics and limits of the robot's own description."""
        ...


class NodeEvents(SensingEvents, Protocol):
    """Events of a node; see `ConfiguredNode`. All but `on_results` come from the executor."""

    def settings(self) -> Settings:
        """Return the present parameters."""
        ...

    def on_image(self, view: str, message: Image | CompressedImage) -> None:
        """Take a real image that was stored."""
        ...

    def on_instruction(self, message: String) -> None:
        """Take the instruction."""
        ...

    def on_objects(self, message: String) -> None:
        """Take the names of the objects."""
        ...

    def on_plan(self, plan: JointTrajectoryMsg | Goal, transport_s: float = 0.0) -> None:
        """Take a plan from topic or action, with its transport delay [s]."""
        ...

    def on_refused_plan(self, error: Exception, stamp_ns: int) -> None:
        """Answer a plan of the topic that was refused before it was decoded."""
        ...

    def on_results(self) -> None:
        """Note that the worker has results; called from any thread."""
        ...

    def on_judged(self, chunk: Chunk) -> None:
        """Take a chunk whose estimate is out."""
        ...

    def on_sent(self, chunk: Chunk, sent: Sent) -> None:
        """Take a chunk whose last frame is out, or whose rest was dropped."""
        ...

    def on_ended(self, ended: Ended) -> None:
        """Take the end of a plan, after the estimates of its chunks."""
        ...

    def on_scored(self, scored: ScoredChunk) -> None:
        """Take a chunk that was compared with the real frames."""
        ...

    def on_error(self, error: Exception) -> None:
        """Report an unexpected exception."""
        ...

    def start_waiting(self) -> None:
        """Start the plans that wait."""
        ...

    def give_up(self, rollout: int, text: str) -> None:
        """Pre-empt one plan, by the number of its rollout, for a reason in words."""
        ...


def ignore_sent(chunk: Any, sent: Any) -> None:
    """Ignore frames: the default callback."""
