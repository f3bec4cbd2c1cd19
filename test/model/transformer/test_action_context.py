"""Actions as context: they reach the output, padding does not, and frames see their own."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from diffusers import FlowMatchEulerDiscreteScheduler
import numpy as np
import pytest
from small_transformer import build, inputs, PATCH, SMALL
import torch

from mtv_world_ros.assembly import load_pipeline
from mtv_world_ros.errors import CheckpointError
from mtv_world_ros.model.actions import ActionEncoding
from mtv_world_ros.model.autoencoders import SpaceToDepthAutoencoder
from mtv_world_ros.model.card import CheckpointCard
from mtv_world_ros.model.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from mtv_world_ros.model.transformer.action_context import by_slot
from mtv_world_ros.model.transformer.block import Context
from mtv_world_ros.model.world_model import DiffusionWorldModel

ACTION_CONTROLS = ['policy2vec', 'ee_mlp', 'fast_tokens']
FRAMES, DIM = 4, 14
#: with patches nothing is merged in time, so a token frame is a video frame
KINDS = {'conv': (SMALL, {}, 0), 'patch': (PATCH, {'frames_per_token': 1}, 16)}


def actions_of(control: str, seed: int = 0, batch: int = 1) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    if control == 'fast_tokens':
        return torch.randint(0, 1024, (batch, 9), generator=generator)
    return torch.rand(batch, 1 + FRAMES, DIM, generator=generator) * 2 - 1


def model_and_inputs(kind: str, control: str, **changes):
    config, more, text_dim = KINDS[kind]
    model = build(config, control=control, action_dim=DIM, **more, **changes)
    values = inputs(frames=FRAMES, text_dim=text_dim)
    values['control'] = torch.zeros_like(values['control'])
    return model, {**values, 'actions': actions_of(control)}


@pytest.mark.parametrize('control', ACTION_CONTROLS)
def test_actions_reach_the_output_and_their_encoder_a_gradient(kind: str, control: str) -> None:
    model, values = model_and_inputs(kind, control)
    out = model(**values)
    other = model(**{**values, 'actions': actions_of(control, seed=1)})
    assert (out - other).abs().max() > 1e-4
    out.square().mean().backward()
    without = [
        name
        for name, parameter in model.named_parameters()
        if 'action_control' in name and (parameter.grad is None or not parameter.grad.any())
    ]
    assert without == []
    assert any('action_control' in name for name, _ in model.named_parameters())


@pytest.mark.parametrize('control', ACTION_CONTROLS)
def test_learns_what_only_the_actions_tell(control: str) -> None:
    """Two samples alike but for actions and outcome, +0.5 or -0.5: a blind model is 0.25 off."""
    torch.manual_seed(0)
    config: Any = {**SMALL, 'num_views': 1, 'num_layers': 1}
    model = type(build(SMALL))(**config, control=control, action_dim=2)
    target = torch.tensor([0.5, -0.5]).reshape(2, 1, 1, 1, 1, 1).expand(2, 1, 12, FRAMES, 8, 8)
    none = torch.zeros_like(target)
    actions = torch.tensor([1.0, -1.0]).reshape(2, 1, 1).expand(2, 1 + FRAMES, 2)
    if control == 'fast_tokens':
        actions = torch.tensor([[3, 7], [9, -1]])
    optimizer = torch.optim.AdamW(model.parameters(), lr=3e-3)
    losses = []
    while len(losses) < 10 or sum(losses[-10:]) / 10 >= 0.05:
        assert len(losses) < 60, losses[-10:]
        out = model(
            torch.randn(target.shape),
            torch.full((2,), 1000.0),
            control=none,
            start=none,
            reference=none[:, :, :, 0],
            start_control=none[:, :, :, 0],
            actions=actions,
        )
        loss = (out - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())


def test_the_parameters_they_share_start_alike() -> None:
    torch.manual_seed(0)
    drawn = type(build(SMALL))(**SMALL).state_dict()
    torch.manual_seed(0)
    model = type(build(SMALL))(**SMALL, control='policy2vec', action_dim=DIM)
    shared = {k: v for k, v in model.state_dict().items() if k in drawn}
    assert len(shared) == len(drawn)
    assert all(torch.equal(drawn[name], value) for name, value in shared.items())


def test_padding_of_tokens_changes_nothing(kind: str) -> None:
    model, values = model_and_inputs(kind, 'fast_tokens')
    tokens = values['actions']
    longer = torch.cat([tokens, torch.full((1, 7), -1)], dim=1)
    torch.testing.assert_close(
        model(**{**values, 'actions': longer}), model(**values), rtol=1e-5, atol=1e-6
    )


def test_the_order_of_tokens_matters() -> None:
    model, values = model_and_inputs('conv', 'fast_tokens')
    turned = {**values, 'actions': values['actions'].flip(1)}
    assert (model(**turned) - model(**values)).abs().max() > 1e-5


@pytest.mark.parametrize('frames', [1, 2, 3, 4])
def test_a_frames_cross_attention_sees_its_own_action_alone(frames: int) -> None:
    """Of `ee_mlp` with two frames a token: frames 1, 2 are slot 1, frames 3, 4 slot 2."""
    model, values = model_and_inputs('conv', 'ee_mlp')
    views, slots, places = 2, 3, 16
    attention: Any = model.blocks[0].attn2
    control: Any = model.action_control
    sequence = torch.randn(1, views * slots * places, 24)

    def attended(actions: torch.Tensor) -> torch.Tensor:
        context = control(actions, None, None, None, (slots, views))
        assert context.tokens.shape == (1, slots, 2, 24)
        return attention(sequence, context).unflatten(1, (views, slots, places))

    changed = values['actions'].clone()
    changed[:, frames] += 0.5
    moved = (attended(changed) - attended(values['actions'])).abs().amax(dim=(0, 1, 3, 4))
    slot = (frames + 1) // 2
    assert moved[slot] > 1e-4
    assert not moved[torch.arange(slots) != slot].any()


def test_a_slots_attention_is_that_of_its_view_and_place(kind: str) -> None:
    """Slot by slot, against attention over one slot's tokens and actions at a time."""
    model, values = model_and_inputs(kind, 'ee_mlp')
    attention: Any = model.blocks[0].attn2
    tokens = torch.randn(2, 3, 2, 24)
    grid = torch.randn(2, 2, 3, 5, 24)
    found = attention(grid.flatten(1, 3), Context(tokens=tokens, num_views=2)).reshape(grid.shape)
    for view in range(2):
        for slot in range(3):
            alone = Context(tokens=tokens[:, slot], num_views=1)
            torch.testing.assert_close(found[:, view, slot], attention(grid[:, view, slot], alone))


