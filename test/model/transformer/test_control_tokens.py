"""Inputs of a control as tokens: they reach the output, padding does not, frames see their own."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import pytest
import torch

from mtv_world_ros.control.control import ContextInput, FrameInput, InputLayout
from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.model.conditioning import pad_rows
from mtv_world_ros.model.transformer.control_tokens import by_slot, Context, ControlTokens
from test.support.small_transformer import build, inputs, PATCH, SMALL

FRAMES, SIZE = 4, 14
#: with patches nothing is merged in time, so a token frame is a video frame
KINDS = {'conv': (SMALL, {}, 0), 'patch': (PATCH, {'frames_per_token': 1}, 16)}
LAYOUTS = {
    'added': InputLayout(context=ContextInput(vector_size=SIZE, joins='add', hidden_size=1280)),
    'indices': InputLayout(context=ContextInput(vocabulary=1024)),
    'vectors': InputLayout(context=ContextInput(vector_size=SIZE)),
    'frame': InputLayout(frame=FrameInput(vector_size=SIZE)),
    'all': InputLayout(
        video=True,
        context=ContextInput(vocabulary=1024),
        frame=FrameInput(vector_size=SIZE, hidden_size=16),
    ),
}


def values_of(layout: InputLayout, seed: int = 0, batch: int = 1) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    values = {}
    if layout.context is not None and layout.context.vocabulary:
        values['control_context'] = torch.randint(0, 1024, (batch, 9), generator=generator)
    elif layout.context is not None:
        values['control_context'] = torch.rand(batch, 2, SIZE, generator=generator) * 2 - 1
    if layout.frame is not None:
        values['control_frame'] = torch.rand(batch, 1 + FRAMES, SIZE, generator=generator) * 2 - 1
    return values


def model_and_inputs(kind: str, name: str, **changes):
    config, more, text_dim = KINDS[kind]
    layout = LAYOUTS[name]
    model = build(config, **layout.transformer_arguments(), **more, **changes)
    values = inputs(frames=FRAMES, text_dim=text_dim)
    if not layout.video:
        values['control'] = torch.zeros_like(values['control'])
    return model, {**values, **values_of(layout)}


@pytest.mark.parametrize('name', LAYOUTS)
def test_each_input_reaches_the_output_and_its_embedding_a_gradient(kind, name):
    model, values = model_and_inputs(kind, name)
    out = model(**values)
    for key, other in values_of(LAYOUTS[name], seed=1).items():
        assert (out - model(**{**values, key: other})).abs().max() > 1e-5, key
    if LAYOUTS[name].video:
        other = {**values, 'control': values['control'].flip(-1)}
        assert (out - model(**other)).abs().max() > 1e-4
    out.square().mean().backward()
    without = [
        part
        for part, parameter in model.named_parameters()
        if 'control_tokens' in part and (parameter.grad is None or not parameter.grad.any())
    ]
    assert without == []
    assert any('control_tokens' in part for part, _ in model.named_parameters())


@pytest.mark.parametrize('name', ['added', 'indices', 'frame'])
def test_learns_what_only_the_control_tells(name):
    """Two samples alike but for the control and the outcome, +0.5 or -0.5: blind is 0.25 off."""
    torch.manual_seed(0)
    config: Any = {**SMALL, 'num_views': 1, 'num_layers': 1}
    model = type(build(SMALL))(**config, **LAYOUTS[name].transformer_arguments())
    target = torch.tensor([0.5, -0.5]).reshape(2, 1, 1, 1, 1, 1).expand(2, 1, 12, FRAMES, 8, 8)
    none = torch.zeros_like(target)
    signs = torch.tensor([1.0, -1.0]).reshape(2, 1, 1)
    given = {
        'added': {'control_context': signs.expand(2, 1, SIZE)},
        'indices': {'control_context': torch.tensor([[3, 7], [9, -1]])},
        'frame': {'control_frame': signs.expand(2, 1 + FRAMES, SIZE)},
    }[name]
    optimizer = torch.optim.AdamW(model.parameters(), lr=3e-3)
    losses: list[float] = []
    while len(losses) < 10 or sum(losses[-10:]) / 10 >= 0.05:
        assert len(losses) < 60, losses[-10:]
        out = model(
            torch.randn(target.shape),
            torch.full((2,), 1000.0),
            control=none,
            start=none,
            reference=none[:, :, :, 0],
            start_control=none[:, :, :, 0],
            **given,
        )
        loss = (out - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())


def test_the_parameters_they_share_start_alike():
    torch.manual_seed(0)
    drawn = type(build(SMALL))(**SMALL).state_dict()
    torch.manual_seed(0)
    model = type(build(SMALL))(**SMALL, **LAYOUTS['all'].transformer_arguments())
    shared = {k: v for k, v in model.state_dict().items() if k in drawn}
    assert len(shared) == len(drawn)
    assert all(torch.equal(drawn[name], value) for name, value in shared.items())


@pytest.mark.parametrize('name', ['indices', 'vectors', 'added', 'all'])
def test_padding_of_tokens_changes_nothing(kind, name):
    model, values = model_and_inputs(kind, name)
    tokens = values['control_context']
    longer = pad_rows([tokens[0], torch.cat([tokens[0]] * 2)])[:1]
    assert longer.shape[1] == 2 * tokens.shape[1]
    torch.testing.assert_close(
        model(**{**values, 'control_context': longer}), model(**values), rtol=1e-5, atol=1e-6
    )


def test_the_order_of_tokens_matters():
    model, values = model_and_inputs('conv', 'indices')
    turned = {**values, 'control_context': values['control_context'].flip(1)}
    assert (model(**turned) - model(**values)).abs().max() > 1e-5


@pytest.mark.parametrize('frame', [1, 2, 3, 4])
def test_a_frames_cross_attention_sees_its_own_vector_alone(frame):
    """With two frames a token: frames 1, 2 are slot 1, frames 3, 4 slot 2."""
    model, values = model_and_inputs('conv', 'frame')
    views, slots, places = 2, 3, 16
    attention: Any = model.blocks[0].attn2
    sequence = torch.randn(1, views * slots * places, 24)

    def attended(vectors: torch.Tensor) -> torch.Tensor:
        assert model.control_tokens is not None
        context = model.control_tokens(None, vectors, None, None, None, slots, views)
        assert context.by_slot.shape == (1, slots, 2, 24) and context.shared is None
        return attention(sequence, context).unflatten(1, (views, slots, places))

    changed = values['control_frame'].clone()
    changed[:, frame] += 0.5
    moved = (attended(changed) - attended(values['control_frame'])).abs().amax(dim=(0, 1, 3, 4))
    slot = (frame + 1) // 2
    assert moved[slot] > 1e-4
    assert not moved[torch.arange(slots) != slot].any()


@pytest.mark.parametrize('num_shared', [0, 5])
def test_a_slots_attention_is_that_of_its_view_and_place(kind, num_shared):
    """Slot by slot, against attention over one slot's own and the shared tokens at a time."""
    model, _ = model_and_inputs(kind, 'frame')
    attention: Any = model.blocks[0].attn2
    tokens = torch.randn(2, 3, 2, 24)
    shared = torch.randn(2, num_shared, 24) if num_shared else None
    mask = None if shared is None else torch.tensor([[True] * 5, [True, False] + [True] * 3])
    grid = torch.randn(2, 2, 3, 5, 24)
    context = Context(num_views=2, shared=shared, mask=mask, by_slot=tokens)
    found = attention(grid.flatten(1, 3), context).reshape(grid.shape)
    for row in range(2):
        for view in range(2):
            for slot in range(3):
                seen = tokens[row : row + 1, slot]
                if shared is not None and mask is not None:
                    seen = torch.cat([seen, shared[row : row + 1, mask[row]]], dim=1)
                alone = Context(num_views=1, shared=seen)
                expected = attention(grid[row : row + 1, view, slot], alone)
                torch.testing.assert_close(found[row, view, slot], expected[0])


