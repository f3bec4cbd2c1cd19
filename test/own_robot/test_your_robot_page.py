"""Every step of docs/your_robot.md, in its order, on a robot that `config/` does not know.

The recordings are a sqlite3 bag with TF, the robot's description, JPEG and YUV images and no
commands. Where rclpy is installed, the node and those who talk to it run too.
"""

from importlib.util import find_spec
import json
import os
from pathlib import Path
import shlex
import shutil
import signal
import subprocess
import sys

import cv2
import numpy as np
import pytest
import yaml

from mtv_world_ros import judge, Pipeline
from mtv_world_ros.cameras.camera import project
from mtv_world_ros.cli import main
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.inspection.cameras import shared_camera
from mtv_world_ros.physics.fitting import contact_fit
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.viewing.video import encode_video
from test.own_robot.test_own_checkpoint import TINY
from test.support.bags import MAPPING, record
from test.support.crane import FPS, load, make_cameras, make_positions, render, tool_pixels

PAGE = Path(__file__).resolve().parents[2] / 'docs' / 'your_robot.md'
#: names on the page, and those of the test's robot
NAMES = {'my_robot': 'crane', 'first_bag': 'wave', 'front,side': 'door,palm'}
VIDEO_NAMES = {'my_robot': 'crane', 'front,side': 'door,window', '0001': 'one'}
#: keep the commands small
SMALL = {
    'train': ['--threads', '1', *TINY],
    'evaluate': ['--no-ceiling', '--actions', 'true', '--steps=1', '--threads=1', '--no-report'],
    'imagine': ['--max-chunks', '2', '--threads', '1'],
    'fit contact': ['--motions', '2', '--threads', '1'],
}
#: as the page has it for a first try, from the bundled weights, and smaller
FIRST_TRY = [
    '--threads', '1', '--set', 'optimizer.steps=2', '--set', 'optimizer.batch_size=1',
    '--set', 'video.width=160', '--set', 'video.height=96', '--set', 'video.num_frames=8',
]  # fmt: skip
#: a busy machine takes long to start a node, and to hand it images
PATIENT = ['--wait-timeout', '300', '--answer-timeout', '300']
CALM = ['-p', 'num_threads:=1', '-p', 'max_image_age_s:=60.0', '-p', 'max_joint_state_age_s:=60.0']
POLICY = """
import numpy as np
from mtv_world_ros.core.data_types import JointTrajectory


class Nod:
    name = 'nod'

    def reset(self, *, seed):
        pass

    def act(self, observation, instruction):
        times = np.array([0.2, 0.4])
        positions = np.tile(observation.positions, (2, 1))
        positions[:, 4] += 0.05
        return JointTrajectory(
            joint_names=('yaw', 'shoulder', 'elbow', 'roll', 'nod', 'jaw_left'), times=times,
            positions=positions,
        )
"""
#: exit status of `doctor`: the camera on the hand cannot be checked
STATUS = {'check': 3}


