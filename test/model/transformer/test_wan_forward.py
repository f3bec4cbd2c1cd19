"""The transformer computes what Wan2.1-Fun-V1.1-Control computes, and its views are alike."""

from __future__ import annotations

from pathlib import Path

import pytest
from safetensors.torch import save_file
import torch
from torch import Tensor

from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.model.tensor_files import open_tensors
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from mtv_world_ros.model.wan_keys import transformer_keys
from test.support.wan_files import (
    CLIP_DIM,
    HEADS,
    LAYERS,
    TEXT_DIM,
    TRANSFORMER,
    transformer_weights,
)
from test.support.wan_reference import wan_forward

FRAMES, SIZE = 3, 8


def build(folder: Path, **changes: object) -> MultiViewWanTransformer:
    """The class under test with the tensors of a published file."""
    save_file(transformer_weights(), folder / 'wan.safetensors')
    stored = open_tensors(folder / 'wan.safetensors')
    takes = transformer_keys(stored).takes
    model = MultiViewWanTransformer(**{**TRANSFORMER, **changes})
    tensors = {name: stored[take.source].read() for name, take in takes.items()}
    missing, unexpected = model.load_state_dict(tensors, strict=False)
    assert (missing, unexpected) == (['view_embedding'], [])
    return model.eval()


def inputs(views: int, batch: int = 1, seed: int = 0) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    start = torch.zeros(batch, views, 16, FRAMES, SIZE, SIZE)
    start[:, :, :, 0] = random(batch, views, 16, SIZE, SIZE)
    text = random(batch, 512, TEXT_DIM)
    text[:, 20:] = 0
    return {
        'hidden_states': random(batch, views, 16, FRAMES, SIZE, SIZE),
        'timestep': torch.tensor([250.0, 900.0])[:batch],
        'control': random(batch, views, 16, FRAMES, SIZE, SIZE),
        'start': start,
        'reference': random(batch, views, 16, SIZE, SIZE),
        'encoder_hidden_states': text,
        'encoder_hidden_states_image': random(batch, views * 257, CLIP_DIM),
    }


def test_forward_equals_the_published_tensor_flow(tmp_path):
    values = inputs(views=1, batch=2)
    expected = wan_forward(
        transformer_weights(),
        noisy=values['hidden_states'][:, 0],
        control=values['control'][:, 0],
        start=values['start'][:, 0],
        reference=values['reference'][:, 0],
        timestep=values['timestep'],
        text=values['encoder_hidden_states'],
        image=values['encoder_hidden_states_image'],
        num_heads=HEADS,
        num_layers=LAYERS,
    )
    with torch.inference_mode():
        out = build(tmp_path)(**values)[:, 0]
    assert expected.std() > 0.1  # no trivial agreement
    torch.testing.assert_close(out, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize('views', [1, 2, 3])
@pytest.mark.parametrize('view_offset', ['width', 'none'])
def test_forward_and_backward_with_any_number_of_views(tmp_path, views, view_offset):
    model = build(tmp_path, view_offset=view_offset)
    values = inputs(views)
    out = model(**values)
    assert out.shape == values['hidden_states'].shape
    out.square().mean().backward()
    for name, parameter in model.named_parameters():
        # a key's bias moves all scores of a query alike, but for the norm behind it
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.any(), name


def swapped(values: dict[str, Tensor]) -> dict[str, Tensor]:
    other = {k: v.flip(1) if v.ndim >= 5 else v for k, v in values.items()}
    image = values['encoder_hidden_states_image'].unflatten(1, (-1, 257))
    return {**other, 'encoder_hidden_states_image': image.flip(1).flatten(1, 2)}


@torch.inference_mode()
def test_swapping_views_swaps_their_outputs_where_positions_are_equal(tmp_path):
    values = inputs(views=2)
    model = build(tmp_path, view_offset='none')
    torch.testing.assert_close(
        model(**swapped(values)), model(**values).flip(1), rtol=1e-4, atol=1e-5
    )
    model.view_embedding[1] = torch.linspace(-1, 1, model.view_embedding.shape[1])
    assert not torch.allclose(model(**swapped(values)), model(**values).flip(1), atol=1e-3)


@torch.inference_mode()
def test_positions_tell_views_apart(tmp_path):
    values = inputs(views=2)
    model = build(tmp_path, view_offset='width')
    assert not torch.allclose(model(**swapped(values)), model(**values).flip(1), atol=1e-3)


@torch.inference_mode()
def test_the_first_view_stands_where_wans_only_one_does(tmp_path):
    """What public weights learnt of positions holds for view 0, whatever the other views."""
    for offset in ('width', 'none'):
        rope = build(tmp_path, view_offset=offset).rope
        count = (1 + FRAMES) * 4 * 4
        single = rope(torch.empty(1, 1, 1 + FRAMES, 4, 4, 1))
        double = rope(torch.empty(1, 2, 1 + FRAMES, 4, 4, 1))
        assert torch.equal(single[0], double[0][:, :count])
        assert torch.equal(single[0], double[0][:, count:]) == (offset == 'none')


@torch.inference_mode()
def test_output_of_a_latent_frame_comes_from_its_own_tokens(tmp_path):
    """Without self-attention: control latent k reaches output latent k alone, the reference none.

    So neither the reference's tokens nor a shift by one frame can hide in the output.
    """
    model = build(tmp_path)
    for name, parameter in model.named_parameters():
        if 'attn1.to_out' in name:
            parameter.zero_()
    values = inputs(views=2)
    before = model(**values)
    for k in range(FRAMES):
        control = values['control'].clone()
        control[:, 1, :, k] += 1.0
        changed = (model(**{**values, 'control': control}) != before).any(dim=5).any(dim=4)
        expected = torch.zeros(1, 2, FRAMES, dtype=torch.bool)
        expected[:, 1, k] = True
        assert torch.equal(changed.any(dim=2), expected)
    reference = model(**{**values, 'reference': values['reference'] + 1.0})
    assert torch.equal(reference, before)


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'encoder_hidden_states': None}, 'no text tokens given, the model takes 512'),
        ({'encoder_hidden_states': torch.zeros(1, 77, TEXT_DIM)}, '77 text tokens given'),
        ({'encoder_hidden_states_image': None}, 'no image tokens given for 2 views'),
        ({'encoder_hidden_states_image': torch.zeros(1, 257, CLIP_DIM)}, '257 image tokens'),
    ],
)
def test_tokens_that_attention_would_split_wrongly_are_refused(tmp_path, change, message):
    with pytest.raises(CheckpointError, match=message):
        build(tmp_path)(**{**inputs(views=2), **change})


def test_more_than_the_positions_hold_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match=r'reach position 8, the model has 7'):
        build(tmp_path, rope_max_seq_len=7)(**inputs(views=2))
    with pytest.raises(CheckpointError, match="view_offset 'height' is not one of width"):
        build(tmp_path, view_offset='height')
