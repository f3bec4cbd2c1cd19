"""History and anchor: tokens before the video, which reach it and never come out with it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from diffusers import FlowMatchEulerDiscreteScheduler
import numpy as np
import pytest
import torch
from torch import Tensor

from mtv_world_ros.control.control import ControlInputs
from mtv_world_ros.core.data_types import History
from mtv_world_ros.core.errors import CheckpointError, ConfigError
from mtv_world_ros.model.autoencoders import SpaceToDepthAutoencoder
from mtv_world_ros.model.card import CheckpointCard
from mtv_world_ros.model.trained_model import TrainedModel
from mtv_world_ros.model.transformer.tokens import MultiViewRotaryPosEmbed
from mtv_world_ros.model.world_model import DiffusionWorldModel
from test.support.small_transformer import build, CARD, inputs, PATCH, SMALL

CONFIGS = {'conv': (SMALL, 0), 'patch': (PATCH, 16)}


def past(views: int = 2, frames: int = 2, level: float = 100.0, seed: int = 7) -> dict:
    """Arguments of a forward pass for a history of so many latent frames."""
    generator = torch.Generator().manual_seed(seed)
    return {
        'history': torch.randn(1, views, 12, frames, 16, 16, generator=generator),
        'history_timestep': torch.tensor([level]),
    }


def given(kind: str, views: int = 2, **changes: object) -> tuple[Any, dict]:
    config, text_dim = CONFIGS[kind]
    return build(config, **changes), inputs(views=views, text_dim=text_dim)


@pytest.mark.parametrize('views', [1, 2, 3])
def test_returns_exactly_the_videos_frames_whatever_is_before(kind, views):
    model, values = given(kind, views)
    for frames in (2, 4):
        out = model(**values, **past(views, frames), anchor=values['reference'])
        assert out.shape == values['hidden_states'].shape
        assert torch.isfinite(out).all()


@pytest.mark.parametrize('views', [1, 2, 3])
def test_every_weight_learns_with_a_history_too(kind, views):
    model, values = given(kind, views, num_views=views)
    past_values = {n: v.requires_grad_() for n, v in past(views).items()}
    model(**values, **past_values).square().mean().backward()
    without = [n for n, p in model.named_parameters() if p.grad is None or not p.grad.any()]
    assert [n for n in without if not n.endswith(('to_k.bias', 'copy.to_k.bias'))] == []
    assert past_values['history'].grad.abs().amax(dim=(0, 2, 4, 5)).min() > 0


def test_history_reaches_the_video_only_through_self_attention(kind):
    """It neither leaks into the output nor changes what the video's tokens are."""
    model, values = given(kind)
    seen = model(**values, **past())
    assert not torch.allclose(seen, model(**values, **past(seed=8)), atol=1e-5)
    with torch.no_grad():
        for block in model.blocks:
            block.attn1.to_out[0].weight.zero_()
            block.attn1.to_out[0].bias.zero_()
    deaf = model(**values)
    for other in (past(), past(seed=8), past(level=900.0), past(frames=4)):
        torch.testing.assert_close(model(**values, **other), deaf, rtol=0, atol=2e-6)


@pytest.mark.parametrize('k', [0, 3])
def test_control_frame_k_drives_predicted_frame_k_behind_a_history(kind, k):
    """Without attention among tokens, it reaches its own token's frames and no others."""
    model, values = given(kind)
    with torch.no_grad():
        for block in model.blocks:
            block.attn1.to_out[0].weight.zero_()
            block.attn1.to_out[0].bias.zero_()
    behind = {**past(), 'anchor': past(seed=3)['history'][:, :, :, 0]}
    changed = {**values, 'control': values['control'].clone()}
    changed['control'][:, :, :, k] += 1.0
    apart = (model(**changed, **behind) - model(**values, **behind)).abs()
    reached = (apart.amax(dim=(0, 1, 2, 4, 5)) > 1e-6).nonzero().flatten().tolist()
    merged = {'conv': 2, 'patch': 1}[kind]  # frames of a token
    assert reached == [*range(k - k % merged, k - k % merged + merged)]


def test_the_historys_noise_level_is_its_own(kind):
    """Block 0 modulates tokens of the history by its level, all others by the video's."""
    model, values = given(kind)
    caught: list[Tensor] = []
    model.blocks[0].register_forward_pre_hook(lambda _, arguments: caught.append(arguments[2]))
    model(**values, **past(level=100.0))
    model(**values, **past(level=900.0))
    model(**values)
    low, high, plain = caught
    frames = {'conv': 1, 'patch': 2}[kind]  # the convolutional stem merges two frames
    rows = low.unflatten(1, (2, -1))  # one row for all tokens of a view's frame
    assert rows.shape[2] == frames + 1 + {'conv': 2, 'patch': 4}[kind]
    differs = (low != high).any(-1).any(-1).unflatten(1, (2, -1))[0]
    assert differs[:, :frames].all() and not differs[:, frames:].any()
    torch.testing.assert_close(rows[0, 1, -1], plain.reshape(rows.shape[-2:]))


@pytest.mark.parametrize('view_offset', ['width', 'none'])
def test_the_videos_places_are_the_same_with_and_without_history(view_offset):
    rope = MultiViewRotaryPosEmbed(12, (1, 2, 2), 64, view_offset)
    video = torch.zeros(1, 3, 5, 2, 2, 4)
    plain = [t.reshape(3, 5, 4, -1) for t in rope(video)]
    longer = torch.zeros(1, 3, 7, 2, 2, 4)
    both = [t.reshape(3, 7, 4, -1) for t in rope(longer, (-2, -1, 0, 1, 2, 3, 4))]
    for short, long in zip(plain, both, strict=True):
        assert torch.equal(long[:, 2:], short)
    # no history shares its place with a video or another view's history
    turns = torch.stack([t[..., 0, :].flatten(0, 1) for t in both], dim=1).flatten(1)
    same = torch.cdist(turns, turns) < 1e-5
    assert view_offset == 'none' or same.sum() == 21
    assert view_offset != 'none' or same.sum() == 3 * 21


