"""The transformer: shapes, view symmetry, and no leak of reference tokens."""

import pytest
from small_transformer import build, inputs, PATCH, SMALL
import torch

from mtv_world_ros.errors import CheckpointError
from mtv_world_ros.model.transformer.stem import _attend

CONFIGS = {'conv': (SMALL, 0), 'patch': (PATCH, 16)}


@pytest.mark.parametrize('views', [1, 2, 3])
def test_returns_every_frame_of_every_view_and_no_reference(kind, views):
    config, text_dim = CONFIGS[kind]
    values = inputs(views=views, text_dim=text_dim)
    out = build(config)(**values)
    assert out.shape == values['hidden_states'].shape
    assert torch.isfinite(out).all()


@pytest.mark.parametrize('views', [1, 3])
def test_every_used_weight_gets_a_gradient(kind, views):
    config, text_dim = CONFIGS[kind]
    model = build(config, num_views=views)
    model(**inputs(views=views, text_dim=text_dim)).square().mean().backward()
    without = [
        name
        for name, parameter in model.named_parameters()
        if parameter.grad is None or not parameter.grad.any()
    ]
    # a key's bias moves all scores of a query alike: softmax does not see it
    assert [name for name in without if not name.endswith(('to_k.bias', 'copy.to_k.bias'))] == []


@pytest.mark.parametrize('view_offset', ['none', 'width'])
def test_swapping_the_views_swaps_the_output_unless_places_in_width_differ(kind, view_offset):
    config, text_dim = CONFIGS[kind]
    model = build(config, view_offset=view_offset)
    with torch.no_grad():
        model.view_embedding.zero_()
    values = inputs(text_dim=text_dim)
    swapped = {k: v.flip(1) if v.ndim >= 5 else v for k, v in values.items()}
    is_same = torch.allclose(model(**swapped), model(**values).flip(1), rtol=1e-4, atol=1e-5)
    assert is_same == (view_offset == 'none')


def test_each_view_sees_the_other_one(kind):
    config, text_dim = CONFIGS[kind]
    model = build(config)
    values = inputs(text_dim=text_dim)
    before = model(**values)
    values['control'] = values['control'].clone()
    values['control'][:, 1] += 1.0
    assert not torch.allclose(model(**values)[:, 0], before[:, 0], atol=1e-6)


def test_more_views_than_trained_are_refused():
    with pytest.raises(CheckpointError, match='4 views given, the model was built for 3'):
        build(SMALL)(**inputs(views=4))


def test_copied_patches_come_from_the_views_own_reference():
    """The copy attention of view 0 returns pixels of reference 0 alone."""
    decoder = build(SMALL).proj_out
    keys = torch.randn(2, 16, 8, 8)
    values = torch.stack([torch.full((48, 8, 8), 1.0), torch.full((48, 8, 8), 2.0)])
    copied = decoder.copy(torch.randn(8, 16, 8, 8), keys, values)
    torch.testing.assert_close(copied[:4], torch.ones_like(copied[:4]))
    torch.testing.assert_close(copied[4:], torch.full_like(copied[4:], 2.0))


@pytest.mark.parametrize('width', [12, 32, 48])
def test_the_attention_of_copies_is_that_of_the_formula(width):
    torch.manual_seed(0)
    q, k = torch.randn(2, 2, 30, 32), torch.randn(2, 2, 20, 32)
    v = torch.randn(2, 1, 20, width).expand(-1, 2, -1, -1)
    wanted = (q @ k.transpose(2, 3) / 32**0.5).softmax(dim=-1) @ v
    torch.testing.assert_close(_attend(q, k, v), wanted, rtol=1e-4, atol=1e-5)
