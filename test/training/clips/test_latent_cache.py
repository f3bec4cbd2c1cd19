"""Latents on disk: found again, resumed, and not used once anything they depend on has changed."""

from __future__ import annotations

from pathlib import Path
import resource

import pytest
import torch

from mtv_world_ros.core.errors import TrainingError
from mtv_world_ros.training.clips.latent_cache import digest_of, LatentCache

SETTINGS = {'fps': 16.0, 'views': ['low', 'high'], 'autoencoder': 'a1'}
KEYS = {digest_of('episode', start): f'episode from frame {start}' for start in range(5)}


def tensors(seed: int) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    clean = torch.randn(2, 4, 3, 5, generator=generator)
    return {
        'clean': clean,
        'shares': torch.arange(6, dtype=torch.uint8),
        'tokens': clean.bfloat16(),
    }


def filled(root: Path, count: int = 5, **settings: object) -> LatentCache:
    """About two clips a shard."""
    cache = LatentCache(root, {**SETTINGS, **settings}, shard_bytes=1200)
    for seed, (key, label) in enumerate(list(KEYS.items())[:count]):
        if key not in cache:
            cache.add(key, label, tensors(seed))
    cache.flush()
    return cache


def test_tensors_come_back_as_they_were_from_several_shards(tmp_path):
    filled(tmp_path)
    cache = LatentCache(tmp_path, SETTINGS)
    assert len(cache) == 5 and cache.notes == []
    assert len(list(cache.folder.glob('*.safetensors'))) == 3
    for seed, key in enumerate(KEYS):
        for name, expected in tensors(seed).items():
            assert torch.equal(cache.read(key)[name], expected)
    assert sorted(path.suffix for path in cache.folder.iterdir()) == ['.json'] + 3 * [
        '.safetensors'
    ]


def test_a_killed_build_goes_on_where_the_last_shard_ended(tmp_path):
    killed = LatentCache(tmp_path, SETTINGS, shard_bytes=1200)
    for seed, key in enumerate(list(KEYS)[:3]):  # the third one waits for its shard
        killed.add(key, KEYS[key], tensors(seed))
    cache = LatentCache(tmp_path, SETTINGS)
    assert [key in cache for key in KEYS] == [True, True, False, False, False]
    assert len(filled(tmp_path)) == 5
    assert len(LatentCache(tmp_path, SETTINGS)) == 5


def test_other_settings_are_not_used_and_named(tmp_path):
    filled(tmp_path)
    cache = LatentCache(tmp_path, {**SETTINGS, 'autoencoder': 'b2', 'fps': 8.0})
    assert len(cache) == 0
    (note,) = cache.notes
    assert 'is not used: autoencoder was a1, is b2; fps was 16.0, is 8.0' in note
    filled(tmp_path, autoencoder='b2', fps=8.0)
    assert LatentCache(tmp_path, SETTINGS).notes == []  # both are kept, each for its own


def test_a_changed_episode_is_told_from_a_new_one(tmp_path):
    filled(tmp_path, count=2)
    cache = LatentCache(tmp_path, SETTINGS)
    again = {digest_of('edited', start): f'episode from frame {start}' for start in range(3)}
    assert cache.changed(again) == ['episode from frame 0', 'episode from frame 1']
    assert cache.changed(KEYS) == []


def test_a_damaged_shard_is_said_and_its_clips_are_encoded_again(tmp_path):
    folder = filled(tmp_path).folder
    whole = sorted(folder.glob('*.safetensors'))[0]
    whole.write_bytes(whole.read_bytes()[:500])
    cache = LatentCache(tmp_path, SETTINGS)
    assert len(cache) == 3
    assert f"'{whole}' is damaged" in cache.notes[0]
    assert len(filled(tmp_path)) == 5


def test_a_full_disk_is_said_and_what_was_written_is_kept(tmp_path):
    """Files may not grow beyond a limit here, which fails the same way as a full disk."""
    cache = filled(tmp_path, count=2)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (600, before[1]))
    try:
        with pytest.raises(TrainingError, match=r'cannot be written.*2 clips before.*--latent-'):
            filled(tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(cache.folder.glob('*.part*'))
    assert len(LatentCache(tmp_path, SETTINGS)) == 2


def test_a_clip_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(TrainingError, match='has no clip missing'):
        LatentCache(tmp_path, SETTINGS).read('missing')
