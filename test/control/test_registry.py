"""Controls by name; a fourth one from a file outside the package trains and predicts."""

from __future__ import annotations

from importlib.metadata import EntryPoint
import json
from pathlib import Path
import shutil
import sys

import numpy as np
import pytest

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.cli import main
from mtv_world_ros.control import registry
from mtv_world_ros.control.control import (
    ControlInputs,
    ControlOptions,
    ControlScene,
    FrameInput,
    InputLayout,
)
from mtv_world_ros.control.registry import (
    check_control_name,
    control_class,
    control_names,
    CONTROLS,
    create_control,
)
from mtv_world_ros.core import registry as core_registry
from mtv_world_ros.core.data_types import JointTrajectory
from mtv_world_ros.core.errors import CheckpointError, ConfigError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.model.card import read_card
from mtv_world_ros.model.checkpoint import checkpoint_folder
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.training.training_config import load_training_config

TINY = {
    'transformer.num_attention_heads': 2,
    'transformer.attention_head_dim': 12,
    'transformer.ffn_dim': 32,
    'transformer.num_layers': 1,
    'transformer.stem_widths': [8, 16, 16],
    'transformer.freq_dim': 16,
    'video.width': 48,
    'video.height': 40,
    'optimizer.batch_size': 1,
    'optimizer.steps': 1,
}


@pytest.fixture
def outside(tmp_path, monkeypatch):
    """A folder on the path that has the module of a control."""
    folder = tmp_path / 'elsewhere'
    folder.mkdir()
    shutil.copy(Path(__file__).with_name('own_control.py'), folder / 'somebodys_control.py')
    monkeypatch.syspath_prepend(folder)
    yield folder
    sys.modules.pop('somebodys_control', None)


def options(robot) -> ControlOptions:
    return ControlOptions(robot=robot, rendering={}, object_mask=True, num_frames=16)


def test_the_papers_control_and_its_three_baselines_are_registered():
    assert list(CONTROLS)[:4] == ['trajectory_video', 'policy2vec', 'ee_mlp', 'fast_tokens']
    assert control_names()[: len(CONTROLS)] == list(CONTROLS)


@pytest.mark.parametrize('name', CONTROLS)
@pytest.mark.parametrize('robot_name', ['yam_bimanual', 'franka'])
def test_every_control_of_the_package_makes_the_inputs_that_it_declares(name, robot_name):
    robot = load_robot(robot_path(robot_name))
    assert control_class(name).__module__.startswith('mtv_world_ros.')
    control = create_control(name, options(robot))
    middle, reach = (robot.lower + robot.upper) / 2, (robot.upper - robot.lower) / 4
    cameras = tuple(
        load_calibration(share_path('config', 'robots', robot_name, 'cameras.yaml')).values()
    )
    motions = [
        Motion.of(robot, cameras, middle + reach * np.linspace(0, share, 17)[:, None])
        for share in (0.3, 1.0)
    ]
    if control.state():
        control = control.fitted(motions)
        again = create_control(name, options(robot)).restored(control.state())
        assert again.state() == control.state()
    num_views, height, width = len(cameras), cameras[0].height, cameras[0].width
    scene = ControlScene(
        motion=motions[1],
        times=np.linspace(0, 1.6, 17),
        start_frames=np.zeros((num_views, height, width, 3), np.uint8),
        masks=np.zeros((num_views, 0, height, width), bool),
    )
    inputs = control.make(scene)
    control.layout.check(inputs, name)
    assert inputs.num_frames == 16
    assert inputs.video is None or inputs.video.dtype == np.uint8
    assert inputs.frame is None or inputs.frame.dtype == np.float32
    assert inputs.context is None or inputs.context.dtype in (np.int64, np.float32)