def test_places_before_zero_turn_the_other_way():
    """Attention sees differences of places alone: shifting all of them changes nothing."""
    rope = MultiViewRotaryPosEmbed(12, (1, 2, 2), 64)
    grid = torch.zeros(1, 1, 3, 1, 1, 4)
    generator = torch.Generator().manual_seed(0)
    query, key = torch.randn(2, 3, 12, generator=generator)

    def scores(times: tuple[int, ...]) -> Tensor:
        cos, sin = (t.reshape(3, 12) for t in rope(grid, times))

        def turned(x: Tensor) -> Tensor:  # pairs (even, odd) are turned, as Wan does
            even, odd = x[:, ::2], x[:, 1::2]
            c, s = cos[:, ::2], sin[:, 1::2]
            return torch.stack([even * c - odd * s, even * s + odd * c], dim=-1).flatten(1)

        return turned(query) @ turned(key).T

    torch.testing.assert_close(scores((-2, -1, 0)), scores((3, 4, 5)), rtol=1e-4, atol=1e-5)
    assert not torch.allclose(scores((-2, -1, 0)), scores((2, 1, 0)), atol=1e-2)


def test_swapping_the_views_swaps_the_output_with_history(kind):
    model, values = given(kind, view_offset='none')
    with torch.no_grad():
        model.view_embedding.zero_()
    values = {**values, **past(), 'anchor': past(seed=3)['history'][:, :, :, 0]}
    swapped = {k: v.flip(1) if v.ndim >= 5 else v for k, v in values.items()}
    torch.testing.assert_close(model(**swapped), model(**values).flip(1), rtol=1e-4, atol=1e-5)


def test_the_anchor_takes_the_place_of_the_start_image_in_the_reference_tokens(kind):
    model, values = given(kind)
    other = past(seed=3)['history'][:, :, :, 0]
    assert not torch.allclose(model(**values, anchor=other), model(**values), atol=1e-5)
    if kind == 'patch':  # phi alone sees the reference there
        swapped = {**values, 'reference': other}
        assert torch.equal(model(**values, anchor=other), model(**swapped))


def test_the_start_image_enters_as_reference_and_in_its_channel_slot():
    model, values = given('patch')
    before = model(**values)
    for name in ('start', 'reference'):
        assert not torch.equal(model(**{**values, name: values[name] + 1.0}), before), name


def test_an_unknown_start_image_is_refused():
    with pytest.raises(CheckpointError, match="start_image 'none' is not one of both, ei"):
        build(PATCH, start_image='none')


SETTINGS = {'num_frames': 4, 'noise_level': 0.1, 'reference': 'first_frame'}


def world_model(**card: object) -> DiffusionWorldModel:
    return DiffusionWorldModel(
        TrainedModel(
            transformer=build(SMALL),
            autoencoder=SpaceToDepthAutoencoder(),
            scheduler=FlowMatchEulerDiscreteScheduler(shift=5.0),
            card=CheckpointCard(**{**CARD, **card}),
        )
    )


def frames(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (*shape, 32, 32, 3), np.uint8)


def predict(model: DiffusionWorldModel, history: History | None):
    return model.predict(
        frames(2),
        ControlInputs.drawn(frames(2, 5, seed=1)),
        seed=0,
        num_inference_steps=1,
        should_stop=lambda: False,
        history=history,
    )


def test_a_model_without_history_takes_no_notice_of_one():
    model = world_model()
    history = History(anchor=frames(2, seed=5), frames=frames(2, 4, seed=6))
    assert np.array_equal(predict(model, history), predict(model, None))


def test_the_first_chunk_is_one_of_a_rollout_that_just_began():
    model = world_model(history=SETTINGS)
    assert model.spec.num_history == 4
    began = History.begin(frames(2))
    assert np.array_equal(predict(model, None), predict(model, began))
    moved = replace(began, anchor=frames(2, seed=5))
    assert not np.array_equal(predict(model, None), predict(model, moved))


def test_history_frames_are_seen_and_few_are_filled_up_with_the_oldest():
    model = world_model(history=SETTINGS)
    seen = frames(2, 4, seed=6)

    def after(kept: np.ndarray) -> np.ndarray:
        return predict(model, History(anchor=frames(2), frames=kept))

    assert not np.array_equal(after(seen), after(frames(2, 4, seed=9)))
    assert np.array_equal(after(seen[:, 2:]), after(seen[:, [2, 2, 2, 3]]))


@pytest.mark.parametrize(
    ('changes', 'match'),
    [
        ({'num_frames': 3}, 'num_frames to a multiple of 2'),
        ({'num_frames': -1}, "'num_frames' is -1"),
        ({'noise_level': 1.0}, 'at least 0 and below 1'),
        ({'reference': 'last'}, "'last'; valid are chunk_start, first_frame"),
        ({'frames': 4}, "history: unknown key 'frames'"),
    ],
)
def test_settings_that_cannot_be_are_refused(changes, match):
    with pytest.raises((CheckpointError, ConfigError), match=match):
        world_model(history={**SETTINGS, **changes})


def test_settings_are_off_where_the_card_has_none():
    history = CheckpointCard(**CARD).history
    assert not history.on and history.as_card() == {}