#: a block on the floor beside the robot [m]: its corners, and a colour that no tile has
BLOCK = np.array([0.45, -0.4, 0.04]) + 0.04 * np.array(
    [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
)
PINK = (250, 40, 200)
#: the part of the page that is about videos and tables
VIDEOS = '## From videos and tables'


def lines(*, of_videos: bool = False) -> list[list[str]]:
    """Words of the page's `mtv-world` lines, one after the other."""
    before, _, after = PAGE.read_text().partition(VIDEOS)
    text = after if of_videos else before
    for name, own in (VIDEO_NAMES if of_videos else NAMES).items():
        text = text.replace(name, own)
    blocks = [part.split('```')[0] for part in text.split('```bash\n')[1:]]
    return [shlex.split(line) for block in blocks for line in block.splitlines() if line]


@pytest.fixture(scope='module')
def desk(tmp_path_factory):
    """Folder with the robot's URDF and meshes, its bags, and their mapping."""
    folder = tmp_path_factory.mktemp('desk')
    robot, cameras = load(folder), make_cameras()
    del cameras['window']
    bag = folder / 'recordings' / 'wave'
    bag.parent.mkdir()
    record(bag, robot, cameras, make_positions(4.0, fps=FPS), sqlite=True)
    shutil.move(folder / 'crane' / 'crane.urdf', folder / 'crane.urdf')
    (folder / 'crane' / 'crane.yaml').unlink()
    (folder / 'my_bags.yaml').write_text(yaml.safe_dump(MAPPING))
    (folder / 'nodding.py').write_text(POLICY)
    policy = {'kind': 'python', 'factory': 'nodding:Nod'}
    (folder / 'my_policy.yaml').write_text(yaml.safe_dump(policy))
    return folder


class Node:
    """The page's line that starts the node, as a process; stopped by SIGINT."""

    def __init__(self, words, log):
        start = 'from mtv_world_ros.ros import run_world_model; run_world_model()'
        self.log = log
        with log.open('w') as out:
            self._process = subprocess.Popen(
                [sys.executable, '-c', start, *words[1:], *CALM],
                stdout=out, stderr=subprocess.STDOUT,
            )  # fmt: skip

    def stop(self):
        """Return the exit status."""
        self._process.send_signal(signal.SIGINT)
        return self._process.wait(60)


def name_of(words):
    """Name of the command of a line: one word or two."""
    return ' '.join(words[1:3] if words[1] in ('import', 'fit', 'export') else words[1:2])


def run_in_process(words):
    """Run a command that talks to the node from a process of its own; return what it said."""
    command = [
        sys.executable,
        '-m',
        'mtv_world_ros.cli',
        *words[1:],
        *SMALL.get(name_of(words), []),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, f'{words}: {done.stdout}{done.stderr}'
    return done.stdout + done.stderr


@pytest.fixture
def at_the_desk(desk, monkeypatch):
    """Commands run there, and find the policy's module."""
    monkeypatch.chdir(desk)
    monkeypatch.syspath_prepend(desk)
    packages = [str(desk), str(PAGE.parents[1]), os.environ.get('PYTHONPATH', '')]
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join(filter(None, packages)))
    return desk


def of_ros(words):
    return words[0] == 'world_model' or words[1] == 'imagine' or '--lock-step' in words


def is_route(words):
    """Whether a line runs an episode: offline, imagined or through the node."""
    return of_ros(words) or '--offline' in words


@pytest.mark.slow
def test_the_page_leads_from_a_urdf_to_predictions(at_the_desk, capsys):
    done = []
    for words in (words for words in lines() if not of_ros(words)):
        command = name_of(words)
        status = main([*words[1:], *SMALL.get(command, [])])
        said = capsys.readouterr()
        assert status == STATUS.get(command, 0), f'{words}: {said.out}{said.err}'
        done.append(command)
    assert done == ['robot', 'import bag', 'check', 'task', 'train', 'evaluate', 'replay']
    assert (at_the_desk / 'my_task.yaml').is_file()
    assert (at_the_desk / 'out' / 'mine' / 'metrics.json').is_file()


@pytest.fixture(scope='module')
def lab(tmp_path_factory):
    """Folder with a URDF, videos and tables of two recordings, and the one file to write."""
    folder = tmp_path_factory.mktemp('lab')
    robot, cameras = load(folder), make_cameras()
    del cameras['palm']
    clicked, boxes = ({view: {} for view in cameras} for _ in range(2))
    for name, seed in (('one', 0), ('two', 1)):
        positions = make_positions(6.0, seed=seed)
        (folder / 'raw' / name).mkdir(parents=True)
        np.savetxt(folder / 'raw' / name / 'joints.csv', positions, delimiter=',',
                   header=','.join(robot.joint_names), comments='')  # fmt: skip
        for view, camera in cameras.items():
            frames = render(robot, camera, positions)
            corners = project(camera, camera.T_mount_camera, BLOCK)[0]
            for frame in frames:  # the robot does not come between it and the cameras
                cv2.fillConvexPoly(frame, cv2.convexHull(corners.round().astype(np.int32)), PINK)
            edges = [*corners.min(0) - 1, *corners.max(0) + 1]
            boxes[view][name] = {'pink block': [[0.0, *np.round(edges).tolist()]]}
            (folder / 'raw' / name / f'{view}.mp4').write_bytes(encode_video(frames, FPS))
            seen = tool_pixels(robot, camera, positions)
            clicked[view][name] = [[k / FPS, *seen[k].round().tolist()] for k in (3, 21, 45)]
    shutil.move(folder / 'crane' / 'crane.urdf', folder / 'crane.urdf')
    (folder / 'crane' / 'crane.yaml').unlink()
    said = {
        'robot': 'crane.yaml',
        'rows': '{name}/joints.csv',
        'views': {view: f'{{name}}/{view}.mp4' for view in cameras},
        'fps': FPS,
        'state': {'feature': '', 'joints': None},
        'instruction': 'wave',
    }
    (folder / 'my_lab.yaml').write_text(yaml.safe_dump(said))
    (folder / 'points.yaml').write_text(yaml.safe_dump(clicked))
    (folder / 'objects.yaml').write_text(yaml.safe_dump({'boxes': boxes}))
    return folder, cameras


@pytest.mark.slow
def test_the_page_leads_from_videos_to_a_contact_sheet(lab, monkeypatch, capsys):
    """With at most eight commands, and cameras of which nothing was known."""
    folder, cameras = lab
    monkeypatch.chdir(folder)
    monkeypatch.setattr(shared_camera, 'STAGES', shared_camera.STAGES[:2])  # the last is finer
    fit = contact_fit.ContactFitSettings(num_draws=8, num_rounds=1)
    monkeypatch.setattr(contact_fit, '_FIT', fit)
    told = [words for words in lines(of_videos=True) if not is_route(words)]
    assert len(told) <= 8
    for words in told:
        more = FIRST_TRY if words[1] == 'train' else []
        if name_of(words) in ('evaluate', 'fit contact'):
            more = [word for word in SMALL[name_of(words)] if word != '--no-report']
        status = main([*words[1:], *more])
        said = capsys.readouterr()
        assert status == 0, f'{words}: {said.out}{said.err}'
    assert 'data:image/webp' in (folder / 'out' / 'lab' / 'report.html').read_text()
    contact = folder / 'runs' / 'lab' / 'checkpoint' / 'object_motion' / 'contact.json'
    found = json.loads(contact.read_text())
    # the floor, through cameras that are known to 4 px; no recording has commands of its own
    assert abs(found['table_m']) < 0.03 and found['squeeze'] > 0
    for name in ('one', 'two'):
        masks = read_episode(folder / 'data' / 'lab' / name).masks
        assert masks is not None and all(
            (np.asarray(m.frames) > 0).any((1, 2)).all() for m in masks.values()
        )
    robot = load_robot(folder / 'data' / 'lab' / 'robot' / 'robot.yaml')
    for name, seed in (('one', 0), ('two', 1)):
        found = read_episode(folder / 'data' / 'lab' / name, robot=robot).cameras
        for view, camera in cameras.items():
            positions = make_positions(6.0, seed=seed)
            apart = tool_pixels(robot, camera, positions) - tool_pixels(
                robot, found[view], positions
            )
            assert np.median(np.linalg.norm(apart, axis=1)) < 4.0  # of 320
            assert abs(found[view].K[0, 0] / camera.K[0, 0] - 1) < 0.07


@pytest.mark.slow
@pytest.mark.skipif(find_spec('rclpy') is None, reason='rclpy is not installed')
def test_recordings_of_videos_run_offline_imagined_judged_and_through_the_node(
    lab, monkeypatch, capfd
):
    """Goes on from what the test above has trained: every route of the page."""
    folder, _ = lab
    checkpoint = folder / 'runs' / 'lab' / 'checkpoint'
    if not checkpoint.is_dir():
        pytest.skip('the page was not run until here')
    monkeypatch.chdir(folder)
    routes = [words for words in lines(of_videos=True) if is_route(words)]
    offline, imagine, serve, play = routes
    for words in (offline, imagine):
        status = main([*words[1:], *(SMALL['imagine'] if words is imagine else ['--threads=1'])])
        said = ''.join(capfd.readouterr())
        assert status == 0, f'{words}: {said}'
    pipeline = Pipeline.load(checkpoint, segmenter='colour', num_threads=1)
    recording = load_recording(folder / 'data' / 'lab' / 'one', pipeline.spec, pipeline.robot)
    assert judge(pipeline, recording).reasons  # why it abstains: a wave is no task
    node = Node(serve, folder / 'node.log')
    try:
        said = run_in_process([*play, *PATIENT])
    finally:
        status = node.stop()
    assert status == 0 and ' done' in said and 'rejected' not in said, said + node.log.read_text()


@pytest.mark.slow
@pytest.mark.skipif(find_spec('rclpy') is None, reason='rclpy is not installed')
def test_the_page_leads_on_to_the_node_and_a_policy_in_it(at_the_desk, capfd):
    """Goes on from what the test above has trained."""
    if not (at_the_desk / 'runs' / 'mine' / 'checkpoint').is_dir():
        pytest.skip('the first half of the page was not run')
    serve, play, *imagine = [words for words in lines() if of_ros(words)]
    node = Node(serve, at_the_desk / 'node.log')
    try:
        said = run_in_process([*play, *PATIENT])
    finally:
        status = node.stop()
    assert status == 0 and ' done' in said and 'rejected' not in said, said + node.log.read_text()
    assert 'robot crane' in node.log.read_text()
    for words, out in zip(imagine, ('mine_repeated', 'mine_imagined'), strict=True):
        status = main([*words[1:], *SMALL['imagine']])
        said = ''.join(capfd.readouterr())
        assert status == 0 and 'max_chunks' in said, f'{words}: {said}'
        assert any((at_the_desk / 'out' / out).glob('episode_00000/*.mcap'))
