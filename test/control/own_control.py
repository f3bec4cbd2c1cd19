"""A control from outside the package, for tests: pixels of the tools, a vector a frame."""

from dataclasses import dataclass

import numpy as np

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.control.control import Control, ControlInputs, FrameInput, InputLayout


@dataclass(frozen=True)
class ToolPixels(Control):
    """Image positions of all tools in all views, with the trajectory video left out."""

    num_numbers: int

    @classmethod
    def create(cls, options):
        return cls(num_numbers=2 * len(options.robot.tools))

    @property
    def layout(self):
        return InputLayout(frame=FrameInput(vector_size=self.num_numbers, hidden_size=16))

    def make(self, scene):
        motion, camera = scene.motion, scene.motion.cameras[0]
        pixels, _ = project(camera, motion.camera_poses[0], motion.tool_points)
        size = np.array([camera.width, camera.height])
        numbers = np.clip(pixels / size, -1, 2).swapaxes(0, 1).reshape(len(scene.times), -1)
        return ControlInputs(num_frames=len(scene.times) - 1, frame=numbers.astype(np.float32))
