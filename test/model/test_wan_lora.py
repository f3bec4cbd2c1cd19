"""LoRA adapters: trained, saved with what goes beside them, merged, exchanged."""

from __future__ import annotations

from pathlib import Path

import pytest
from safetensors.torch import load_file, save_file
import torch
from torch import Tensor

from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.model.lora import ADAPTER, Adapters
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from mtv_world_ros.training.adapter import add_adapter, save_adapter
from mtv_world_ros.training.training_config import load_training_config
from test.support.wan_files import DIM
from test.support.wan_lora import build, RANK, run


def trained(folder: Path, alpha: float = 8.0, seed: int = 5) -> Tensor:
    """Save an adapter that changes everything it may; return the output with it."""
    model = build()
    add_adapter(model, rank=RANK, alpha=alpha)
    torch.manual_seed(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.requires_grad:
                parameter.add_(0.2 * torch.randn_like(parameter))
    save_adapter(model, folder)
    return run(model)


def test_the_papers_adapter_has_the_known_size():
    """Rank 32 on queries, keys, values, outputs and feed-forward layers: 43.75 M on the 1.3B."""
    with torch.device('meta'):
        model = MultiViewWanTransformer(**load_training_config('wan-1.3b').transformer)
    add_adapter(model)
    lora = sum(p.numel() for n, p in model.named_parameters() if '.lora_' in n)
    assert lora == 30 * (8 * 32 * 2 * 1536 + 2 * 32 * (1536 + 8960)) == 43_745_280
    others = {n for n, p in model.named_parameters() if p.requires_grad and '.lora_' not in n}
    assert others == {
        'ref_conv.weight',
        'ref_conv.bias',
        'view_embedding',
        'patch_embedding.weight',
        'patch_embedding.bias',
    }


def test_a_new_adapter_changes_nothing():
    model = build()
    before = run(model)
    add_adapter(model, rank=RANK)
    torch.testing.assert_close(run(model), before, rtol=0, atol=1e-5)


def test_saved_and_loaded_gives_the_same_output(tmp_path):
    expected = trained(tmp_path / 'adapter')
    model = build()
    assert not torch.allclose(expected, run(model), atol=0.1)
    places = {name: value.data_ptr() for name, value in model.state_dict().items()}
    Adapters(model).use(tmp_path / 'adapter')
    # a compiled pass reads the tensors where they were
    assert {name: value.data_ptr() for name, value in model.state_dict().items()} == places
    torch.testing.assert_close(run(model), expected, rtol=0, atol=1e-4)
    assert {path.name for path in (tmp_path / 'adapter').iterdir()} == {
        ADAPTER,
        'beside.safetensors',
        'base.json',
    }


def test_in_bfloat16_weights_are_the_sum_rounded_once(tmp_path):
    trained(tmp_path / 'adapter')
    model = torch.nn.Module.to(build(), torch.bfloat16)
    name = 'blocks.1.attn1.to_k'
    before = model.get_parameter(f'{name}.weight').detach().float()
    Adapters(model).use(tmp_path / 'adapter')
    stored = load_file(tmp_path / 'adapter' / ADAPTER)
    a, b = (stored[f'{name}.lora_{side}.weight'] for side in 'AB')
    expected = before + 8.0 / RANK * (b @ a)
    torch.testing.assert_close(
        model.get_parameter(f'{name}.weight').detach(), expected.bfloat16(), rtol=0, atol=0
    )


def test_adapters_are_exchanged_in_a_loaded_model(tmp_path):
    first, second = trained(tmp_path / 'a'), trained(tmp_path / 'b', seed=6)
    model = build()
    before = run(model)
    adapters = Adapters(model)
    for path, expected in (('a', first), ('b', second), ('a', first)):
        adapters.use(tmp_path / path)
        torch.testing.assert_close(run(model), expected, rtol=0, atol=1e-4)
    adapters.use(None)
    torch.testing.assert_close(run(model), before, rtol=0, atol=1e-5)
    for name, value in build().state_dict().items():
        assert torch.equal(model.state_dict()[name], value), name


def test_a_failed_exchange_leaves_the_adapter_before(tmp_path):
    expected = trained(tmp_path / 'a')
    model = build()
    adapters = Adapters(model)
    adapters.use(tmp_path / 'a')
    (tmp_path / 'broken.safetensors').write_bytes(b'no safetensors')
    with pytest.raises(CheckpointError, match='cannot be loaded'):
        adapters.use(tmp_path / 'broken.safetensors')
    torch.testing.assert_close(run(model), expected, rtol=0, atol=1e-4)
    assert adapters.current == tmp_path / 'a'


def test_the_number_format_of_the_model_stays(tmp_path):
    trained(tmp_path / 'a')
    model = torch.nn.Module.to(build(), torch.bfloat16)
    Adapters(model).use(tmp_path / 'a')
    assert {parameter.dtype for parameter in model.parameters()} == {torch.bfloat16}
    assert torch.isfinite(run(model)).all()


def test_adapters_of_another_transformer_and_pickles_are_refused(tmp_path):
    trained(tmp_path / 'a')
    with pytest.raises(CheckpointError, match='of num_layers 2, this one has 3'):
        Adapters(build(num_layers=3)).use(tmp_path / 'a')
    whole = load_file(tmp_path / 'a' / 'beside.safetensors')
    save_file({**whole, 'view_embedding': torch.zeros(1, DIM)}, tmp_path / 'a/beside.safetensors')
    with pytest.raises(CheckpointError, match=r"'view_embedding' has shape \[1, 24\], expected"):
        Adapters(build()).use(tmp_path / 'a')
    with pytest.raises(CheckpointError, match='is no adapter: expected a folder with'):
        Adapters(build()).use(tmp_path)
    (tmp_path / 'lora.pth').write_bytes(b'')
    with pytest.raises(CheckpointError, match='never read'):
        Adapters(build()).use(tmp_path / 'lora.pth')