def test_actions_are_grouped_as_the_video_is() -> None:
    """81 actions and 21 latent frames of four: the first one is repeated three more times."""
    actions = torch.arange(81.0).reshape(1, 81, 1)
    groups = by_slot(actions, 21, 4)[0, ..., 0]
    assert groups[0].tolist() == [0, 0, 0, 0]
    assert groups[1].tolist() == [1, 2, 3, 4]
    assert groups[20].tolist() == [77, 78, 79, 80]
    # a reference image before them shares the start's
    with_reference = by_slot(actions, 22, 4)[0, ..., 0]
    assert with_reference[:2].tolist() == [[0, 0, 0, 0], [0, 0, 0, 0]]
    assert torch.equal(with_reference[1:], groups)
    with pytest.raises(
        CheckpointError, match='81 actions do not divide into 20 token frames of 4'
    ):
        by_slot(torch.zeros(1, 82, 1), 21, 4)


def test_dropped_actions_of_a_sample_are_as_no_actions() -> None:
    model, values = model_and_inputs('conv', 'ee_mlp')
    kept = torch.tensor([False])
    dropped = model(**values, actions_kept=kept)
    other = {**values, 'actions': actions_of('ee_mlp', seed=1)}
    assert torch.equal(model(**other, actions_kept=kept), dropped)
    assert (model(**values, actions_kept=~kept) - dropped).abs().max() > 1e-4
    assert torch.equal(model(**values, actions_kept=~kept), model(**values))


def test_one_vector_is_added_to_every_text_token() -> None:
    model, values = model_and_inputs('patch', 'policy2vec')
    text = torch.randn(1, 5, 24)
    control: Any = model.action_control
    context = control(values['actions'], None, text, None, (5, 2))
    added = context.tokens - text
    torch.testing.assert_close(added, added[:, :1].expand_as(added))
    encoder: Any = control.encoder
    net = encoder.net
    mean = values['actions'][:, 1:].mean(1)
    hidden = torch.nn.functional.gelu(mean @ net[0].weight.T + net[0].bias)
    expected = encoder.scale * (hidden @ net[2].weight.T + net[2].bias)
    torch.testing.assert_close(added[:, 0], expected)


