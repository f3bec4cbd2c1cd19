"""Episodes that cannot be used are counted by reason; a full disk leaves what was saved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import json
import multiprocessing
import os
from pathlib import Path
import resource
import signal

import numpy as np
import pytest
import torch

from mtv_world_ros.cli.train import found_broken, set_overrides
from mtv_world_ros.control.trajectory_video import TrajectoryVideoConfig
from mtv_world_ros.core.errors import ConfigError, TrainingError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.reader import BagMessage, BagReader
from mtv_world_ros.data.bag.writer import BagWriter
from mtv_world_ros.inspection.inspection_report import BROKEN
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.model.trained_model import load_trained_model
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.training import resume
from mtv_world_ros.training.clips.episode_index import IndexedEpisode
from mtv_world_ros.training.resume import DiskError
from mtv_world_ros.training.training_config import TrainingRun
from mtv_world_ros.training.training_run import load_episodes, train, training_notes
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter
from test.support.sources import make_source, make_trainer

Change = Callable[[BagMessage], list[bytes]]


def rewrite(episode: Path, path: Path, change: Change) -> None:
    """Copy a bag with some messages left out or replaced."""
    with BagWriter(path) as writer:
        for message in BagReader(episode).messages():
            for data in change(message):
                writer.write_raw(message.topic, message.msgtype, message.stamp_ns, data)
    (path / 'calibration.yaml').write_bytes((episode / 'calibration.yaml').read_bytes())


def without(topic: str) -> Change:
    return lambda message: [] if message.topic == topic else [message.data]


def moving_camera(message: BagMessage) -> list[bytes]:
    if message.topic != '/low/camera_info':
        return [message.data]
    info = messages.deserialize(message.msgtype, message.data)
    info.k = info.k + np.array([5.0, *[0.0] * 8])
    return [message.data, messages.serialize(message.msgtype, info)]


def other_robot(message: BagMessage) -> list[bytes]:
    if message.topic not in ('/joint_states', '/joint_trajectory'):
        return [message.data]
    content = messages.deserialize(message.msgtype, message.data)
    names = 'name' if message.topic == '/joint_states' else 'joint_names'
    setattr(content, names, [f'panda_joint{i}' for i, _ in enumerate(getattr(content, names))])
    return [messages.serialize(message.msgtype, content)]


@pytest.mark.slow
def test_unusable_episodes_are_counted_by_reason_before_the_first_step(
    episode, tiny, robot, tmp_path, capsys
):
    data = tmp_path / 'data'
    rewrite(episode, data / 'good', lambda message: [message.data])
    for name in ('stateless_a', 'stateless_b'):
        rewrite(episode, data / name, without('/joint_states'))
    rewrite(episode, data / 'viewless', without('/high/image_raw/compressed'))
    rewrite(episode, data / 'other_robot', other_robot)
    rewrite(episode, data / 'moved', moving_camera)
    (data / 'broken').mkdir()
    (data / 'broken' / 'metadata.yaml').write_text('rosbag2_bagfile_information: {}')
    out = tmp_path / 'run'
    run = TrainingRun(config=tiny, dataset=data, out=out)
    train(run, robot=robot, segmenter=ColourSegmenter())
    reasons = {Path(k).name: v for k, v in json.loads((out / 'skipped.json').read_text()).items()}
    bad = ['broken', 'moved', 'other_robot', 'stateless_a', 'stateless_b', 'viewless']
    assert sorted(reasons) == bad
    assert 'joint_states' in reasons['stateless_a']
    assert "'high'" in reasons['viewless']
    assert 'panda_joint0' in reasons['other_robot']
    assert '/low/camera_info' in reasons['moved'] and 'changes' in reasons['moved']
    printed = capsys.readouterr()
    lines = [line for line in (printed.out + printed.err).splitlines() if 'left out:' in line]
    assert len(lines) == 5
    assert 'left out: 2 x ' in lines[0] and 'joint_states' in lines[0]
    assert lines[0].endswith('(stateless_a, stateless_b)')
    assert all(any(f'({name})' in line for line in lines) for name in ('viewless', 'moved'))
    for name in reasons:
        (data / name).rename(tmp_path / name)
    rewrite(episode, tmp_path / 'only' / 'bad', without('/joint_states'))
    with pytest.raises(TrainingError, match='no usable episode: 1 x .*joint_states'):
        train(run.replace(dataset=tmp_path / 'only'), robot=robot, segmenter=ColourSegmenter())
    franka = load_robot(share_path('config', 'robots', 'franka', 'robot.yaml'))
    said = "of robot 'yam_bimanual', and video.robot is 'franka'; give --set video.robot="
    with pytest.raises(TrainingError, match=said):
        load_episodes([episode], tiny, franka, tmp_path / 'cache')


def indexed(config, *recordings):
    return [IndexedEpisode.of(recording, config.spec) for recording in recordings]


@pytest.fixture
def report(tmp_path):
    """A report of `mtv-world check`: one view of `b` is broken, and the whole of `c`."""
    broken = {'a': {}, 'b': {'wrist': 'mirrored'}, 'c': {'recording': 'degrees', 'low': 'frozen'}}
    (tmp_path / BROKEN).write_text(json.dumps(broken))
    return tmp_path


def test_what_the_doctor_found_broken_is_left_out(report, episode, tiny, robot):
    paths = [Path('data', name) for name in 'abc']
    whole = {'data/c': 'recording: degrees; low: frozen'}
    assert found_broken(report, paths, ('low', 'high')) == whole
    assert found_broken(report, paths, ('low', 'wrist')) == {'data/b': 'wrist: mirrored'} | whole
    with pytest.raises(TrainingError, match='no usable episode: 1 x wrist: mirrored'):
        load_episodes(
            [episode], tiny, robot, report / 'cache', broken={str(episode): 'wrist: mirrored'}
        )


def test_a_report_of_other_episodes_is_refused(report):
    with pytest.raises(ConfigError, match="1 of the episodes were not checked, e.g. 'd'"):
        found_broken(report, [Path('data/a'), Path('data/d')], ('low',))
    for text in ('', '[]', '{"a": "mirrored"}'):
        (report / BROKEN).write_text(text)
        with pytest.raises(ConfigError, match='cannot be read'):
            found_broken(report, [Path('data/a')], ('low',))
    with pytest.raises(ConfigError, match='mtv-world check FOLDER --out DIR writes it'):
        found_broken(report / 'nothing', [Path('data/a')], ('low',))


def test_weights_that_know_other_drawings_are_told(tiny, recording):
    bundled = Checkpoint.open('bundled')
    said = ' '.join(training_notes(tiny, indexed(tiny, recording), bundled))
    assert 'rendering.object_motion=true' in said and 'rendering.finger_width_m=0.008' in said
    alike = tiny.replace(rendering=TrajectoryVideoConfig(**bundled.card.rendering))
    assert 'starts from' not in ' '.join(training_notes(alike, indexed(alike, recording), bundled))


def test_episodes_of_other_cameras_than_most_are_named(tiny, recording):
    first, *rest = recording.cameras
    pose = first.T_mount_camera.copy()
    pose[0, 3] += 0.1
    moved = replace(
        recording, path=Path('moved'), cameras=(replace(first, T_mount_camera=pose), *rest)
    )
    said = ' '.join(training_notes(tiny, indexed(tiny, recording, moved, recording)))
    assert 'other calibrations than most: 1 (moved)' in said
    assert 'other calibrations' not in ' '.join(
        training_notes(tiny, indexed(tiny, recording, recording))
    )


def test_a_full_disk_leaves_the_last_state_and_checkpoint_whole(tiny, source, tmp_path):
    """Files may not grow beyond a limit here, which fails at the same calls as a full disk."""
    trainer = make_trainer(tiny, tmp_path)
    reports = trainer.run(
        source, save_every=1, on_save=lambda _: trainer.export(tmp_path / 'checkpoint')
    )
    for _ in range(2):  # the second call saves what the first one did
        next(reports)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    try:
        with pytest.raises(DiskError, match='whole: free some space and run the same command'):
            next(reports)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert sorted(path.name for path in tmp_path.iterdir()) == ['checkpoint', 'state']
    resumed = make_trainer(tiny, tmp_path)
    assert resumed.load_state() and resumed.step == 1
    assert (
        load_trained_model(Checkpoint.open(tmp_path / 'checkpoint')).card.trained_on['steps'] == 1
    )


def test_a_second_interrupt_while_a_state_is_written_ends_it_as_an_interrupt(
    tiny, source, tmp_path, monkeypatch
):
    """Torch's error holds it, and it is no trouble of the disk."""
    trainer = make_trainer(tiny, tmp_path)
    reports = trainer.run(source, save_every=1, on_save=lambda _: None)
    for _ in range(2):  # the second call saves what the first one did
        next(reports)

    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(resume.HuggingFaceStorageWriter, 'write_data', stopped)
    with pytest.raises(KeyboardInterrupt):
        trainer.save_state()
    resumed = make_trainer(tiny, tmp_path)
    assert resumed.load_state() and resumed.step == 1


def test_a_killed_data_process_is_said_and_others_make_the_same_clips(
    recording, tiny, robot, source
):
    others = set(multiprocessing.active_children())
    workers = make_source([recording], tiny, robot, workers=2)
    for step in range(3):
        expected, found = source.batch(step), workers.batch(step)
        assert torch.equal(found.start_frame, expected.start_frame)
        assert torch.equal(found.inputs.video, expected.inputs.video)
    first = (set(multiprocessing.active_children()) - others).pop()
    os.kill(first.pid, signal.SIGKILL)
    first.join(60)
    with pytest.raises(TrainingError, match='killed at step .*the last saved state is whole'):
        for step in range(3, 30):  # some batches were prepared before
            workers.batch(step)
    workers.close()


def test_numbers_with_an_exponent_are_numbers():
    """YAML 1.1 takes 4e-4 for a text."""
    assert set_overrides(['optimizer.learning_rate=4e-4', 'video.robot=1e5a']) == {
        'optimizer.learning_rate': 0.0004,
        'video.robot': '1e5a',
    }
