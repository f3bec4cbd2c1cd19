"""Recordings none of which a command can use are refused before they are read."""

import re
import subprocess
import sys

import pytest

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.files import copy_folder, share_path
from mtv_world_ros.data.bag_mapping import BagMapping
from mtv_world_ros.data.unusable import refuse_unusable
from mtv_world_ros.robot.file import load_robot, robot_path

VIEWS = ('low', 'high')


@pytest.fixture(scope='module')
def robot():
    return load_robot(robot_path('yam_bimanual'))


@pytest.fixture(scope='module')
def franka():
    return load_robot(robot_path('franka'))


@pytest.fixture
def episode(tmp_path):
    copy_folder(share_path('resource', 'demo_episode'), tmp_path / 'data' / 'episode')
    return tmp_path / 'data' / 'episode'


@pytest.fixture
def without_high(episode):
    other = episode.parent / 'a_without_high'
    copy_folder(episode, other)
    metadata = other / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace('/high/image_raw', '/top/image_raw'))
    return other


def test_a_view_that_no_recording_has_is_named(episode, without_high, robot):
    with pytest.raises(EpisodeError, match="no view 'side'.* its views are low, "):
        refuse_unusable([episode, without_high], ['low', 'side'], robot)
    with pytest.raises(EpisodeError, match="^no usable .*_high' has no view 'high'"):
        refuse_unusable([without_high], VIEWS, robot)


def test_one_recording_with_the_views_suffices(episode, without_high, robot):
    refuse_unusable([without_high, episode], VIEWS, robot)


def test_a_mapping_names_the_topics(without_high, robot):
    there = BagMapping(views={'low': '/low/image_raw', 'high': '/top/image_raw'})
    refuse_unusable([without_high], VIEWS, robot, mapping=there)
    missing = BagMapping(views={'low': '/low/image_raw', 'high': '/up/image_raw'})
    with pytest.raises(EpisodeError, match="no images at '/up/image_raw'"):
        refuse_unusable([without_high], VIEWS, robot, mapping=missing)


def test_another_robot_is_named_with_the_remedy(episode, franka):
    with pytest.raises(EpisodeError, match="of robot 'yam_bimanual' .* 'franka': give --arm YAML"):
        refuse_unusable([episode], VIEWS, franka, remedy='--arm YAML')


def test_a_robot_of_another_name_with_the_recorded_joints_is_used(episode, robot):
    metadata = episode / 'metadata.yaml'
    text = metadata.read_text()
    assert 'robot: yam_bimanual' in text
    metadata.write_text(text.replace('robot: yam_bimanual', 'robot: mine'))
    refuse_unusable([episode], VIEWS, robot)


def test_a_rate_below_the_models_is_named(episode, robot):
    refuse_unusable([episode], VIEWS, robot, fps=10)
    with pytest.raises(EpisodeError, match='has 10 frames a second.*set video.fps to 10 or less'):
        refuse_unusable([episode], VIEWS, robot, fps=15)


@pytest.mark.parametrize('lost', ['the file', 'the topics'])
def test_recordings_whose_topics_are_not_listed_are_left_to_the_reader(episode, robot, lost):
    metadata = episode / 'metadata.yaml'
    if lost == 'the file':
        metadata.unlink()
    else:  # Foxglove's images are images only once they were read
        metadata.write_text(metadata.read_text().replace('sensor_msgs/msg', 'foxglove_msgs/msg'))
    refuse_unusable([episode], ['side'], robot, fps=50)


@pytest.mark.parametrize(
    ('command', 'says'),
    [
        ('train {data} --out {out} --views low,side', "has no view 'side'"),
        ('train {data} --out {out} --set video.fps=40', 'has 10 frames a second'),
        ('train {data} --out {out} --split none', "split 'none' is not one of|has no splits"),
        ('train {data} --out {out} --set video.robot=franka', 'give --set video.robot=FILE'),
        ('train {data} --out {out} --sample-every 5', 'has no split val or test'),
        ('evaluate bundled {data} --out {out}', "has no view 'high'"),
        ('imagine --episodes {data} --out {out}', "has no view 'high'"),
        ('fit contact {data} --out {out} --views side', "has no view 'side'"),
    ],
)
def test_a_command_says_so_before_it_loads_a_model(command, says, request, tmp_path):
    data = request.getfixturevalue('without_high' if 'high' in says else 'episode')
    words = command.format(data=data, out=tmp_path / 'out').split()
    code = (
        'import sys; from mtv_world_ros.cli import main; '
        f"status = main({words!r}); print(status, 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert done.stdout.split()[-2:] == ['1', 'False'], done.stderr
    assert re.search(says, done.stderr), done.stderr
    assert not (tmp_path / 'out').exists()