def test_image_tokens_are_seen_beside_the_actions() -> None:
    model, values = model_and_inputs('patch', 'fast_tokens', image_dim=20, added_kv_proj_dim=24)
    values['encoder_hidden_states_image'] = torch.randn(1, 6, 20)
    out = model(**values)
    values['encoder_hidden_states_image'] = torch.randn(1, 6, 20)
    assert (model(**values) - out).abs().max() > 1e-4


def test_without_actions_or_their_size_it_says_so() -> None:
    model, values = model_and_inputs('conv', 'ee_mlp')
    values.pop('actions')
    with pytest.raises(CheckpointError, match="control 'ee_mlp' needs actions"):
        model(**values)
    with pytest.raises(CheckpointError, match='needs transformer.action_dim'):
        build(SMALL, control='ee_mlp')


@pytest.fixture(params=ACTION_CONTROLS)
def folder(request, robot, tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    chunks = [
        np.linspace(ends[0], ends[1], 1 + FRAMES)
        for ends in rng.uniform(robot.lower, robot.upper, (20, 2, DIM))
    ]
    encoding = ActionEncoding.fit(request.param, robot, chunks)
    card = {
        'views': ['low', 'high'],
        'fps': 5.0,
        'num_frames': FRAMES,
        'width': 32,
        'height': 32,
        'robot': 'yam_bimanual',
        'control': request.param,
        'object_mask': False,
        'rendering': {},
        'trained_on': {},
    }
    checkpoint = Checkpoint(
        transformer=build(SMALL, control=request.param, action_dim=DIM),
        autoencoder=SpaceToDepthAutoencoder(),
        scheduler=FlowMatchEulerDiscreteScheduler(shift=5.0),
        card=CheckpointCard(**card),
        actions=encoding,
    )
    save_checkpoint(checkpoint, tmp_path / 'checkpoint')
    return tmp_path / 'checkpoint'


def test_a_checkpoint_serves_actions_and_not_the_trajectory_video(folder: Path, robot) -> None:
    model = load_pipeline(folder, dtype='float32').world_model
    generator = np.random.default_rng(0)
    start = generator.integers(0, 255, (2, 32, 32, 3), np.uint8)

    def predict(positions: np.ndarray, drawn: int) -> np.ndarray:
        return model.predict(
            start,
            np.full((2, 1 + FRAMES, 32, 32, 3), drawn, np.uint8),
            positions=positions,
            seed=0,
            num_inference_steps=1,
            should_stop=lambda: False,
        )

    rest, raised = (
        np.linspace(robot.lower, end, 1 + FRAMES) for end in (robot.lower, robot.upper)
    )
    frames = predict(rest, drawn=0)
    assert frames.shape == (2, FRAMES, 32, 32, 3)
    assert np.array_equal(predict(rest, drawn=255), frames)
    assert not np.array_equal(predict(raised, drawn=0), frames)


def test_a_checkpoint_without_its_statistics_or_robot_is_refused(folder: Path) -> None:
    with pytest.raises(CheckpointError, match='needs the robot it was trained with'):
        DiffusionWorldModel(load_checkpoint(folder))
    (folder / 'action_statistics.json').unlink()
    with pytest.raises(CheckpointError, match='lacks the action statistics'):
        load_checkpoint(folder)


def test_a_card_with_an_unknown_control_is_refused(folder: Path) -> None:
    card = json.loads((folder / 'world_model.json').read_text())
    (folder / 'world_model.json').write_text(json.dumps({**card, 'control': 'telepathy'}))
    with pytest.raises(CheckpointError, match="'telepathy' is not one of trajectory_video"):
        load_checkpoint(folder)


@pytest.mark.parametrize(
    ('kind', 'before'),
    [
        ('conv', [0.675885, 0.661615, -0.040943, -1.929517, 2.47051, 0.747015]),
        ('patch', [0.549132, 0.565627, 0.27666, -0.853436, 0.120675, -0.203658]),
    ],
)
def test_models_of_the_trajectory_video_compute_what_they_did_before(
    kind: str, before: list[float]
) -> None:
    """Numbers written down at the commit before there were other controls (3b397e9)."""
    config, _, text_dim = KINDS[kind]
    with torch.no_grad():
        out = build(config)(**inputs(text_dim=text_dim))
    assert 'action_control' not in ' '.join(build(config).state_dict())
    found = [*out.abs().mean((0, 2, 3, 4, 5)).tolist(), *out[0, 0, :4, 1, 5, 7].tolist()]
    assert found == pytest.approx(before, abs=1e-4)
