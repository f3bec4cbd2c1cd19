"""Numbers that once were read and judged: each is refused, and the error names it."""

from __future__ import annotations

import json
import shutil
from xml.etree import ElementTree

import pytest
from safetensors.torch import load_file, save_file
import torch
import yaml

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.cli import main
from mtv_world_ros.core.bounded_input import check_finite
from mtv_world_ros.core.errors import CalibrationError, CheckpointError, ConfigError, RobotError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.model.trained_model import load_trained_model
from mtv_world_ros.physics.checkpoint_files import load_contact
from mtv_world_ros.robot.file import load_robot
from robustness.folder_kinds import FOLDERS
from test.support.wan_files import AUTOENCODER, SCHEDULER, TRANSFORMER, write_videox


@pytest.mark.parametrize('value', [float('nan'), float('inf'), -float('inf')])
def test_a_tensor_with_one_value_that_is_no_number_is_not_loaded(tmp_path, value):
    shutil.copytree(share_path('resource', 'checkpoint'), tmp_path / 'copy')
    file = tmp_path / 'copy' / 'autoencoder' / 'diffusion_pytorch_model.safetensors'
    tensors = load_file(file)
    name = next(name for name, tensor in tensors.items() if tensor.is_floating_point())
    tensors[name].reshape(-1)[-1] = value
    save_file(tensors, file)
    with pytest.raises(CheckpointError, match=f"tensor '{name}'.* holds 1 of"):
        load_trained_model(Checkpoint.open(tmp_path / 'copy'))


def test_sums_that_are_too_large_are_not_taken_for_values_that_are_no_numbers(tmp_path):
    check_finite(torch.full((4,), 3e38), 'a', tmp_path)
    check_finite(torch.full((4,), 6e4, dtype=torch.float16), 'a', tmp_path)
    check_finite(torch.ones(4).to(torch.float8_e4m3fn), 'a', tmp_path)
    check_finite(torch.ones(4, dtype=torch.int64), 'a', tmp_path)
    with pytest.raises(CheckpointError, match="'a'.* holds 2 of 4"):
        check_finite(torch.tensor([3e38, 3e38, float('inf'), float('nan')]), 'a', tmp_path)


@pytest.mark.parametrize('key', ['finger_stiffness', 'density', 'pad_stiffness', 'tray_kg'])
def test_contact_of_no_matter_is_refused(tmp_path, key):
    values = json.loads(
        share_path('resource', 'checkpoint', 'object_motion', 'contact.json').read_text()
    )
    (tmp_path / 'contact.json').write_text(json.dumps(values | {key: 1e12}))
    with pytest.raises(CheckpointError, match=f"'{key}' is 1000000000000.0, must be at most"):
        load_contact(tmp_path)


def _camera(**changes):
    view = {'width': 96, 'height': 72, 'K': [90.0, 90.0, 47.5, 35.5], 'mount_link': 'base',
            'position': [0, 1, 1], 'quaternion_xyzw': [0, 0, 0, 1]}  # fmt: skip
    return yaml.safe_dump({'views': {'low': view | changes}})


@pytest.mark.parametrize(
    ('text', 'says'),
    [
        (_camera(width=True), 'width True is not|width.* whole number'),
        (_camera(position=[0, 1e308, 1]), 'position'),
        ('views: {}', 'has no view'),
    ],
)
def test_cameras_that_are_none_are_refused(tmp_path, text, says):
    (tmp_path / 'c.yaml').write_text(text)
    with pytest.raises(CalibrationError, match=says):
        load_calibration(tmp_path / 'c.yaml')


def test_a_whole_camera_is_read(tmp_path):
    (tmp_path / 'c.yaml').write_text(_camera())
    assert load_calibration(tmp_path / 'c.yaml')['low'].width == 96


def test_tools_and_joints_out_of_all_reach_are_refused(tmp_path):
    for name in ('robot.yaml', 'yam_bimanual.urdf'):
        shutil.copy(share_path('config', 'robots', 'yam_bimanual', name), tmp_path)
    file = tmp_path / 'robot.yaml'
    values = yaml.safe_load(file.read_text())
    values['tools'][0]['position'] = [0.0, 0.0, 1e308]
    file.write_text(yaml.safe_dump(values))
    with pytest.raises(ConfigError, match=r'position.* must be at most 100'):
        load_robot(file)
    shutil.copy(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'), tmp_path)
    urdf = tmp_path / 'yam_bimanual.urdf'
    tree = ElementTree.parse(urdf)
    origins = (origin for joint in tree.iter('joint') for origin in joint.iter('origin'))
    next(origins).set('xyz', '1e30 0 0')
    tree.write(urdf)
    with pytest.raises(RobotError, match='at most 100 m are accepted'):
        load_robot(file)


def _spoil(file, value=float('nan')):
    tensors = load_file(file)
    name = max(tensors, key=lambda name: tensors[name].numel())
    tensors[name].reshape(-1)[-1] = value
    save_file(tensors, file)


@pytest.mark.parametrize('kind', ['LoRA', 'weights in shards'])
def test_factors_and_shards_with_a_value_that_is_no_number_are_not_read(tmp_path, kind):
    make, _, read = FOLDERS[kind]
    make(tmp_path)
    read(tmp_path)
    _spoil(sorted(tmp_path.glob('*.safetensors'))[-1])
    with pytest.raises(CheckpointError, match='that are no finite numbers'):
        read(tmp_path)


def test_public_weights_with_a_value_that_is_no_number_are_not_imported(tmp_path, capsys):
    public = write_videox(tmp_path / 'public')
    sections = {'transformer': TRANSFORMER, 'autoencoder': AUTOENCODER, 'scheduler': SCHEDULER}
    video = {'num_frames': 4, 'width': 32, 'height': 32}
    (tmp_path / 'tiny.yaml').write_text(yaml.safe_dump({**sections, 'video': video}))
    words = ['import', 'wan', str(public), '--preset', str(tmp_path / 'tiny.yaml'), '--out']
    assert main([*words, str(tmp_path / 'whole')]) == 0
    files = sorted(public.rglob('*.safetensors'))
    assert len(files) == 4
    for file in files:
        whole = file.read_bytes()
        _spoil(file)
        capsys.readouterr()
        assert main([*words, str(tmp_path / 'out')]) == 1, file.name
        assert 'that are no finite numbers' in capsys.readouterr().err
        assert not (tmp_path / 'out').exists()
        file.write_bytes(whole)