def test_vectors_are_grouped_as_the_video_is():
    """81 vectors and 21 latent frames of four: the first one is repeated three more times."""
    vectors = torch.arange(81.0).reshape(1, 81, 1)
    groups = by_slot(vectors, 21, 4)[0, ..., 0]
    assert groups[0].tolist() == [0, 0, 0, 0]
    assert groups[1].tolist() == [1, 2, 3, 4]
    assert groups[20].tolist() == [77, 78, 79, 80]
    # a reference image before them shares the start's
    with_reference = by_slot(vectors, 22, 4)[0, ..., 0]
    assert with_reference[:2].tolist() == [[0, 0, 0, 0], [0, 0, 0, 0]]
    assert torch.equal(with_reference[1:], groups)
    with pytest.raises(
        CheckpointError, match='81 vectors do not divide into 20 token frames of 4'
    ):
        by_slot(torch.zeros(1, 82, 1), 21, 4)


@pytest.mark.parametrize('name', ['added', 'indices', 'frame', 'all'])
def test_a_sample_without_its_control_is_blind_to_it(kind, name):
    model, values = model_and_inputs(kind, name)
    kept = torch.tensor([False])
    dropped = model(**values, control_kept=kept)
    other = {**values, **values_of(LAYOUTS[name], seed=1)}
    torch.testing.assert_close(model(**other, control_kept=kept), dropped)
    assert (model(**values, control_kept=~kept) - dropped).abs().max() > 1e-5
    torch.testing.assert_close(model(**values, control_kept=~kept), model(**values))


