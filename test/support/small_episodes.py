"""Small episodes with a red block that moves and a blue one that does not, and what reads them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest

from mtv_world_ros.control.trajectory_video import TrajectoryVideo, TrajectoryVideoConfig
from mtv_world_ros.core.data_types import ByteArray, CameraModel, JointTrajectory, WorldModelSpec
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode_writer import EpisodeWriter
from mtv_world_ros.data.recording import load_recording, Recording
from mtv_world_ros.model.card import read_card
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.rollout.pipeline import Pipeline, WorldModel
from mtv_world_ros.rollout.success_judge import SuccessJudge
from mtv_world_ros.success.estimator import load_tasks, SuccessEstimator
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter, PALETTE
from test.support.pipelines import assembled

HEIGHT, WIDTH, NUM_FRAMES = 48, 64, 19
START_NS, PERIOD_NS = 1_700_000_000_000_000_000, 100_000_000
OBJECTS = ('red block', 'blue block')
INSTRUCTION = 'place the red block to the left of the blue block'
SPEC = WorldModelSpec(
    views=('low', 'high'), fps=5, num_frames=4, width=64, height=48, robot='yam_bimanual'
)


class PersistenceWorldModel:
    """Predicts that nothing ever changes: repeats the start frame T times."""

    def __init__(self, spec):
        self.spec = spec

    def predict(self, start_frame, control, **_):
        return np.repeat(start_frame[:, None], control.num_frames, axis=1)


def camera(view: str) -> CameraModel:
    """A camera above the table that looks down, the two a hand apart."""
    pose = np.array([[-1, 0, 0, 0], [0, 1, 0, 0.5], [0, 0, -1, 1.0], [0, 0, 0, 1]], float)
    pose[0, 3] = 0.2 if view == 'high' else -0.2
    return CameraModel(
        view=view,
        width=WIDTH,
        height=HEIGHT,
        K=np.array([[70, 0, 31.5], [0, 70, 23.5], [0, 0, 1]]),
        mount_link='base',
        T_mount_camera=pose,
    )


def scene(shift: float, view: str, grey: int) -> tuple[ByteArray, ByteArray]:
    """Frame and object identities; the red block is `shift` px right of its start."""
    frame = np.full((HEIGHT, WIDTH, 3), (grey, grey - 2, grey - 5), np.uint8)
    ids = np.zeros((HEIGHT, WIDTH), np.uint8)
    row = 12 if view == 'low' else 16
    for index, (name, column) in enumerate(zip(OBJECTS, (6 + round(shift), 46), strict=True)):
        place = np.s_[row : row + 10, column : column + 10]
        frame[place] = PALETTE[name.split()[0]]
        ids[place] = index + 1
    return frame, ids


@pytest.fixture(scope='session')
def make_episode(robot) -> Callable[..., Path]:
    """Record an episode of 19 frames at 10 Hz; the red block moves `speed` px a frame."""
    middle = (robot.lower + robot.upper) / 2
    first = np.arange(len(middle)) == 0

    def make(
        path: Path,
        *,
        speed: float = 1.0,
        grey: int = 170,
        reach: float = 0.1,
        starts: tuple[int, ...] = (0,),
        offset: float = 0.0,
        outcome: str = 'success',
        objects: tuple[str, ...] = OBJECTS,
        instruction: str = INSTRUCTION,
        task: str = 'place_block_a2b_left',
        metadata: Mapping[str, str] | None = None,
    ) -> Path:
        cameras = [camera(view) for view in SPEC.views]
        with EpisodeWriter(
            path,
            task=task,
            instruction=instruction,
            robot=robot.name,
            cameras=cameras,
            objects=objects,
            metadata=metadata,
        ) as writer:
            writer.write_instruction(START_NS)
            for start in starts:
                times = np.arange(1, NUM_FRAMES - start) / 10
                positions = np.repeat(middle[None], len(times), axis=0)
                positions[:, 0] += reach * np.sin(times) + offset
                writer.write_trajectory(
                    START_NS + start * PERIOD_NS,
                    JointTrajectory(
                        joint_names=robot.joint_names, times=times, positions=positions
                    ),
                )
            for index in range(NUM_FRAMES):
                stamp = START_NS + index * PERIOD_NS
                for model in cameras:
                    frame, ids = scene(speed * index, model.view, grey)
                    writer.write_image(model.view, stamp, frame, compressed=False)
                    if objects:
                        writer.write_mask(model.view, stamp, ids)
                    writer.write_camera_info(model.view, stamp, model)
                writer.write_joint_states(stamp, robot.joint_names, middle + offset * first)
            writer.outcome = outcome
        return path

    return make


@pytest.fixture(scope='session')
def episodes(tmp_path_factory, make_episode) -> list[Path]:
    """Three episodes with different speeds and reaches."""
    folder = tmp_path_factory.mktemp('episodes')
    return [
        make_episode(
            folder / f'episode_{k}',
            speed=speed,
            grey=160 + 10 * k,
            reach=0.1 * (k + 1),
            outcome=outcome,
        )
        for k, (speed, outcome) in enumerate(
            [(1.0, 'success'), (1.3, 'failure'), (1.6, 'success')]
        )
    ]


@pytest.fixture(scope='session')
def recordings(episodes, robot) -> list[Recording]:
    """The same, read."""
    return [load_recording(path, SPEC, robot) for path in episodes]


@pytest.fixture(scope='session')
def make_pipeline(robot) -> Callable[..., Pipeline]:
    """A pipeline around a world model; by default the one that repeats the start frame."""

    def make(world_model: WorldModel | None = None, **options: object) -> Pipeline:
        segmenter = ColourSegmenter()
        estimator = SuccessEstimator(load_tasks(share_path('config', 'tasks')))
        return Pipeline(
            robot=robot,
            world_model=world_model or PersistenceWorldModel(SPEC),
            segmenter=segmenter,
            judge=SuccessJudge(robot=robot, estimator=estimator),
            control=TrajectoryVideo(config=TrajectoryVideoConfig()),
            **options,  # type: ignore[arg-type]
        )

    return make


class OracleWorldModel:
    """Returns what was recorded after the start frame; under other actions, the start frame.

    The first trajectory video that comes with a start frame is taken for the true one.
    """

    def __init__(self, recordings: list[Recording], blur: float = 0.0) -> None:
        self.spec = SPEC
        self.num_calls = 0
        self._recordings = recordings
        self._blur = blur
        self._true: dict[bytes, bytes] = {}

    def predict(self, start_frame, control, **_):
        """See `pipeline.WorldModel.predict`."""
        self.num_calls += 1
        key, drawn = start_frame.tobytes(), control.video.tobytes()
        if self._true.setdefault(key, drawn) != drawn:
            return np.repeat(start_frame[:, None], SPEC.num_frames, axis=1)
        frames = self._after(start_frame)
        if not self._blur:
            return frames
        return np.array([[cv2.GaussianBlur(f, (0, 0), self._blur) for f in v] for v in frames])

    def _after(self, start_frame: ByteArray) -> ByteArray:
        for recording in self._recordings:
            for index in range(len(recording.times)):
                if (recording.frames[:, index] == start_frame).all():
                    later = index + 2 * np.arange(1, SPEC.num_frames + 1)
                    return recording.frames[:, np.minimum(later, len(recording.times) - 1)]
        raise AssertionError('the start frame was never recorded')


@pytest.fixture
def oracle(recordings) -> OracleWorldModel:
    """Knows the recorded future."""
    return OracleWorldModel(recordings)


@pytest.fixture
def blurred_oracle(recordings) -> OracleWorldModel:
    """Knows the recorded future but draws it out of focus."""
    return OracleWorldModel(recordings, blur=1.0)


def persistence(spec: WorldModelSpec) -> Pipeline:
    """A pipeline whose world model holds the first frame; a worker process can make it, too."""
    card = read_card(share_path('resource', 'checkpoint')).replace(rendering={})
    yam = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))
    return assembled(card, PersistenceWorldModel(spec), yam)
