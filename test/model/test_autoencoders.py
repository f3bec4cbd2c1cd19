"""The tiny one computes what TAEHV's published layout says; the rearranging one loses nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
from safetensors.torch import save_file
import torch
from torch import Tensor
import torch.nn.functional as F

from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.model.autoencoders import SpaceToDepthAutoencoder, TinyAutoencoder
from mtv_world_ros.model.conditioning import condition, ControlBatch, decode_frames, encode_frames

Weights = dict[str, Tensor]


def shapes() -> dict[str, tuple[int, ...]]:
    """Names and shapes in `taew2_1.safetensors`: index in the sequence, then the layer's own."""
    found: dict[str, tuple[int, ...]] = {}

    def conv(name: str, outputs: int, inputs: int, size: int = 3, bias: bool = True) -> None:
        found[f'{name}.weight'] = (outputs, inputs, size, size)
        if bias:
            found[f'{name}.bias'] = (outputs,)

    def memory(name: str, width: int) -> None:
        conv(f'{name}.conv.0', width, 2 * width)
        conv(f'{name}.conv.2', width, width)
        conv(f'{name}.conv.4', width, width)

    conv('encoder.0', 64, 3)
    for first, merged in ((2, 2), (7, 2), (12, 1)):
        conv(f'encoder.{first}.conv', 64, 64 * merged, size=1, bias=False)
        conv(f'encoder.{first + 1}', 64, 64, bias=False)
        for index in (2, 3, 4):
            memory(f'encoder.{first + index}', 64)
    conv('encoder.17', 16, 64)
    conv('decoder.1', 256, 16)
    for first, width, after, grown in ((3, 256, 128, 1), (9, 128, 64, 2), (15, 64, 64, 2)):
        for index in (0, 1, 2):
            memory(f'decoder.{first + index}', width)
        conv(f'decoder.{first + 4}.conv', width * grown, width, size=1, bias=False)
        conv(f'decoder.{first + 5}', after, width, bias=False)
    conv('decoder.22', 3, 64)
    return found


@pytest.fixture(scope='module')
def weights() -> Weights:
    generator = torch.Generator().manual_seed(0)
    return {
        name: torch.randn(shape, generator=generator)
        / max(1, torch.Size(shape[1:]).numel()) ** 0.5
        for name, shape in shapes().items()
    }


