"""The transformer: shapes, view symmetry, and no leak of reference tokens."""

import pytest
import torch

from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.model.transformer import attention
from mtv_world_ros.model.transformer.attention import attend
from test.support.small_transformer import build, inputs, PATCH, SMALL

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
    torch.testing.assert_close(attend(q, k, v), wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize('has_fast_products', [True, False])
def test_attention_in_bfloat16_is_that_of_the_formula_by_both_kernels(
    monkeypatch: pytest.MonkeyPatch, has_fast_products: bool
):
    """Values and gradients, whether the CPU multiplies bfloat16 or torch's fused kernel runs."""
    monkeypatch.setattr(attention, 'cpu_multiplies_bfloat16', lambda: has_fast_products)
    fused = []
    kernel = attention.F.scaled_dot_product_attention
    monkeypatch.setattr(
        attention.F,
        'scaled_dot_product_attention',
        lambda *given, **named: fused.append(given[2].is_contiguous()) or kernel(*given, **named),
    )
    torch.manual_seed(0)
    exact = [torch.randn(2, 2, n, width) for n, width in ((30, 32), (20, 32), (20, 48))]
    given = [x.bfloat16().transpose(2, 3).contiguous().transpose(2, 3) for x in exact]
    for x in (*exact, *given):
        x.requires_grad_(True)
    q, k, v = exact
    wanted = (q @ k.transpose(2, 3) / 32**0.5).softmax(dim=-1) @ v
    found = attend(*given)
    assert found.dtype == torch.bfloat16
    torch.testing.assert_close(found.float(), wanted, rtol=0, atol=0.03)
    wanted.square().sum().backward()
    found.float().square().sum().backward()
    for x, y in zip(given, exact, strict=True):
        torch.testing.assert_close(x.grad.float(), y.grad, rtol=0.05, atol=0.1)
    # the fused kernel would hold all scores if channels were not contiguous
    assert fused == ([] if has_fast_products else [True])


def test_scores_that_would_fill_the_memory_are_left_to_the_fused_kernel(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(attention, 'cpu_multiplies_bfloat16', lambda: True)
    monkeypatch.setattr(attention, 'MAX_SCORES', 2 * 30 * 20 - 1)
    kernel, calls = attention.F.scaled_dot_product_attention, []
    monkeypatch.setattr(
        attention.F,
        'scaled_dot_product_attention',
        lambda *given, **named: calls.append(1) or kernel(*given, **named),
    )
    attend(*(torch.zeros(1, 2, n, 32, dtype=torch.bfloat16) for n in (30, 20, 20)))
    assert calls
