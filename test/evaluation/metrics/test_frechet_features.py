"""Feature networks against other codes that were given the same weights.

The expected numbers were printed by FeatureExtractorInceptionV3 of torch-fidelity 0.4.0 and by
InceptionI3d of piergiaj/pytorch-i3d, each loaded (strictly) with `drawn` weights.
"""

import hashlib

import numpy as np
import pytest
from safetensors.torch import save_file
import torch

from mtv_world_ros.core.errors import CheckpointError, ConfigError, EpisodeError
from mtv_world_ros.evaluation.metrics.frechet_features import clip_features, frame_features, I3D
from mtv_world_ros.evaluation.metrics.inception import InceptionV3

#: of the references' sorted names and shapes
INCEPTION_LAYOUT, I3D_LAYOUT = 'd84f693f2abd7fea', 'a8c1201808a09152'


def drawn(network, seed=7):
    """Weights from a generator that is the same everywhere, in the order of their names."""
    rng, state = np.random.default_rng(seed), {}
    shapes = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    for key in sorted(shapes):
        shape = shapes[key]
        if key.endswith('num_batches_tracked'):
            state[key] = torch.zeros((), dtype=torch.int64)
            continue
        if key.endswith(('running_var', 'bn.weight')):
            values = rng.uniform(0.5, 1.5, shape)
        elif len(shape) > 1:
            values = rng.standard_normal(shape, np.float32) * np.sqrt(2 / np.prod(shape[1:]))
        else:
            values = 0.1 * rng.standard_normal(shape)
        state[key] = torch.from_numpy(np.asarray(values, np.float32))
    return state


def layout(state):
    lines = [f'{k} {tuple(v.shape)}' for k, v in sorted(state.items()) if 'tracked' not in k]
    return hashlib.sha256('\n'.join(lines).encode()).hexdigest()[:16]


@pytest.fixture(scope='module')
def inception_file(tmp_path_factory):
    state = drawn(InceptionV3())
    assert layout(state) == INCEPTION_LAYOUT
    path = tmp_path_factory.mktemp('fid') / 'weights.pth'
    torch.save({k: v for k, v in state.items() if 'tracked' not in k}, path)
    return path


@pytest.fixture(scope='module')
def i3d_file(tmp_path_factory):
    state = drawn(I3D())
    assert layout(state) == I3D_LAYOUT
    path = tmp_path_factory.mktemp('fvd') / 'weights.pt'
    torch.save(state, path)
    return path


def test_inception_gives_the_features_of_torch_fidelity(inception_file):
    frames = np.random.default_rng(8).integers(0, 256, (2, 72, 96, 3), np.uint8)
    frames[1] = frames[1] // 8 * 4 + np.arange(96)[None, :, None]
    found = frame_features(inception_file)(frames)
    assert found.shape == (2, 2048)
    first = [0.022991622, 0.0, 1.672899246, 0.0, 3.117457390, 2.446251392]
    second = [0.009615379, 0.0, 1.319485426, 0.0, 2.026948452, 2.350410223]
    assert found[0, :6] == pytest.approx(first, abs=1e-4)
    assert found[1, :6] == pytest.approx(second, abs=1e-4)
    assert found.mean(1) == pytest.approx([3.423897267, 2.499116898], abs=1e-4)
    assert found.std(1, ddof=1) == pytest.approx([4.755863667, 3.467065573], abs=1e-4)


def test_i3d_gives_the_logits_of_pytorch_i3d(i3d_file):
    clip = np.random.default_rng(8).integers(0, 256, (10, 72, 96, 3), np.uint8)
    clip = clip // 8 * 4 + np.arange(96, dtype=np.uint8)[:, None]
    features = clip_features(i3d_file)
    found = features(clip)
    assert found.shape == (1, 400)
    first = [1.510888934, -0.144323453, 2.025957585, 3.855972767, 1.361564279, -2.249310255]
    assert found[0, :6] == pytest.approx(first, abs=1e-3)
    assert found.mean() == pytest.approx(0.225188002, abs=1e-4)
    with pytest.raises(EpisodeError, match='at least 9 frames, this one has 8'):
        features(clip[:8])


def test_weights_that_are_not_there_are_not_downloaded(tmp_path):
    with pytest.raises(ConfigError, match="fid_weights '.*x.pth' does not exist"):
        frame_features(tmp_path / 'x.pth')
    with pytest.raises(ConfigError, match="fvd_weights '.*x.pt' does not exist"):
        clip_features(tmp_path / 'x.pt')


def test_weights_of_another_network_are_refused(inception_file):
    with pytest.raises(CheckpointError, match='is not a I3D: it lacks'):
        clip_features(inception_file)


@pytest.mark.filterwarnings('ignore')  # torch warns of its own file formats
def test_pickles_and_torchscript_are_refused(tmp_path):
    module = torch.nn.Linear(2, 2)
    torch.save(module, tmp_path / 'module.pt')
    with pytest.raises(CheckpointError, match='state_dict'):
        frame_features(tmp_path / 'module.pt')
    torch.jit.trace(module, torch.zeros(1, 2)).save(tmp_path / 'script.pt')
    with pytest.raises(CheckpointError, match='TorchScript'):
        clip_features(tmp_path / 'script.pt')


@pytest.mark.parametrize('suffix', ['.pth', '.safetensors'])
def test_weights_that_are_no_numbers_are_refused(inception_file, tmp_path, suffix):
    state = torch.load(inception_file, weights_only=True)
    name = next(name for name, tensor in state.items() if tensor.ndim > 1)
    state[name].reshape(-1)[0] = float('nan')
    file = tmp_path / f'weights{suffix}'
    if suffix == '.pth':
        torch.save(state, file)
    else:
        save_file(state, file)
    with pytest.raises(CheckpointError, match=f"tensor '{name}'.* holds 1 of"):
        frame_features(file)


def test_a_damaged_safetensors_file_is_refused_in_words(tmp_path):
    (tmp_path / 'weights.safetensors').write_bytes(b'\xff' * 40)
    with pytest.raises(CheckpointError, match="fid_weights '.*weights.safetensors' cannot be"):
        frame_features(tmp_path / 'weights.safetensors')
