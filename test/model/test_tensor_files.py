"""Tensors on disk are read and written one shard at a time."""

from __future__ import annotations

from pathlib import Path
import weakref

from safetensors.torch import load_file, save_file
import torch
from torch import Tensor

from mtv_world_ros.model.tensor_files import open_tensors, StoredTensor
from mtv_world_ros.model.wan_weights import write_tensors


def test_no_more_than_one_shard_is_in_memory(tmp_path):
    alive: weakref.WeakSet[Tensor] = weakref.WeakSet()
    most = []

    def read() -> Tensor:
        tensor = torch.zeros(10)
        alive.add(tensor)
        most.append(len(alive))
        return tensor

    stored = {f't{number}': StoredTensor((10,), 'F32', read) for number in range(7)}
    write_tensors(stored, tmp_path, 'model', shard_bytes=2 * 40)
    assert len(list(tmp_path.glob('model-*.safetensors'))) == 4
    assert max(most) == 2


def test_what_was_read_of_a_file_does_not_stay_mapped(tmp_path):
    values = {'a': torch.arange(1000.0), 'b': torch.ones(3)}
    file = tmp_path / 'model.safetensors'
    save_file(values, file)
    tensors = open_tensors(file)
    assert torch.equal(tensors['a'].read().clone(), values['a'])
    assert str(file) not in Path('/proc/self/maps').read_text()
    assert torch.equal(load_file(file)['b'], tensors['b'].read())
