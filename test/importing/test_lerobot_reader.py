"""LeRobot's own reader opens what `export-dataset` writes."""

import cv2
import numpy as np
import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.core.files import share_path

NUM_ROWS = 71
SIZE = (64, 48)


def test_lerobot_reads_an_export(tmp_path, monkeypatch):
    monkeypatch.setenv('HF_HUB_OFFLINE', '1')
    monkeypatch.setenv('HF_HOME', str(tmp_path / 'home'))
    reason = 'lerobot is not installed (pip install lerobot, in an environment of its own)'
    module = pytest.importorskip('lerobot.datasets.lerobot_dataset', reason=reason)
    episode, out = str(share_path('resource', 'demo_episode')), tmp_path / 'out'
    size = 'x'.join(map(str, SIZE))
    assert main(['export', 'lerobot', episode, '--out', str(out), '--images', '--size', size]) == 0
    earlier = {'observation.images.low': [-0.1, 0.0], 'action': [0.0, 0.1, 0.2]}
    data = module.LeRobotDataset('local/demo', root=out, delta_timestamps=earlier)
    assert (len(data), data.num_episodes, data.fps) == (NUM_ROWS, 1, 10)
    first, row, last = data[0], data[35], data[NUM_ROWS - 1]
    assert row['task'] == 'stack the purple block on the pink block'
    assert row['observation.images.low'].shape == (2, 3, SIZE[1], SIZE[0])
    assert first['observation.images.low_is_pad'].tolist() == [True, False]
    assert last['action_is_pad'].tolist() == [False, True, True]
    np.testing.assert_allclose(row['action'][1], data[36]['action'][0])
    assert float(last['timestamp']) == pytest.approx(7.0)
    # the picture is the recorded one: bright table, dark arm, in red, green, blue
    image = (row['observation.images.high'].permute(1, 2, 0).numpy() * 255).astype(np.uint8)
    assert image.shape == (SIZE[1], SIZE[0], 3)
    hue = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
    purple = (abs(hue[..., 0].astype(int) - 140) < 10) & (hue[..., 1] > 120)
    assert purple.sum() > 5