def test_one_vector_is_added_to_every_text_token():
    model, values = model_and_inputs('patch', 'added')
    given = values['control_context'][:, :1]
    text = torch.randn(1, 5, 24)
    assert model.control_tokens is not None
    context = model.control_tokens(given, None, None, text, None, 5, 2)
    added = context.shared - text
    torch.testing.assert_close(added, added[:, :1].expand_as(added))
    embedding: Any = model.control_tokens.context
    net = embedding.net
    hidden = given[:, 0]
    for layer in (net[0], net[2]):
        hidden = torch.nn.functional.gelu(hidden @ layer.weight.T + layer.bias)
    expected = embedding.scale * (hidden @ net[4].weight.T + net[4].bias)
    torch.testing.assert_close(added[:, 0], expected)


def test_image_tokens_are_seen_too():
    model, values = model_and_inputs('patch', 'indices', image_dim=20, added_kv_proj_dim=24)
    values['encoder_hidden_states_image'] = torch.randn(1, 6, 20)
    out = model(**values)
    values['encoder_hidden_states_image'] = torch.randn(1, 6, 20)
    assert (model(**values) - out).abs().max() > 1e-4


def test_inputs_that_are_missing_or_not_taken_are_named():
    model, values = model_and_inputs('conv', 'frame')
    frame = values.pop('control_frame')
    with pytest.raises(CheckpointError, match="needs the control's input 'frame'"):
        model(**values)
    tokens = torch.zeros(1, 2, dtype=torch.int64)
    with pytest.raises(CheckpointError, match="does not take the control's input 'context'"):
        model(**values, control_frame=frame, control_context=tokens)


@pytest.mark.parametrize(
    'sizes', [{}, {'vector_size': 3, 'vocabulary': 9}, {'vocabulary': 9, 'joins': 'add'}]
)
def test_a_context_is_of_indices_or_of_vectors(sizes):
    with pytest.raises(CheckpointError, match='a context input'):
        ContextInput(**sizes)


@pytest.mark.parametrize(
    ('kind', 'before'),
    [
        ('conv', [0.675885, 0.661615, -0.040943, -1.929517, 2.47051, 0.747015]),
        ('patch', [0.549132, 0.565627, 0.27666, -0.853436, 0.120675, -0.203658]),
    ],
)
def test_models_of_the_trajectory_video_compute_what_they_did_before(kind, before):
    """Numbers written down at the commit before there were other controls (3b397e9)."""
    config, _, text_dim = KINDS[kind]
    with torch.no_grad():
        out = build(config)(**inputs(text_dim=text_dim))
    assert 'control_tokens' not in ' '.join(build(config).state_dict())
    found = [*out.abs().mean((0, 2, 3, 4, 5)).tolist(), *out[0, 0, :4, 1, 5, 7].tolist()]
    assert found == pytest.approx(before, abs=1e-4)


def test_layouts_are_plain_values():
    arguments = LAYOUTS['all'].transformer_arguments()
    assert arguments['frame_input'] == asdict(FrameInput(vector_size=SIZE, hidden_size=16))
    assert set(arguments) == {'context_input', 'frame_input'}
    assert InputLayout(video=True).transformer_arguments() == {}


def test_tokens_of_different_plans_differ_as_much_as_they_would_by_kaimings_initialisation():
    torch.manual_seed(0)
    plans = torch.rand(64, 1 + FRAMES, 20) * 2 - 1
    tokens = ControlTokens(
        context=None,
        frame={'vector_size': 20, 'hidden_size': 1024},
        dim=192,
        frames_per_token=4,
        num_prompt_tokens=0,
    )
    assert tokens.frame is not None
    with torch.no_grad():
        spread = tokens.frame(plans, 1 + FRAMES // 4, None).std(0).mean()
    # layers that keep half the variance each, and torch's default last one (1 / 3 of it)
    assert 0.1 < float(spread) < 0.5