@pytest.fixture(scope='module')
def file(weights, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp('tiny') / 'taew2_1.safetensors'
    save_file(weights, path)
    return path


@pytest.fixture(scope='module')
def tiny(file) -> TinyAutoencoder:
    return TinyAutoencoder.load(file)


class Reference:
    """One frame after the other through one sequence, as a stream would come."""

    def __init__(self, weights: Weights, prefix: str) -> None:
        self.weights, self.prefix = weights, prefix
        self.last: dict[int, Tensor] = {}
        self.waiting: dict[int, list[Tensor]] = {}
        self.out: list[Tensor] = []

    def conv(self, name: str, x: Tensor, stride: int = 1) -> Tensor:
        weight = self.weights[f'{self.prefix}.{name}.weight']
        bias = self.weights.get(f'{self.prefix}.{name}.bias')
        return F.conv2d(x, weight, bias, stride=stride, padding=weight.shape[-1] // 2)

    def memory(self, index: int, x: Tensor) -> Tensor:
        before = self.last.get(index, torch.zeros_like(x))
        self.last[index] = x
        y = self.conv(f'{index}.conv.0', torch.cat([x, before], 1)).relu()
        y = self.conv(f'{index}.conv.2', y).relu()
        return (self.conv(f'{index}.conv.4', y) + x).relu()

    def encode(self, x: Tensor) -> None:
        x = self.conv('0', x).relu()
        for first, merged in ((2, 2), (7, 2), (12, 1)):
            waiting = self.waiting.setdefault(first, [])
            waiting.append(x)
            if len(waiting) < merged:
                return
            x = self.conv(f'{first}.conv', torch.cat(waiting, 1))
            waiting.clear()
            x = self.conv(f'{first + 1}', x, stride=2)
            for index in (2, 3, 4):
                x = self.memory(first + index, x)
        self.out.append(self.conv('17', x))

    def decode(self, x: Tensor, first: int = 3) -> None:
        if first == 3:
            x = self.conv('1', torch.tanh(x / 3) * 3).relu()
        for index in (0, 1, 2):
            x = self.memory(first + index, x)
        x = self.conv(f'{first + 4}.conv', F.interpolate(x, scale_factor=2))
        for frame in x.chunk(1 if first == 3 else 2, dim=1):
            y = self.conv(f'{first + 5}', frame)
            if first < 15:
                self.decode(y, first + 6)
            else:
                self.out.append(self.conv('22', y.relu()))


@pytest.mark.parametrize('latent_frames', [1, 8])  # 8 are more than are decoded together
@torch.inference_mode()
def test_decodes_as_the_published_layout_does(tiny, weights, latent_frames):
    latents = 2 * torch.randn(2, 16, latent_frames, 1, 2)
    reference = Reference(weights, 'decoder')
    for frame in latents.unbind(2):
        reference.decode(frame)
    expected = torch.stack(reference.out[3:], 2).clamp(0, 1) * 2 - 1
    video = tiny.decode(latents)
    assert video.shape == (2, 3, 1 + 4 * (latent_frames - 1), 8, 16)
    assert (video.abs() < 1).float().mean() > 0.05  # not all clamped
    torch.testing.assert_close(video, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize('frames', [1, 29])
@torch.inference_mode()
def test_encodes_as_the_published_layout_does(tiny, weights, frames):
    video = torch.rand(2, 3, frames, 8, 16) * 2 - 1
    reference = Reference(weights, 'encoder')
    for frame in (video / 2 + 0.5).unbind(2):
        reference.encode(frame)
    for _ in range(3):  # the last frame stands for what is missing of a group of four
        reference.encode(video[:, :, -1] / 2 + 0.5)
    latents = tiny.encode(video)
    assert latents.shape == (2, 16, 1 + frames // 4, 1, 2)
    torch.testing.assert_close(latents, torch.stack(reference.out, 2), rtol=0, atol=1e-4)


def test_a_layer_that_grew_more_frames_gives_its_last(weights, tmp_path):
    name = 'decoder.7.conv.weight'
    save_file(
        {**weights, name: torch.cat([weights[name] + 1, weights[name]])},
        tmp_path / 'a.safetensors',
    )
    loaded = TinyAutoencoder.load(tmp_path / 'a.safetensors')
    assert torch.equal(loaded.state_dict()[name], weights[name])


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'decoder.22.bias': None}, "lacks 'decoder.22.bias'; expected taew2_1"),
        ({'decoder.23.bias': torch.zeros(3)}, "has an unknown tensor 'decoder.23.bias'"),
        # taew2_2: 48 latent channels
        (
            {'decoder.1.weight': torch.zeros(256, 48, 3, 3)},
            r'\[256, 48, 3, 3\], expected \[256, 16,',
        ),
    ],
)
def test_weights_of_another_model_are_refused(weights, tmp_path, change, message):
    changed = {name: t for name, t in {**weights, **change}.items() if t is not None}
    save_file(changed, tmp_path / 'other.safetensors')
    with pytest.raises(CheckpointError, match=message):
        TinyAutoencoder.load(tmp_path / 'other.safetensors')


@pytest.mark.parametrize(
    ('name', 'message'),
    [('taew2_1.pth', 'pickle'), ('missing.safetensors', 'missing.safetensors')],
)
def test_pickles_and_missing_files_are_refused(tmp_path, name, message):
    if name.endswith('.pth'):
        torch.save({}, tmp_path / name)
    with pytest.raises(CheckpointError, match=message):
        TinyAutoencoder.load(tmp_path / name)


def test_bytes_come_back_as_they_went_in():
    frames = torch.randint(0, 256, (2, 3, 5, 16, 24, 3), dtype=torch.uint8)
    autoencoder = SpaceToDepthAutoencoder(block_size=2)
    latents = encode_frames(autoencoder, frames)
    assert latents.shape == (2, 3, 12, 5, 8, 12)
    assert torch.equal(decode_frames(autoencoder, latents), frames)


def test_control_frame_k_stands_at_predicted_frame_k():
    """Frame 0 of the trajectory video is the start, frames 1 .. T are the predicted ones."""
    trajectory = torch.zeros(1, 1, 5, 4, 4, 3, dtype=torch.uint8)
    trajectory[:, :, 3] = 255
    autoencoder = SpaceToDepthAutoencoder()
    cond = condition(autoencoder, trajectory[:, :, 0], ControlBatch.drawn(trajectory))
    bright = cond.control.amax(dim=(0, 1, 2, 4, 5)) > 0
    assert bright.tolist() == [False, False, True, False]
    assert cond.control.shape[3] == 4
