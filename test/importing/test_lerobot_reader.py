"""LeRobot's own reader opens what `export lerobot` writes; what LeRobot writes is imported.

Both need LeRobot: `make lerobot-tests` installs it in an environment of its own.
"""

from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode_reader import read_episode

NUM_ROWS = 71
SIZE = (64, 48)
FPS = 10
EPISODE = str(share_path('resource', 'demo_episode'))
VIEW = 'observation.images.side'
JOINTS = ('shoulder', 'elbow', 'gripper')


def define_operators() -> None:
    """Define the operators that torchvision describes where its own library cannot be loaded.

    Wheels of the registry are built for CUDA; reading data sets uses none of the operators.
    """
    import torch

    spec = find_spec('torchvision')
    if spec is None or spec.origin is None:
        return
    try:
        torch.ops.load_library(Path(spec.origin).with_name('_C.so'))
    except OSError:
        for name in ('nms', 'qnms'):
            if not hasattr(torch.ops.torchvision, name):
                schema = '(Tensor dets, Tensor scores, float iou_threshold) -> Tensor'
                torch.library.define(f'torchvision::{name}', schema)


@pytest.fixture
def lerobot(tmp_path, monkeypatch):
    """LeRobot's module of data sets, which may not ask its hub."""
    monkeypatch.setenv('HF_HUB_OFFLINE', '1')
    monkeypatch.setenv('HF_HOME', str(tmp_path / 'home'))
    reason = 'lerobot is not installed (make lerobot-tests)'
    pytest.importorskip('lerobot', reason=reason)
    define_operators()
    return pytest.importorskip('lerobot.datasets.lerobot_dataset', reason=reason)


def shows_the_purple_block(image) -> bool:
    """Return whether a picture (3, H, W) in [0, 1] is the recorded one, in red, green, blue."""
    pixels = (image.permute(1, 2, 0).numpy() * 255).astype(np.uint8)
    hue = cv2.cvtColor(pixels, cv2.COLOR_RGB2HSV)
    purple = (abs(hue[..., 0].astype(int) - 140) < 10) & (hue[..., 1] > 120)
    return bool(purple.sum() > 5)


def test_lerobot_reads_an_export(lerobot, tmp_path):
    out, size = tmp_path / 'out', 'x'.join(map(str, SIZE))
    assert main(['export', 'lerobot', EPISODE, '--out', str(out), '--images', '--size', size]) == 0
    earlier = {'observation.images.low': [-0.1, 0.0], 'action': [0.0, 0.1, 0.2]}
    data = lerobot.LeRobotDataset('local/demo', root=out, delta_timestamps=earlier)
    assert (len(data), data.num_episodes, data.fps) == (NUM_ROWS, 1, FPS)
    first, row, last = data[0], data[35], data[NUM_ROWS - 1]
    assert row['task'] == 'stack the purple block on the pink block'
    assert row['observation.images.low'].shape == (2, 3, SIZE[1], SIZE[0])
    assert first['observation.images.low_is_pad'].tolist() == [True, False]
    assert last['action_is_pad'].tolist() == [False, True, True]
    np.testing.assert_allclose(row['action'][1], data[36]['action'][0])
    assert float(last['timestamp']) == pytest.approx(7.0)
    image = row['observation.images.high']
    assert image.shape == (3, SIZE[1], SIZE[0]) and shows_the_purple_block(image)


def test_lerobot_finds_the_frames_of_an_export_with_videos(lerobot, tmp_path):
    """Decoding them needs torchcodec or torchvision's reader, which not every platform has."""
    out = tmp_path / 'out'
    assert main(['export', 'lerobot', EPISODE, EPISODE, '--out', str(out), '--fps', '5']) == 0
    data = lerobot.LeRobotDataset('local/demo', root=out)
    assert data.num_episodes == 2
    meta = data.meta
    starts = [meta.episodes[n]['videos/observation.images.high/from_timestamp'] for n in (0, 1)]
    files = [out / meta.get_video_file_path(n, 'observation.images.high') for n in (0, 1)]
    assert all(file.is_file() for file in files)
    assert files[0] != files[1] or starts[1] >= (len(data) / 2 - 1) / 5
    try:
        row = data[7]
    except (AttributeError, ImportError, OSError, RuntimeError) as error:
        pytest.skip(f'LeRobot has no video decoder here: {str(error).splitlines()[0][:80]}')
    assert shows_the_purple_block(row['observation.images.high'])


@pytest.mark.parametrize('use_videos', [True, False], ids=['videos', 'images'])
def test_what_lerobot_writes_is_imported(lerobot, tmp_path, make_mapping, use_videos, capsys):
    """Its writer, as `lerobot-record` uses it: no calibration, names with `.pos`, AV1."""
    root = tmp_path / 'written'
    motors = {'dtype': 'float32', 'shape': (3,), 'names': [f'{joint}.pos' for joint in JOINTS]}
    camera = {
        'dtype': 'video' if use_videos else 'image',
        'shape': (SIZE[1], SIZE[0], 3),
        'names': ['height', 'width', 'channels'],
    }
    data = lerobot.LeRobotDataset.create(
        'local/written',
        fps=FPS,
        root=root,
        robot_type='two_joints',
        use_videos=use_videos,
        features={
            'observation.state': motors,
            'action': motors,
            'observation.images.side': camera,
        },
    )
    for episode in range(2):
        for k in range(12):
            state = np.array([2 * k + episode, 30 - k, 100 - 5 * k], np.float32)
            grey = np.full((SIZE[1], SIZE[0], 3), 20 + 15 * k, np.uint8)
            data.add_frame(
                {
                    'observation.state': state,
                    'action': state + np.float32(1),
                    VIEW: grey,
                    'task': f'task {episode}',
                }
            )
        data.save_episode()
    data.finalize()
    mapping = make_mapping().parent / 'own.yaml'
    mapping.write_text(
        f'robot: robot.yaml\nviews: {{side: {{feature: {VIEW}}}}}\n'
        'state:\n  feature: observation.state\n  unit: deg\n  joints: {shoulder: shoulder.pos, '
        'elbow: elbow.pos, gripper: {column: gripper.pos, closed: 0, open: 120}}\n'
        'action: {feature: action}\n'
    )
    out = tmp_path / 'out'
    arguments = [str(root), '--mapping', str(mapping), '--out', str(out)]
    assert main(['import', 'lerobot', *arguments]) == 0, capsys.readouterr().err
    for number in range(2):
        episode = read_episode(out / f'episode_{number:06d}', with_cameras=False)
        assert episode.info.instruction == f'task {number}'
        positions = episode.joint_states.positions
        np.testing.assert_allclose(
            np.rad2deg(positions[:, 0]), 2 * np.arange(12) + number, atol=1e-4
        )
        np.testing.assert_allclose(positions[:, 2], (100 - 5 * np.arange(12)) / 3000, atol=1e-6)
        shown = [float(np.asarray(frame).mean()) for frame in episode.images['side'].frames]
        np.testing.assert_allclose(shown, 20 + 15 * np.arange(12), atol=4)
