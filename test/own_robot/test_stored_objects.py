"""Objects as one stage: named and segmented at import, read by training, replay and evaluation."""

from dataclasses import replace
import json

import numpy as np
import pytest
import yaml

from mtv_world_ros.cli import main
from mtv_world_ros.control.trajectory_video import TrajectoryVideo, TrajectoryVideoConfig
from mtv_world_ros.core.data_types import WorldModelSpec
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.data.recordings import cut_clip, described_objects
from mtv_world_ros.rollout.assembly import assemble_describer
from mtv_world_ros.training.clips.clip_controls import ControlMaker
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter
from test.support.bags import bag_cameras, MAPPING, record
from test.support.chat_server import ChatServer, completion
from test.support.crane import FPS, make_positions, render

pytest.importorskip('openai')
NUM = 40
SPEC = WorldModelSpec(
    views=('door', 'palm'), fps=FPS, num_frames=4, width=80, height=60, robot='crane'
)


def answer(*names):
    objects = [
        {'id': f'o{i}', 'name': name, 'colour': name.split()[0], 'category': 'thing',
         'role': 'manipuland', 'box': None}
        for i, name in enumerate(names)
    ]  # fmt: skip
    return completion(json.dumps({'objects': objects}))


@pytest.fixture
def bag(robot, tmp_path):
    """A bag of 40 frames in which a red patch goes to the right and a blue one stays."""
    cameras, positions = bag_cameras(), make_positions(NUM / FPS)[:NUM]
    frames = {view: render(robot, c, positions).copy() for view, c in cameras.items()}
    for video in frames.values():
        for k, frame in enumerate(video):
            frame[20:60, 20 + 3 * k : 60 + 3 * k] = 215, 30, 30
            frame[180:220, 260:300] = 30, 60, 215
    return record(tmp_path / 'tidy', robot, cameras, positions, frames=frames)


@pytest.fixture
def ask(tmp_path, monkeypatch):
    """Write a describer file for a server."""
    monkeypatch.setenv('NO_PROXY', '127.0.0.1')

    def write(server):
        file = tmp_path / 'describer.yaml'
        chat = {'model': 'm', 'base_url': server.base_url, 'key_variable': '',
                'retry_budget_s': 0.1}  # fmt: skip
        file.write_text(yaml.safe_dump({'kind': 'openai', 'openai': chat}))
        return file

    return write


def run(bag, *more):
    folder = bag.parent
    (folder / 'bag.yaml').write_text(yaml.safe_dump({**MAPPING, 'instruction': 'tidy up'}))
    command = ['import', 'bag', str(bag), '--topics', str(folder / 'bag.yaml')]
    return main([*command, '--out', str(folder / 'out'), *map(str, more)])


def test_an_import_asks_once_and_stores_names_and_masks(bag, ask, robot, capsys):
    with ChatServer(answer('red box', 'blue box')) as server:
        status = run(bag, '--describer', ask(server), '--segmenter', 'colour')
        assert status == 0, capsys.readouterr().err
        assert len(server.requests) == 1 and 'tidy up' in json.dumps(server.requests[0])
    path = bag.parent / 'out' / 'tidy'
    episode = read_episode(path)
    assert episode.info.objects == ('red box', 'blue box')
    assert episode.info.metadata['masks_by'] == 'colour'
    for view in ('door', 'palm'):
        stamps, ids = episode.masks[view]
        assert (stamps == episode.images[view].stamps_ns).all()
        for k in (0, 31, 32, NUM - 1):  # 32 frames are segmented together
            assert (np.asarray(ids[k])[25:55, 25 + 3 * k : 55 + 3 * k] == 1).mean() > 0.95
            assert (np.asarray(ids[k])[185:215, 265:295] == 2).mean() > 0.95
            assert (np.asarray(ids[k]) > 0).sum() < 4000


@pytest.mark.slow
def test_later_stages_read_the_names_and_training_the_masks(bag, ask, robot):
    with ChatServer(answer('red box', 'blue box')) as server:
        assert run(bag, '--describer', ask(server), '--segmenter', 'colour') == 0
    recording = load_recording(bag.parent / 'out' / 'tidy', SPEC, robot)
    assert recording.names == ('red box', 'blue box') and recording.masks_by == 'colour'

    class Asked(ColourSegmenter):
        def segment(self, frames, names, first_masks=None, first_frames=None):
            raise AssertionError('the stored masks are there')

    def control(segmenter, clip):
        maker = ControlMaker(
            robot=robot,
            segmenter=segmenter,
            control=TrajectoryVideo(config=TrajectoryVideoConfig()),
        )
        return maker.make(clip, recording.names).video[0]

    clip = cut_clip(recording, 5, SPEC)
    stored, found = control(Asked(), clip), control(ColourSegmenter(), replace(clip, masks_by=''))
    bare = control(ColourSegmenter(), replace(clip, masks_by='', frames=0 * clip.frames))
    assert (stored != found).any(-1).mean() < 0.01 < (bare != found).any(-1).mean()
    with pytest.raises(AssertionError):  # masks of the simulator are not what serving sees
        control(Asked(), replace(clip, masks_by=''))


def test_an_episode_without_names_is_described_where_it_is_used(bag, ask, robot, tmp_path):
    assert run(bag) == 0
    path = bag.parent / 'out' / 'tidy'
    assert load_recording(path, SPEC, robot).names == ()
    with ChatServer(answer('red box')) as server:
        names = described_objects(path, assemble_describer(ask(server)), 'door')
        assert names == ('red box',)
    with ChatServer(answer()) as server, pytest.raises(EpisodeError, match='no object was seen'):
        described_objects(path, assemble_describer(ask(server)), 'door')
    asked = assemble_describer(ask(server))  # it is gone
    with pytest.raises(EpisodeError, match=r'could not be named \(unreachable\)'):
        described_objects(path, asked, 'door')


@pytest.mark.slow
def test_another_describer_is_another_import(bag, ask, capsys):
    assert run(bag) == 0
    with ChatServer(answer('red box')) as server:
        assert run(bag, '--describer', ask(server)) == 1
    assert 'imported with another mapping' in capsys.readouterr().err


def test_a_describer_that_fails_fails_the_import_with_its_reason(bag, ask, capsys):
    with ChatServer(answer('red box')) as server:
        file = ask(server)
    assert run(bag, '--describer', file) == 1
    assert 'server' in capsys.readouterr().err
    assert not (bag.parent / 'out' / 'tidy').exists()
