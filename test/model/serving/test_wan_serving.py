"""An imported Wan checkpoint serves through the world model: text, images, clock, seeds."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
import shutil
from typing import Any

from diffusers import AutoencoderKLWan
import numpy as np
import pytest
import torch
from torch import Tensor

from mtv_world_ros.control.control import ControlInputs
from mtv_world_ros.core.data_types import History
from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.model.autoencoders import WanAutoencoder
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.model.conditioning import condition, ControlBatch, decode_frames, encode_chunk
from mtv_world_ros.model.encoders import ImageEncoder, TextEncoder
from mtv_world_ros.model.serving import compile_norms
from mtv_world_ros.model.trained_model import load_trained_model, TrainedModel
from mtv_world_ros.model.world_model import DiffusionWorldModel
from mtv_world_ros.training.adapter import add_adapter, save_adapter
from test.support.wan_encoder_reference import clip_tokens, umt5_encode
from test.support.wan_files import CARD, clip_weights, umt5_weights, vae_model
from test.support.wan_predictions import frames, imported, predict, T, VIEWS


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return imported(tmp_path_factory.mktemp('wan'))


def load(folder: Path, dtype: torch.dtype = torch.float32, **card: Any) -> DiffusionWorldModel:
    checkpoint: TrainedModel = load_trained_model(Checkpoint.open(folder))
    changed = replace(checkpoint, card=checkpoint.card.replace(**card))
    return DiffusionWorldModel(changed, dtype=dtype)


def test_predicts_exactly_the_cards_frames_and_another_seed_other_ones(folder: Path) -> None:
    model = load(folder)
    one, other = (predict(model, seed=seed) for seed in (3, 4))
    assert one.shape == (VIEWS, T, 32, 32, 3) and one.dtype == np.uint8
    assert np.abs(one.astype(int) - other).max() > 10


@pytest.mark.parametrize(('views', 'count'), [(VIEWS + 1, T), (VIEWS, 2 * T)])
def test_more_views_or_frames_than_trained_are_refused(
    folder: Path, views: int, count: int
) -> None:
    told = rf'{views} views of {count} frames given, .* 2 views of 4; .*video\.num_frames'
    more = {
        'start_frame': frames(views),
        'control': ControlInputs.drawn(frames(views, 1 + count)),
        'positions': np.zeros((1 + count, 14)),
    }
    with pytest.raises(CheckpointError, match=told):
        predict(load(folder), **more)


def test_bfloat16_keeps_angles_and_times_in_float32(folder: Path) -> None:
    exact, coarse = load(folder), load(folder, dtype=torch.bfloat16)
    angles = exact.transformer.rope.get_buffer('freqs_cos')
    assert torch.equal(coarse.transformer.rope.get_buffer('freqs_cos'), angles)
    precise = {n for n, p in coarse.transformer.named_parameters() if p.dtype == torch.float32}
    assert {name.split('.')[-1] for name in precise} == {'scale_shift_table', 'weight', 'bias'}
    assert all('time_embedder' in n or 'scale_shift_table' in n for n in precise)
    assert coarse.transformer.dtype == torch.bfloat16
    one, other = predict(exact), predict(coarse)
    assert np.abs(one.astype(int) - other).mean() < 3


def test_the_prompt_reaches_the_prediction(folder: Path) -> None:
    one, other = (load(folder, prompt=words) for words in ('pick the block', 'place the red'))
    assert not np.array_equal(predict(one), predict(other))


def test_text_is_encoded_once_and_images_once_each(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = load(folder)
    loads: list[object] = []
    original = TextEncoder._load
    monkeypatch.setattr(TextEncoder, '_load', lambda *a: loads.append(a) or original(*a))
    images: list[object] = []
    model.image_encoder.model.register_forward_hook(lambda *_: images.append(1))
    for seed in (0, 1):
        predict(model, seed=seed)
    assert (len(loads), len(images)) == (1, VIEWS)
    predict(model, start_frame=frames(VIEWS, seed=9))
    assert (len(loads), len(images)) == (1, 2 * VIEWS)


def test_an_adapter_in_the_checkpoint_is_used_and_can_be_taken_away(
    folder: Path, tmp_path: Path
) -> None:
    plain = load(folder)
    before = predict(plain)
    trained = load_trained_model(Checkpoint.open(folder)).transformer
    add_adapter(trained, rank=2)
    with torch.no_grad():
        for name, parameter in trained.named_parameters():
            if 'lora_B' in name:
                parameter.fill_(0.3)
    copied = Path(shutil.copytree(folder, tmp_path / 'checkpoint'))
    save_adapter(trained, copied / 'adapter')
    model = load(copied)
    assert np.abs(predict(model).astype(int) - before).max() > 1
    model.use_adapter(None)
    assert np.abs(predict(model).astype(int) - before).max() <= 1


@pytest.mark.parametrize(('scale', 'passes'), [(1.0, 1), (5.0, 2)])
def test_guidance_costs_a_second_pass_only_where_it_is_on(
    folder: Path, scale: float, passes: int
) -> None:
    model = load(folder, guidance_scale=scale)
    calls: list[object] = []
    model.transformer.register_forward_hook(lambda *_: calls.append(1))
    predict(model, steps=3)
    assert len(calls) == 3 * passes


def test_guidance_leads_from_the_negative_prompt_to_the_prompt(folder: Path) -> None:
    same = {'negative_prompt': CARD.prompt, 'guidance_scale': 5.0}
    plain, nowhere = predict(load(folder)), predict(load(folder, **same))
    assert np.abs(plain.astype(int) - nowhere).max() <= 1
    guided = predict(load(folder, negative_prompt='red', guidance_scale=5.0))
    assert np.abs(plain.astype(int) - guided).max() > 1


def test_text_tokens_are_umt5s(folder: Path) -> None:
    tokens = TextEncoder(folder).encode('pick the  block\n')
    ids = torch.tensor([3, 5, 6])  # of the tokenizer that the test wrote
    expected = umt5_encode(umt5_weights(), ids, layers=2, heads=4)
    assert tokens.shape == (1, 512, 32)
    torch.testing.assert_close(tokens[0, :3], expected, rtol=0, atol=1e-4)
    assert not tokens[0, 3:].any()


def test_image_tokens_are_clips_before_its_last_layer(folder: Path) -> None:
    image = torch.from_numpy(frames(1))[:, :8, :8]  # the size of this CLIP: nothing to resize
    tokens = ImageEncoder.load(folder).encode(image)
    pixels = image[0].movedim(-1, 0).float() / 255
    mean = torch.tensor([0.48145466, 0.4578275, 0.40821073])[:, None, None]
    std = torch.tensor([0.26862954, 0.26130258, 0.27577711])[:, None, None]
    expected = clip_tokens(clip_weights(), (pixels - mean) / std, layers=3)
    assert tokens.shape == (1, 17, 32)
    torch.testing.assert_close(tokens[0], expected, rtol=0, atol=1e-4)


@pytest.fixture(scope='module')
def autoencoder() -> WanAutoencoder:
    return WanAutoencoder(vae_model())


def video(num_frames: int, seed: int = 0) -> Tensor:
    return torch.from_numpy(frames(1, VIEWS, num_frames, seed=seed))


@torch.inference_mode()
def test_latents_are_normalised_and_undone(autoencoder: WanAutoencoder) -> None:
    # in float64: undoing what was done is exact there, on every processor
    autoencoder = copy.deepcopy(autoencoder).double()
    vae: AutoencoderKLWan = autoencoder.vae
    clip = torch.randn(1, 3, 5, 32, 32, dtype=torch.float64)
    raw = vae.encode(clip).latent_dist.mean
    latents = autoencoder.encode(clip)
    for channel in (0, 15):
        mean, std = vae.config.latents_mean[channel], vae.config.latents_std[channel]
        torch.testing.assert_close(latents[:, channel], (raw[:, channel] - mean) / std)
    torch.testing.assert_close(autoencoder.decode(latents), vae.decode(raw).sample)


@torch.inference_mode()
def test_norms_are_compiled_on_a_gpu_alone(autoencoder: WanAutoencoder) -> None:
    clip, other = torch.randn(1, 3, 5, 32, 32), copy.deepcopy(autoencoder)
    compile_norms(other)
    assert not any(m._compiled_call_impl for m in other.modules())
    assert torch.equal(other.encode(clip), autoencoder.encode(clip))


@pytest.mark.gpu
@torch.inference_mode()
def test_compiled_norms_change_nothing_beyond_rounding(autoencoder: WanAutoencoder) -> None:
    plain = copy.deepcopy(autoencoder).to('cuda')
    quick = copy.deepcopy(plain)
    compile_norms(quick)
    for size in (5, 9):
        clip = torch.rand(2, 3, size, 32, 32, device='cuda') * 2 - 1
        latents = plain.encode(clip)
        torch.testing.assert_close(quick.encode(clip), latents, rtol=0, atol=2e-2)
        torch.testing.assert_close(quick.decode(latents), plain.decode(latents), rtol=0, atol=2e-2)


@torch.inference_mode()
def test_conditioning_is_laid_out_as_wan_control_was_trained(autoencoder: WanAutoencoder) -> None:
    trajectory = video(1 + 8)
    start = video(1, seed=5)[:, :, 0]
    cond = condition(autoencoder, start, ControlBatch.drawn(trajectory))
    clean = encode_chunk(autoencoder, trajectory)
    # 1 + 8 frames are 1 + 2 latent ones: the first alone, then four each
    assert cond.control.shape == cond.start.shape == clean.shape == (1, VIEWS, 16, 3, 4, 4)
    assert torch.equal(cond.control, clean)
    assert torch.equal(cond.start[:, :, :, 0], cond.reference)
    assert not cond.start[:, :, :, 1:].any()
    single = autoencoder.encode(start[:, 1, None].movedim(-1, 1) / 127.5 - 1)
    torch.testing.assert_close(cond.reference[:, 1], single[:, :, 0])
    assert decode_frames(autoencoder, clean).shape == (1, VIEWS, 8, 32, 32, 3)


@pytest.mark.parametrize('k', [1, 4, 5, 8])
@torch.inference_mode()
def test_control_frame_k_drives_predicted_frame_k(folder: Path, k: int) -> None:
    """Without attention among tokens, a control frame reaches the latent that holds its frame.

    The autoencoder is causal, so what is before that latent's first frame stays as it was.
    """
    model = load(folder, num_frames=8)
    for name, parameter in model.transformer.named_parameters():
        if 'attn1.to_out' in name:
            parameter.zero_()
    trajectory = frames(VIEWS, 9, seed=1)
    changed = trajectory.copy()
    changed[:, k] = 255 - changed[:, k]
    one, other = (
        predict(model, control=ControlInputs.drawn(t), positions=np.zeros((9, 14)))
        for t in (trajectory, changed)
    )
    differs = (one != other).any(axis=(0, 2, 3, 4))  # predicted frames 1 .. 8
    first = 4 * ((k - 1) // 4)  # index of the first frame in the latent of frame k
    assert not differs[:first].any()
    assert differs[first : first + 4].any()


@pytest.mark.parametrize(
    ('card', 'message'),
    [
        ({'num_frames': 6}, r'num_frames 6 .* multiple of 4'),
        ({'width': 40}, r'frames of 40x32 do not divide into tokens of 16x16 pixels'),
    ],
)
def test_a_chunk_that_does_not_divide_is_refused(folder: Path, card: dict, message: str) -> None:
    with pytest.raises(CheckpointError, match=message):
        load(folder, **card)


def test_a_checkpoint_without_its_tokenizer_is_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / 'text_encoder').mkdir()
    with pytest.raises(CheckpointError, match="has no folder 'tokenizer/'"):
        TextEncoder(tmp_path)


def test_five_frames_of_history_are_encoded_anew_as_two_latents(folder: Path) -> None:
    settings = {'num_frames': 5, 'noise_level': 0.05, 'reference': 'first_frame'}
    model = load(folder, history=settings)
    shapes: list[torch.Size] = []
    model.transformer.register_forward_pre_hook(
        lambda _, __, given: shapes.append(given['history'].shape), with_kwargs=True
    )
    begun = predict(model, steps=1)
    past = History(anchor=frames(VIEWS), frames=frames(VIEWS, 5, seed=6))
    later = predict(model, steps=1, history=past)
    assert begun.shape == later.shape == (VIEWS, T, 32, 32, 3)
    assert set(shapes) == {(1, VIEWS, 16, 2, 4, 4)}
    assert np.abs(begun.astype(int) - later).max() > 1
    with pytest.raises(CheckpointError, match='num_frames to one more than a multiple of 4'):
        load(folder, history={**settings, 'num_frames': 4})
