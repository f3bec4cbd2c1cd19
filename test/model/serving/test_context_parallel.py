"""A transformer shared by two processes computes what it computes alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from small_transformer import build
import torch
from torch import Tensor
from wan_files import TRANSFORMER

from mtv_world_ros.errors import ConfigError, ModelError
from mtv_world_ros.model.serving.context_parallel import Followers, open_store
from mtv_world_ros.model.serving.serving_options import ServingOptions
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer

#: 1 + 3 token frames of 4 x 4 tokens; three heads do not divide among two processes
MODEL = {**TRANSFORMER, 'num_attention_heads': 3, 'attention_head_dim': 8, 'num_views': 3}


def inputs(views: int, batch: int = 1, frames: int = 3, size: int = 8) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(views)

    def random(*shape: int) -> Tensor:
        return torch.randn(batch, views, 16, *shape, generator=generator)

    return {
        'hidden_states': random(frames, size, size),
        'timestep': torch.tensor(250.0).expand(batch),  # as the sampler gives it
        'control': random(frames, size, size),
        'start': random(frames, size, size),
        'reference': random(size, size),
        'encoder_hidden_states': torch.randn(batch, 512, 32, generator=generator),
        'encoder_hidden_states_image': torch.randn(batch, views * 17, 32, generator=generator),
    }


@pytest.fixture(scope='module')
def pair() -> Iterator[tuple[MultiViewWanTransformer, MultiViewWanTransformer, Followers]]:
    """The same transformer alone and shared by two processes."""
    alone, shared = (build(MODEL).eval().requires_grad_(False) for _ in range(2))
    followers = Followers(shared, ServingOptions(context_parallel=2))
    yield alone, shared, followers
    followers.close()


@pytest.mark.parametrize(
    ('views', 'batch', 'size'),
    # 6 x 10 latents are 3 x 5 tokens: an odd number, the processes get different shares
    [(1, 1, (8, 8)), (2, 1, (8, 8)), (3, 2, (8, 8)), (3, 1, (6, 10))],
)
@torch.inference_mode()
def test_two_processes_compute_what_one_does(pair, views, batch, size) -> None:
    alone, shared, _ = pair
    values = inputs(views, batch)
    if size != (8, 8):
        values = {
            name: v[..., : size[0], :].repeat_interleave(2, -1)[..., : size[1]]
            if v.ndim > 4
            else v
            for name, v in values.items()
        }
    seen: list[int] = []
    hook = shared.blocks[-1].ffn.register_forward_hook(lambda _, x, y: seen.append(y.shape[1]))
    out = shared(**values)
    hook.remove()
    tokens = views * 4 * (size[0] // 2) * (size[1] // 2)
    assert seen == [-(-tokens // 2)]  # the blocks here saw half of the tokens of all views
    assert out.std() > 0.1
    torch.testing.assert_close(out, alone(**values), rtol=0, atol=1e-5)


def test_the_meeting_point_listens_on_the_loopback_alone() -> None:
    store = open_store()
    store.set('key', 'value')
    assert open_store(store.port).get('key') == b'value'
    sockets = [
        line.split()
        for table in ('tcp', 'tcp6')
        for line in Path(f'/proc/net/{table}').read_text().splitlines()[1:]
    ]
    listening = [row[1] for row in sockets if row[3] == '0A']
    mine = [address for address in listening if int(address[-4:], 16) == store.port]
    assert [address[:-5] for address in mine] == ['0100007F']  # 127.0.0.1


@torch.inference_mode()
def test_changed_weights_reach_the_other_process(pair) -> None:
    alone, shared, followers = pair
    before = shared(**inputs(2))
    for model in (alone, shared):
        model.blocks[0].attn1.to_v.weight.mul_(-1)
    followers.send_weights()
    after = shared(**inputs(2))
    assert not torch.allclose(before, after, atol=1e-2)
    torch.testing.assert_close(after, alone(**inputs(2)), rtol=0, atol=1e-5)


@torch.inference_mode()
def test_a_history_with_its_own_noise_level_is_split_alike(pair) -> None:
    alone, shared, _ = pair
    torch.manual_seed(0)
    before = {
        'history': torch.randn(1, 2, 16, 1, 8, 8),
        'history_timestep': torch.tensor([50.0]),
        'anchor': torch.randn(1, 2, 16, 8, 8),
    }
    out = shared(**inputs(2), **before)
    torch.testing.assert_close(out, alone(**inputs(2), **before), rtol=0, atol=1e-5)
    later = {**before, 'history_timestep': torch.tensor([900.0])}
    assert not torch.allclose(out, shared(**inputs(2), **later), atol=1e-2)


def test_a_second_group_is_refused(pair) -> None:
    with pytest.raises(ConfigError, match='has a group already'):
        Followers(build(MODEL), ServingOptions(context_parallel=2))


@torch.inference_mode()
def test_a_process_that_ended_is_an_error_not_a_hang(pair) -> None:
    """Last in this file: the pair is broken after it."""
    _, shared, followers = pair
    followers._processes[0].kill()
    followers._processes[0].wait()
    with pytest.raises(ModelError, match='ended with status -9.*context_parallel=1'):
        shared(**inputs(1))
