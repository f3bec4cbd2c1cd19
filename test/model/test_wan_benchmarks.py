"""Benchmarks of the Wan presets: the run on a GPU, its floor, files at full size."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import subprocess
import sys
from types import ModuleType, SimpleNamespace

import pytest
import torch

from mtv_world_ros.model.tensor_files import open_tensors
from mtv_world_ros.training.dry_run import step_cost
from mtv_world_ros.training.training_config import load_training_config
from test.support.scripts import imported_scripts

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope='module')
def scripts() -> Iterator[SimpleNamespace]:
    """The benchmarks as modules."""
    names = ('gpu', 'wan_floor', 'wan_import')
    with imported_scripts(*names) as modules:
        yield SimpleNamespace(**dict(zip(names, modules, strict=True)))


@pytest.mark.slow
def test_the_run_on_a_gpu_goes_through_on_a_cpu_at_tiny_size(tmp_path: Path) -> None:
    # the tests themselves are in this suite, and 14B is the script of Speed again
    command = [sys.executable, ROOT / 'experiments' / 'gpu.py', 'run', '--tiny', '--out', tmp_path]
    command += ['--parts', 'Speed', 'Training']
    told = subprocess.run(command, capture_output=True, text=True, check=False)
    assert told.returncode == 0, told.stdout + told.stderr
    page = (tmp_path / 'page.md').read_text()
    printed, _, brought = told.stdout.partition('bring back: ')
    assert page.strip() == printed.strip()
    assert Path(brought.rpartition(' (')[0]).is_file()
    for part in ('Speed', 'Training'):
        assert f'## {part}: status 0, ' in page
    for row in ('one step of the transformer', 'tiny_decoder=random', 'seconds a step'):
        assert f'| {row}' in page
    assert 'Error' not in page  # a row of a table says so where an option does not run


def test_a_run_on_a_gpu_fits_ten_minutes(scripts: SimpleNamespace) -> None:
    gpu: ModuleType = scripts.gpu
    assert sum(part.seconds for part in gpu.parts(tiny=False)) <= 590
    listed = {str(ROOT / name) for name in gpu._TESTS}
    marked = {
        str(file)
        for file in (ROOT / 'test').rglob('test_*.py')
        if '@pytest.mark.gpu' in file.read_text() and file != Path(__file__)
    }
    assert listed == marked


@pytest.mark.slow
def test_operations_of_the_floor_are_those_of_a_dry_run(scripts: SimpleNamespace) -> None:
    values = dict(text.split('=') for text in scripts.gpu._TINY)
    changes = {name: int(value) for name, value in values.items()}
    changes |= {'optimizer.batch_size': 1, 'lora.rank': 0}
    config = load_training_config('wan-1.3b', changes)
    options = SimpleNamespace(device='cpu', dtype='bfloat16', seed=0, tiny=True)
    found, tokens = scripts.wan_floor.stages(config, options)
    # 2 views x (reference + 2 history + 2 video frames of latents) x 2 x 2 patches
    assert tokens == 2 * 5 * 4
    step = found['one step of the transformer']
    cost = step_cost(config, dtype=torch.bfloat16)
    assert step.total == cost.forward_flop
    card = scripts.wan_floor.CARDS[0]
    assert 0 < step.floor(card) < step.compiled(card) < step.plain(card)


def test_files_at_full_size_take_no_space(tmp_path: Path, scripts: SimpleNamespace) -> None:
    file = tmp_path / 'weights.safetensors'
    shapes = {'blocks.0.ffn.0.weight': (13824, 5120), 'blocks.0.ffn.0.bias': (13824,)}
    scripts.wan_import.write_sparse(file, shapes, 'BF16')
    assert file.stat().st_size > 2 * 13824 * 5120
    assert file.stat().st_blocks * 512 < 2**20
    tensors = open_tensors(file)
    assert {name: tensor.shape for name, tensor in tensors.items()} == shapes
    bias = tensors['blocks.0.ffn.0.bias'].read()
    assert bias.dtype == torch.bfloat16 and not bias.any()
