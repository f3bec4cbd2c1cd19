"""Pose of a camera that stands still, from one recording in which the arm moves."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.errors import CalibrationError
from mtv_world_ros.data.episode import Track
from mtv_world_ros.inspection.camera_pose import (
    CameraEstimate,
    jackknife_errors,
    left_out,
    UNITS,
    with_pose,
)
from mtv_world_ros.inspection.cameras.camera_set import CameraSet
from mtv_world_ros.inspection.cameras.outlines import Changes, ImageStage, Outlines
from mtv_world_ros.inspection.cameras.solver import CameraState, linearize, Unknowns
from mtv_world_ros.inspection.clocks import JointTrack
from mtv_world_ros.inspection.places import CameraPlaces
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import LinkShape

#: number of frames that are compared
_NUM_FRAMES = 24
#: directions in which a part's outermost points are drawn
_NUM_CORNERS = 48
#: search without a guess: number of best candidates that are fitted to the end
_NUM_STARTS = 3
#: first fits of each start
_FIRST_STAGES = (ImageStage(120, 5.0), ImageStage(120, 2.0))
#: fits of a pose that is nearly right, along the directions in which poses look alike
_NEAR_STAGES = (ImageStage(160, 1.0), ImageStage(160, 1.0))
#: last fit, whose residuals give the standard error
_FINE_STAGE = ImageStage(240, 1.5)
#: measurements that the pixels of all frames are worth
_NUM_INDEPENDENT = 12
#: correlation below which a found pose explains the pictures no better than chance
_LEAST_FIT = 0.45


class FixedCamera:
    """Estimator of the camera pose of one view.

    Args:
        track: frames of the view.
        camera: intrinsics of the camera; its pose is the guess, if there is one.
        robot: robot whose link poses are drawn.
        shapes: shapes of the links.
        joints: measured joint positions.

    Raises:
        CalibrationError: the arm does not move, or too few frames are within the joint states.
    """

    def __init__(
        self,
        track: Track,
        camera: CameraModel,
        robot: RobotModel,
        shapes: Sequence[LinkShape],
        joints: JointTrack,
    ) -> None:
        self.camera = camera
        self._outlines = Outlines(
            track, camera, robot, shapes, joints, num_frames=_NUM_FRAMES, num_corners=_NUM_CORNERS
        )
        place = CameraPlaces(place=np.zeros(1, np.int64), apart=np.zeros((1, 1)), matches={})
        self._set = CameraSet([self._outlines], [place])

    @property
    def centre(self) -> FloatArray:
        """Mean position of the moving links (3,) in the base link [m]."""
        return self._outlines.centre

    def estimate(
        self,
        *,
        guess: bool = True,
        seed: int = 0,
        progress: Callable[[Iterable[Any]], Iterable[Any]] = iter,
    ) -> CameraEstimate:
        """Estimate the pose, in the robot's base link.

        Args:
            guess: start from the camera's pose; False = from cameras all around the robot.
            seed: seed of the cameras that are tried.
            progress: wraps what is tried, e.g. in a progress bar.

        Raises:
            CalibrationError: no pose explains the pictures.
        """
        starts = [CameraState(poses={0: self.camera.T_mount_camera})]
        if not guess:
            starts = self._set.around(0, seed, progress)[:_NUM_STARTS]
        ends = [self._set.refined(start, _FIRST_STAGES, 15)[0] for start in progress(starts)]
        state = max(ends, key=lambda end: float(self._set.fits(end, _FIRST_STAGES[-1])[0]))
        state, _ = self._set.refined(state, _NEAR_STAGES, 25, scaled=True, whiten=True)
        state, _ = self._set.refined(state, (_FINE_STAGE,), 15)
        T = state.poses[0]
        fine = self._outlines.read(_FINE_STAGE, T, state.lens)
        fit = self._outlines.fit(T, state.lens, fine)
        if fit < _LEAST_FIT:
            raise CalibrationError(
                f"view '{self.camera.view}': no pose was found at which the drawn robot moves "
                f'like the pictures (correlation {fit:.2f}); is it the right robot, K and clock, '
                'and does the arm move through the view? A guess nearer to the truth may help'
            )
        std_mm, std_deg = self._standard_errors(T, fine)
        return CameraEstimate(
            camera=with_pose(self.camera, T),
            std_mm=std_mm,
            std_deg=std_deg,
            evidence=f'correlation of drawn and seen motion {fit:.2f} over {len(fine.pairs)} '
            'pairs of frames',
            match=fit,
        )

    def _standard_errors(self, T: FloatArray, changes: Changes) -> tuple[float, float]:
        """Return the standard errors of the camera's position [mm] and direction [degrees].

        Errors of the shapes, shadows and the robot's own pattern are the same for a whole link
        in all frames, so that pixels say much less than their number: they are counted as few
        independent measurements, and the pose's changes without one link at a time are added.
        """
        residual = self._outlines.residual(0, changes)
        errors, weights, slopes = linearize(residual, T, np.zeros(3), Unknowns(centre=self.centre))
        normal = np.asarray((weights * slopes) @ slopes.T, np.float64)
        variance = float((weights * errors**2).sum()) / _NUM_INDEPENDENT
        at_centre = np.diag(UNITS) @ np.linalg.pinv(normal) @ np.diag(UNITS) * variance
        moves = np.eye(6)  # turns about the centre shift the camera
        away = T[:3, :3].T @ (T[:3, 3] - self.centre)
        x, y, z = away
        moves[3:, :3] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
        at_camera = moves @ at_centre @ moves.T
        shift, turn = np.trace(at_camera[3:, 3:]), np.trace(at_camera[:3, :3])
        without = []
        for part in self._outlines.pixels_of_links(T, changes):
            weighted = weights[part] * slopes[:, part]
            less = np.asarray(weighted @ slopes[:, part].T, np.float64)
            gradient = np.asarray(weighted @ errors[part], np.float64)
            without.append(moves @ left_out(normal, less, gradient))
        mm, degrees = jackknife_errors(np.array(without)) if len(without) > 1 else (0.0, 0.0)
        return (
            float(np.hypot(1000 * np.sqrt(shift), mm)),
            float(np.hypot(np.degrees(np.sqrt(turn)), degrees)),
        )
