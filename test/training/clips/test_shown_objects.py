"""Where the objects that a clip's trajectory video shows are cut out."""

from dataclasses import replace

import numpy as np

from mtv_world_ros.cameras.silhouettes import draw_silhouettes
from mtv_world_ros.control.trajectory_video import TrajectoryVideo, UNFORESEEN_GREY
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.data.recordings import Clip, cut_clip
from mtv_world_ros.robot.shape import load_shape
from mtv_world_ros.training.clips.batches import BatchSource
from mtv_world_ros.training.clips.clip_controls import ControlMaker
from mtv_world_ros.training.training_config import load_training_config
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter


def test_objects_are_cut_out_of_the_recordings_first_frame(episode, robot):
    config = load_training_config(
        'small',
        {
            'rendering.object_motion': True,
            'augment.start_noise': 0.0,
            'augment.colour_permutation': 0.0,
            'optimizer.batch_size': 6,
        },
    )
    recording = load_recording(episode, config.spec, robot)
    shape = (len(recording.times), len(recording.objects), 1, 1)
    still = replace(recording, object_poses=np.tile(np.eye(4), shape))
    segmenter = ColourSegmenter()
    source = BatchSource([still], config, robot=robot, segmenter=segmenter, seed=0)
    batch = source.batch(0)
    source.close()
    assert batch.inputs.video is not None
    same = []
    for frames, drawn in zip(batch.frames.numpy(), batch.inputs.video.numpy(), strict=True):
        seen = segmenter.segment(frames[:, :1], recording.names).masks[:, :, 0].any(1)
        same.append(bool((drawn[:, 0][seen] == frames[:, 0][seen]).all()))
    assert not any(same)


def test_objects_whose_poses_nobody_recorded_go_where_their_masks_go(robot, monkeypatch):
    """A real recording has masks alone; the simulator's poses are the judge."""
    spec = load_training_config('small', {}).spec
    path = share_path('resource', 'demo_episode')
    true = load_recording(path, spec, robot)
    monkeypatch.setattr(
        'mtv_world_ros.data.recording.read_episode',
        lambda *given, **named: replace(read_episode(*given, **named), object_poses=None),
    )
    found = load_recording(path, spec, robot)
    assert true.object_poses is not None and found.object_poses is not None
    ways = [poses[:, 0, :3, 3] - poses[0, 0, :3, 3] for poses in (true.object_poses,
                                                                 found.object_poses)]  # fmt: skip
    away = np.linalg.norm(ways[1] - ways[0], axis=-1)
    assert np.linalg.norm(ways[0], axis=-1).max() > 0.05
    assert np.median(away) < 0.012 and np.quantile(away, 0.9) < 0.03


def test_masks_that_came_with_the_episode_cut_objects_out(robot):
    """They are those of the recorded size; a segmenter that must not be asked is their maker."""
    config = load_training_config('small', {'rendering.object_motion': True})
    recording = load_recording(share_path('resource', 'demo_episode'), config.spec, robot)
    recording = replace(recording, masks_by='boxes')

    class Boxes:
        name = 'boxes'

    maker = ControlMaker(
        robot=robot, segmenter=Boxes(), control=TrajectoryVideo(config=config.rendering)
    )
    video = maker.make(cut_clip(recording, 0, config.spec), recording.names).video
    assert recording.object_ids is not None
    shown = np.isin(recording.object_ids[:, 0], [1 + recording.objects.index(name)
                                                 for name in recording.names])  # fmt: skip
    assert (video[:, 0][shown] == recording.frames[:, 0][shown]).mean() > 0.99


def test_arms_are_those_of_the_frame_that_a_clip_starts_from(robot):
    config = load_training_config(
        'small',
        {
            'rendering.arm_pictures': True,
            'video.object_mask': False,
            'augment.start_noise': 0.0,
            'augment.colour_permutation': 0.0,
        },
    )
    recording = load_recording(share_path('resource', 'demo_episode'), config.spec, robot)
    source = BatchSource([recording], config, robot=robot, segmenter=ColourSegmenter(), seed=0)
    batch = source.batch(0)
    source.close()
    frames, drawn = batch.frames.numpy(), batch.inputs.video.numpy()
    outlines = np.stack(
        [
            draw_silhouettes(load_shape(robot).parts, camera, robot, recording.positions) > 0
            for camera in recording.cameras
        ]
    )
    for clip, control in zip(frames, drawn, strict=True):
        at = int(np.argmin(np.abs(recording.frames.astype(int) - clip[:, :1]).mean((0, 2, 3, 4))))
        inside = outlines[:, at]
        same = (control[:, 0] == clip[:, 0]).all(axis=-1)
        assert same[inside].mean() > 0.6 and not control[:, 0][~inside].all(axis=-1).mean() > 0.05


def test_a_model_of_both_kinds_sees_foreseen_objects_or_masks_on_a_grey_canvas(robot):
    """Half of the clips each; without foresight the pipeline draws the second kind."""
    config = load_training_config(
        'small',
        {
            'rendering.object_motion': True,
            'rendering.foreseen_ratio': 0.5,
            'augment.start_noise': 0.0,
            'augment.colour_permutation': 0.0,
            'optimizer.batch_size': 40,
        },
    )
    recording = load_recording(share_path('resource', 'demo_episode'), config.spec, robot)
    source = BatchSource([recording], config, robot=robot, segmenter=ColourSegmenter(), seed=0)
    video = source.batch(0).inputs.video
    controls = source.controls
    source.close()
    assert video is not None
    is_grey = [(drawn == UNFORESEEN_GREY).all(-1).mean() > 0.5 for drawn in video.numpy()]
    # binomial: 40 draws of 0.5, within four standard deviations
    assert 20 - 13 <= sum(is_grey) <= 20 + 13
    clip = cut_clip(recording, 0, config.spec)
    masks = drawn_by(controls, clip, recording.names, foresees=False)
    bare = drawn_by(controls, clip, recording.names, foresees=False, object_mask=False)
    paper = drawn_by(controls, clip, recording.names, object_motion=False)
    trails = drawn_by(controls, clip, recording.names, object_motion=False, object_mask=False)
    assert (drawn_by(controls, clip, recording.names) == 0).all(-1).mean() > 0.5
    # fills have the same colours on the grey canvas as in the paper's on black
    filled = paper.any(-1) & ~trails.any(-1)
    assert filled.mean() > 0.005
    np.testing.assert_array_equal(masks[filled], paper[filled])
    assert (bare[filled] == UNFORESEEN_GREY).all()


def drawn_by(
    controls: ControlMaker,
    clip: Clip,
    names: tuple[str, ...],
    *,
    foresees: bool = True,
    object_mask: bool = True,
    **rendering: object,
) -> np.ndarray:
    """Frames of a clip with other settings of the drawing."""
    assert isinstance(controls.control, TrajectoryVideo)
    config = controls.control.config.replace(**rendering)
    control = replace(controls.control, config=config, object_mask=object_mask)
    video = replace(controls, control=control).make(clip, names, foresees=foresees).video
    assert video is not None
    return video


def test_without_a_share_of_masks_none_are_drawn(robot):
    config = load_training_config('small', {'rendering.object_motion': True})
    recording = load_recording(share_path('resource', 'demo_episode'), config.spec, robot)
    clip = cut_clip(recording, 0, config.spec)
    control = TrajectoryVideo(config=config.rendering)
    maker = ControlMaker(robot=robot, segmenter=ColourSegmenter(), control=control)
    found = drawn_by(maker, clip, recording.names, foresees=False)
    blind = drawn_by(maker, clip, recording.names, object_mask=False)
    np.testing.assert_array_equal(found, blind)
