"""The paper's rate by commands alone: episodes of 16 fps, a preset of 81 frames, its scores."""

import json
from pathlib import Path

import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.simulation.opengl import missing_opengl
from test.support.sources import set_options, TINY_MODEL

#: everything small but time: 80 frames at 16 fps after the observed one, 5 s
MINIATURE = TINY_MODEL | {
    'video.fps': 16,
    'video.num_frames': 80,
    'video.width': 64,
    'video.height': 48,
    'transformer.frames_per_token': 8,
    'optimizer.steps': 1,
}


@pytest.mark.slow
@pytest.mark.skipif(bool(missing_opengl()), reason='the simulator cannot render here')
def test_episodes_of_16_fps_are_collected_trained_on_and_scored(tmp_path):
    data, run, scores = (str(tmp_path / name) for name in ('data', 'run', 'scores'))
    collect = ['collect', '--task', 'place_block_a2b_left', '--episodes', '1', '--fps', '16']
    assert main([*collect, '--width', '64', '--height', '48', '--out', data]) == 0
    few = ['--threads', '1', '--dtype', 'float32']
    assert main(['train', data, '--out', run, *few, *set_options(MINIATURE)]) == 0
    checkpoint = f'{run}/checkpoint'
    card = json.loads(Path(checkpoint, 'world_model.json').read_text())
    assert (card['fps'], card['num_frames']) == (16.0, 80)
    evaluation = ['evaluate', checkpoint, data, '--split', 'all', '--out', scores, '--steps', '1']
    assert main([*evaluation, '--no-ceiling', '--no-report', *few]) == 0
    metrics = json.loads(Path(scores, 'metrics.json').read_text())
    assert len(metrics['episodes']) == 1 and not metrics['failed']