def test_a_vector_for_each_frame_and_the_start_is_asked_for():
    layout = InputLayout(frame=FrameInput(vector_size=2))
    layout.check(ControlInputs(num_frames=16, frame=np.zeros((17, 2), np.float32)), 'mine')
    short = ControlInputs(num_frames=16, frame=np.zeros((15, 2), np.float32))
    with pytest.raises(CheckpointError, match=r"'mine' made.*\(15, 2\).*1 \+ num_frames = 17"):
        layout.check(short, 'mine')


def test_a_name_that_is_not_registered_names_the_nearest(robot):
    with pytest.raises(ConfigError, match=r"'ee_mpl' is not registered.*did you mean 'ee_mlp'"):
        check_control_name('ee_mpl')
    with pytest.raises(ConfigError, match=r"'fast_token'.*'fast_tokens'.*video.control"):
        load_training_config('small', {'video.control': 'fast_token'})


def test_a_checkpoint_of_an_unknown_control_is_refused(tmp_path):
    shutil.copytree(checkpoint_folder('bundled'), tmp_path / 'own')
    card = tmp_path / 'own' / 'world_model.json'
    card.write_text(card.read_text().replace('trajectory_video', 'telepathy'))
    with pytest.raises(CheckpointError, match="'telepathy' is not registered"):
        read_card(tmp_path / 'own')


@pytest.mark.parametrize(
    ('target', 'said'),
    [
        ('nowhere_at_all:Control', r"No module named 'nowhere_at_all'; install the package"),
        ('somebodys_control:Nothing', "has no attribute 'Nothing'"),
        ('json:JSONDecoder', 'lacks create, make, layout'),
    ],
)
def test_a_class_that_cannot_be_used_is_refused_with_the_reason(outside, target, said):
    assert check_control_name(target) == target
    with pytest.raises(ConfigError, match=said):
        control_class(target)


def test_a_control_whose_package_is_missing_names_the_extra(monkeypatch, robot, tmp_path):
    monkeypatch.setitem(sys.modules, 'tokenizers', None)
    monkeypatch.delitem(sys.modules, 'mtv_world_ros.control.fast_tokens', raising=False)
    with pytest.raises(ConfigError, match=r"pip install 'mtv_world_ros\[fast.tokens\]'"):
        control_class('fast_tokens')
    with pytest.raises(CheckpointError, match=r'mtv_world_ros\[fast.tokens\]'):
        registry.load_control('fast_tokens', options(robot), tmp_path)


def test_a_class_that_fails_is_named(monkeypatch, robot):
    class Failing:
        layout = InputLayout(video=True)

        @classmethod
        def create(cls, options):
            raise ZeroDivisionError('of somebody else')

        def make(self, scene): ...

    monkeypatch.setattr(registry, 'control_class', lambda name: Failing)
    with pytest.raises(ConfigError, match='cannot be created.*ZeroDivisionError: of somebody'):
        create_control('own:Failing', options(robot))


@pytest.mark.parametrize(
    ('inputs', 'said'),
    [
        (ControlInputs(num_frames=4), "did not make the input 'video'"),
        (
            ControlInputs(
                num_frames=4,
                video=np.zeros((1, 5, 4, 4, 3), np.uint8),
                frame=np.zeros((5, 3), np.float32),
            ),
            "made the input 'frame'",
        ),
    ],
)
def test_inputs_that_the_layout_does_not_declare_are_refused(inputs, said):
    with pytest.raises(CheckpointError, match=said):
        InputLayout(video=True).check(inputs, 'own')


def test_an_entry_point_registers_a_control(outside, monkeypatch, robot):
    entry = EntryPoint('tool_pixels', 'somebodys_control:ToolPixels', registry.GROUP)
    monkeypatch.setattr(core_registry, 'registered', lambda group: {entry.name: entry})
    assert control_names()[-1] == 'tool_pixels'
    assert control_class('tool_pixels').__name__ == 'ToolPixels'
    assert create_control('tool_pixels', options(robot)).layout.names == ('frame',)


