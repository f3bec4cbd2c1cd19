"""Where the tool points fall in a view, and joint positions against their limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtv_world_ros.data_types import CameraModel, FloatArray
from mtv_world_ros.geometry.camera import camera_poses, project
from mtv_world_ros.geometry.robot import RobotModel
from mtv_world_ros.inspection.report import broken, Finding, suspicious

#: share of the frames in which at least one tool should be in the image
_LEAST_IN_IMAGE = 0.5
#: recorded joint states overshoot by this much [rad or m]
_LIMIT_TOLERANCE = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class ToolVisibility:
    """Shares of the frames, for each arm (A,).

    Attributes:
        behind: the tool point is not in front of the camera.
        outside: it is in front of the camera but not in the image.
    """

    behind: FloatArray
    outside: FloatArray


def tool_visibility(
    camera: CameraModel, robot: RobotModel, positions: FloatArray
) -> ToolVisibility:
    """Counts where the tool points fall for positions (T, J)."""
    points = robot.tool_poses(positions)[..., :3, 3]
    pixels, depth = project(camera, camera_poses(camera, robot, positions), points)
    behind = depth <= 0
    size = np.array([camera.width, camera.height])
    inside = ((pixels >= -0.5) & (pixels <= size - 0.5)).all(axis=-1)  # NaN is not inside
    return ToolVisibility(behind=behind.mean(axis=1), outside=(~inside & ~behind).mean(axis=1))


def check_visibility(
    camera: CameraModel, robot: RobotModel, positions: FloatArray
) -> tuple[dict[str, str], list[Finding]]:
    """Shares of tool points behind the camera and off the image, and what they mean."""
    seen = tool_visibility(camera, robot, positions)
    measures = {
        f"tool '{tool.arm}'": f'{seen.behind[i]:.0%} behind the camera, '
        f'{seen.outside[i]:.0%} off the image'
        for i, tool in enumerate(robot.tools)
    }
    best = float((1 - seen.behind - seen.outside).max())
    fixed = camera.mount_link == robot.base_link
    if fixed and seen.behind.min() > 0.5:
        return measures, [
            broken(
                'every tool is behind the camera most of the time: is T_mount_camera inverted, '
                'or does its z axis not point ahead?'
            )
        ]
    if best == 0:
        return measures, [broken('no tool is ever in the image')]
    if best < _LEAST_IN_IMAGE:
        return measures, [suspicious(f'no tool is in the image in more than {best:.0%} of frames')]
    return measures, []


def check_limits(
    what: str, robot: RobotModel, positions: FloatArray
) -> tuple[dict[str, str], list[Finding]]:
    """Positions (T, J) against the robot's limits, one finding a joint."""
    beyond = np.maximum(robot.lower - positions, positions - robot.upper)
    share = (beyond > _LIMIT_TOLERANCE).mean(axis=0)
    findings = []
    for joint in np.flatnonzero(share):
        row = int(beyond[:, joint].argmax())
        text = (
            f"{what}: joint '{robot.joint_names[joint]}' is outside its limits "
            f'{robot.lower[joint]:.4g} .. {robot.upper[joint]:.4g} in {share[joint]:.1%} of the '
            f'rows, at worst {positions[row, joint]:.4g} (degrees, another zero or sign, or '
            'another gripper range?)'
        )
        findings.append(broken(text) if share[joint] > 0.2 else suspicious(text))
    if not np.isfinite(positions).all():
        findings.append(broken(f'{what}: some positions are not finite'))
    counted = f'{int((share > 0).sum())} of {len(share)} joints leave theirs'
    return {f'limits, {what}': counted}, findings
