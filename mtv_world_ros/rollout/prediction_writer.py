"""Predictions as a rosbag2 MCAP folder, under the topics of the node."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import ByteArray, CameraModel, JointTrajectory, ObjectMasks
from mtv_world_ros.core.images import encode_jpeg
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.writer import BagWriter
from mtv_world_ros.data.episode import optical_frame
from mtv_world_ros.rollout.prediction import Prediction

NODE = '/world_model'
FLOAT64 = 'std_msgs/msg/Float64'
ARRAY = 'std_msgs/msg/Float32MultiArray'
DIAGNOSTICS = 'diagnostic_msgs/msg/DiagnosticArray'
_JPEG_QUALITY = 90
#: levels of diagnostic_msgs/DiagnosticStatus
OK = 0
ERROR = 2


class PredictionWriter(BagWriter):
    """Writer of chunks into a bag: images, masks, joint states, estimates, at predicted times.

    Real frames of the same times are recorded with them where they are known.

    Args:
        path: folder to make; it has a temporary name until the block ends.
        joint_names: J names, in the robot's order.
        overwrite: replace an existing folder.
        keep: keep what was recorded before an error, see `BagWriter`.

    Attributes:
        frame_stamps: stamps of the recorded frames [ns].
    """

    def __init__(
        self,
        path: Path | str,
        joint_names: Sequence[str],
        *,
        overwrite: bool = False,
        keep: bool = False,
    ) -> None:
        super().__init__(path, overwrite=overwrite, keep=keep)
        self._joint_names = tuple(joint_names)
        self.frame_stamps: list[int] = []

    def write_chunk(self, prediction: Prediction, until_ns: int | None = None) -> int:
        """Record a chunk's frames, those up to `until_ns` alone; return how many.

        The estimate is recorded at the chunk's last frame, if that is among them.
        """
        times = prediction.video.times
        stamps = [prediction.stamp_ns + round(float(time) * 1e9) for time in times]
        kept = [
            index for index, stamp in enumerate(stamps) if until_ns is None or stamp <= until_ns
        ]
        for index in kept:
            self._write_frame(prediction, index, stamps[index])
            self.frame_stamps.append(stamps[index])
        if len(kept) == len(stamps):
            self._write_estimate(prediction, stamps[-1])
        return len(kept)

    def write_observed(self, camera: CameraModel, stamp_ns: int, rgb: ByteArray) -> None:
        """Record what a camera really showed, (H, W, 3) uint8 RGB, under its own topic."""
        self._write_jpeg(f'/{camera.view}', camera, stamp_ns, rgb)

    def write_plan(self, stamp_ns: int, trajectory: JointTrajectory) -> None:
        """Record a policy's answer; its times count from the stamp."""
        message = messages.make_joint_trajectory(stamp_ns, trajectory)
        self.write_message('/joint_trajectory', messages.JOINT_TRAJECTORY, stamp_ns, message)

    def write_instruction(self, stamp_ns: int, text: str) -> None:
        """Record the instruction of an episode."""
        message = messages.make(messages.STRING, data=text)
        self.write_message('/instruction', messages.STRING, stamp_ns, message)

    def write_report(
        self, stamp_ns: int, level: int, text: str, values: Mapping[str, Any]
    ) -> None:
        """Record a line of `~/report`."""
        pairs = [
            messages.make('diagnostic_msgs/msg/KeyValue', key=key, value=_text(value))
            for key, value in values.items()
        ]
        status = messages.make(
            'diagnostic_msgs/msg/DiagnosticStatus',
            level=level,
            name='world_model: rollout',
            message=text,
            hardware_id='',
            values=pairs,
        )
        header = messages.make_header(stamp_ns, '')
        report = messages.make(DIAGNOSTICS, header=header, status=[status])
        self.write_message(f'{NODE}/report', DIAGNOSTICS, stamp_ns, report)

    def _write_frame(self, prediction: Prediction, index: int, stamp_ns: int) -> None:
        for number, camera in enumerate(prediction.start.cameras):
            base = f'{NODE}/{camera.view}'
            frame = prediction.video.frames[number, index]
            control = prediction.trajectory_video.frames[number, index + 1]
            self._write_jpeg(f'{base}/predicted', camera, stamp_ns, frame)
            self._write_jpeg(f'{base}/trajectory', camera, stamp_ns, control)
            self._write_labels(f'{base}/mask', camera, stamp_ns, prediction.masks, number, index)
        state = messages.make_joint_state(stamp_ns, self._joint_names, prediction.positions[index])
        self.write_message(f'{NODE}/predicted/joint_states', messages.JOINT_STATE, stamp_ns, state)

    def _write_jpeg(self, base: str, camera: CameraModel, stamp_ns: int, rgb: ByteArray) -> None:
        frame_id = optical_frame(camera.view)
        image = messages.make_compressed(stamp_ns, frame_id, encode_jpeg(rgb, _JPEG_QUALITY))
        topic = f'{base}/image_raw/compressed'
        self.write_message(topic, messages.COMPRESSED_IMAGE, stamp_ns, image)
        info = messages.make_camera_info(stamp_ns, camera, frame_id)
        self.write_message(f'{base}/camera_info', messages.CAMERA_INFO, stamp_ns, info)

    def _write_labels(
        self,
        base: str,
        camera: CameraModel,
        stamp_ns: int,
        masks: ObjectMasks,
        view: int,
        index: int,
    ) -> None:
        labels = np.zeros(masks.masks.shape[-2:], np.uint8)
        for item, mask in enumerate(masks.masks[view, :, index], start=1):
            labels[mask] = item
        image = messages.make_image(stamp_ns, optical_frame(camera.view), labels)
        self.write_message(f'{base}/image_raw', messages.IMAGE, stamp_ns, image)

    def _write_estimate(self, prediction: Prediction, stamp_ns: int) -> None:
        success = prediction.success
        value = messages.make(FLOAT64, data=float(success.probability))
        self.write_message(f'{NODE}/success', FLOAT64, stamp_ns, value)
        labels = (
            f'view: {", ".join(prediction.video.views)}',
            f'object: {", ".join(prediction.masks.names)}',
        )
        self.write_message(f'{NODE}/jaccard', ARRAY, stamp_ns, _array(success.jaccard, labels))


def chunk_values(chunk: Prediction) -> dict[str, object]:
    """Return the keys and values of a predicted chunk in `~/report`."""
    return {
        'chunk': chunk.chunk,
        'num_chunks': chunk.num_chunks,
        'chunk_seed': chunk.seed,
        'observation_stamp_ns': chunk.stamp_ns,
        'success': chunk.success.probability,
        'success_low': chunk.success.interval[0],
        'success_high': chunk.success.interval[1],
        'success_trust': chunk.success.trust,
        'success_reasons': chunk.success.reasons,
        **{f'stage_s.{stage}': seconds for stage, seconds in chunk.seconds.items()},
    }


def _array(values: np.ndarray, labels: Sequence[str]) -> Any:
    """Return the row-major std_msgs/Float32MultiArray, one label a dimension."""
    dimensions = [
        messages.make(
            'std_msgs/msg/MultiArrayDimension',
            label=label,
            size=values.shape[axis],
            stride=int(np.prod(values.shape[axis:])),
        )
        for axis, label in enumerate(labels)
    ]
    layout = messages.make('std_msgs/msg/MultiArrayLayout', dim=dimensions, data_offset=0)
    return messages.make(ARRAY, layout=layout, data=np.ravel(values).astype(np.float32))


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f'{value:.6g}'
    return '; '.join(map(str, value)) if isinstance(value, list | tuple) else str(value)