@pytest.mark.slow
@pytest.mark.parametrize('control', ['somebodys_control:ToolPixels', *list(CONTROLS)[1:]])
def test_any_control_trains_and_predicts(control, outside, tmp_path, robot):
    """By the command, on the bundled episode; other plans give other frames."""
    run = tmp_path / 'run'
    episodes = tmp_path / 'episodes'
    episodes.mkdir()
    (episodes / 'demo').symlink_to(share_path('resource', 'demo_episode'))
    values = {**TINY, 'video.control': control}
    command = ['train', str(episodes), '--out', str(run), '--threads', '1', '--dtype', 'float32']
    assert main([*command, *(f'--set={key}={value}' for key, value in values.items())]) == 0
    card = json.loads((run / 'checkpoint' / 'world_model.json').read_text())
    assert card['control'] == control
    pipeline = Pipeline.load(run / 'checkpoint', dtype='float32', num_threads=1)
    assert pipeline.judge.object_motion is None
    recording = load_recording(episodes / 'demo', pipeline.spec, robot)
    rest = recording.positions[0]
    goal = rest + 0.32 * np.eye(len(rest))[0]
    for tool in robot.tools:  # a control may see nothing but the grippers
        gripper = robot.joint_names.index(tool.gripper_joint)
        goal[gripper] = (tool.gripper_open + tool.gripper_closed) / 2
    frames = []
    for way in (rest, goal):
        plan = JointTrajectory(
            joint_names=robot.joint_names,
            times=np.arange(1, 17) / 5,
            positions=rest + (way - rest) * np.arange(1, 17)[:, None] / 16,
        )
        options = RolloutOptions(instruction=recording.instruction)
        episode = pipeline.begin(recording.observation(0), options)
        (chunk,) = episode.extend(plan)
        assert chunk.trajectory_video.frames.any()  # drawn for people all the same
        frames.append(chunk.video.frames)
    assert frames[0].shape == (2, 16, 40, 48, 3)
    assert not np.array_equal(*frames)


def test_the_control_of_the_page_can_be_used(robot, tmp_path, monkeypatch):
    """The file that docs/architecture.md shows."""
    page = share_path('docs', 'architecture.md').read_text()
    block = page.partition('## A control of your own')[2].partition('```python\n')[2]
    (tmp_path / 'control_of_the_page.py').write_text(block.partition('```')[0])
    monkeypatch.syspath_prepend(tmp_path)
    control = create_control('control_of_the_page:Gripper', options(robot))
    sys.modules.pop('control_of_the_page')
    motion = Motion.of(robot, (), np.stack([robot.lower, robot.upper]))
    scene = ControlScene(
        motion=motion, times=np.arange(2.0), start_frames=np.zeros((0, 4, 4, 3), np.uint8)
    )
    inputs = control.make(scene)
    control.layout.check(inputs, 'Gripper')
    assert inputs.frame is not None
    np.testing.assert_allclose(inputs.frame, motion.openings.T)
    assert inputs.num_frames == 1


def test_the_preset_paper_draws_trails_and_first_masks_and_is_small_otherwise():
    paper, small = (load_training_config(name).model_dump() for name in ('paper', 'small'))
    drawn = paper.pop('rendering')
    assert [drawn[key] for key in ('link_width_m', 'finger_width_m')] == [None, None]
    assert not drawn['object_motion'] and not drawn['arm_pictures']
    assert paper['video']['control'] == 'trajectory_video' and paper['video']['object_mask']
    assert paper == {key: value for key, value in small.items() if key != 'rendering'}


@pytest.mark.parametrize(
    ('change', 'kinds'),
    [
        ({'video.views': ['low']}, {'views': ('low',)}),
        ({'video.object_mask': False}, {'object_mask': False}),
        ({'video.control': 'policy2vec'}, {'control': 'policy2vec'}),
    ],
)
def test_each_ablation_and_baseline_is_one_value_away(change, kinds):
    card = load_training_config('paper', change).card({})
    assert {key: getattr(card, key) for key in kinds} == kinds
