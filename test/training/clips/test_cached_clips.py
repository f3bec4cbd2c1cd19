"""The latent cache of a training: what it holds is what would be encoded, and never stale."""

from __future__ import annotations

from pathlib import Path
import shutil

import numpy as np
import pytest
from safetensors.torch import load_file, save_file
import torch

from mtv_world_ros.core.errors import ConfigError, TrainingError
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.data.recordings import cut_clip
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.model.conditioning import condition, ControlBatch, encode_chunk
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.training.base_checkpoint import Base, load_base
from mtv_world_ros.training.clips.batches import attempted, BatchSource
from mtv_world_ros.training.clips.latent_cache import cached_batches, CachedSource
from mtv_world_ros.training.distributed import Processes
from mtv_world_ros.training.objective import pixel_weights, pooled_weights
from mtv_world_ros.training.training_config import load_training_config, TrainingConfig
from test.support.sources import make_source, with_batch_size
from test.support.wan_base import make_base, tiny_preset

CPU = torch.device('cpu')


@pytest.fixture(scope='module')
def config(tmp_path_factory) -> TrainingConfig:
    config = load_training_config(tiny_preset(tmp_path_factory.mktemp('preset')))
    objective = config.objective.replace(change_weight=4.0, moved_weight=10.0, attempt_weight=2.0)
    return config.replace(objective=objective)


@pytest.fixture(scope='module')
def folder(tmp_path_factory, config) -> Path:
    return make_base(tmp_path_factory.mktemp('wan'), config)


@pytest.fixture(scope='module')
def base(folder, config) -> Base:
    return load_base(config, Checkpoint.open(folder), CPU, torch.float32, seed=0)


@pytest.fixture(scope='module')
def copied(tmp_path_factory, episode) -> Path:
    """An episode that tests may change."""
    return Path(shutil.copytree(episode, tmp_path_factory.mktemp('data') / 'episode'))


def source_of(path: Path, config: TrainingConfig, robot: RobotModel) -> BatchSource:
    return make_source(
        [load_recording(path, config.spec, robot)], with_batch_size(config, 2), robot
    )


@pytest.fixture
def source(copied, config, robot) -> BatchSource:
    return source_of(copied, config, robot)


@pytest.fixture(scope='module')
def root(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp('latents')


def fill(source: BatchSource, root: Path, config: TrainingConfig, base: Base) -> CachedSource:
    processes = Processes('cpu')
    return cached_batches(
        source, root, config, base, seed=0, dtype=torch.float32, processes=processes
    )


def test_a_batch_is_what_encoding_the_recorded_clips_gives(source, tmp_path, config, base, capsys):
    held = fill(source, tmp_path, config, base)
    said = capsys.readouterr().out
    assert f'0 of {source.num_clips} clips were there, {source.num_clips} encoded in' in said
    assert 'clips/s' in said
    recording, starts = source.episodes[0].recording(), source.episodes[0].starts
    gaps = np.diff(recording.times[list(starts)])
    assert len(starts) == held.num_clips > 2 and (gaps > 2 - 1e-6).all() and (gaps < 2.3).all()
    batch = held.batch(0)
    clip = held._clip(0, 1)
    cut = cut_clip(recording, clip.start, config.spec)
    frames = torch.from_numpy(cut.frames)[None]
    video = source.controls.make(cut, cut.objects)
    autoencoder = base.encoders.autoencoder
    with torch.no_grad():
        clean = encode_chunk(autoencoder, frames)
        expected = condition(autoencoder, frames[:, :, 0], ControlBatch.of([video]))
    torch.testing.assert_close(batch.clean[1:], clean)
    for name in ('control', 'start_control', 'start', 'reference'):
        torch.testing.assert_close(
            getattr(batch.conditioning, name)[1:], getattr(expected, name), msg=name
        )
    tokens = base.encoders.image.encode(frames[0, :, 0]).flatten(0, 1)
    torch.testing.assert_close(batch.conditioning.image[1], tokens.clone())
    assert torch.equal(batch.conditioning.text[1], base.encoders.text[0])
    ids = torch.from_numpy(cut.object_ids)[None]
    places = torch.from_numpy(attempted(cut, source.controls.robot))[None]
    weights = pooled_weights(pixel_weights(frames, ids, config.objective, places), clean.shape)
    # shares are kept as bytes: half a byte of each of the weights, 4, 10 and 2
    torch.testing.assert_close(batch.weights[1:], weights, rtol=0, atol=16 * 0.5 / 255 + 1e-6)


def test_clips_are_shown_what_came_before_them(source, root, config, base):
    """At the beginning of an episode that is nothing: the anchor is the start image itself."""
    held = fill(source, root, config, base)
    steps = -(-held.num_clips // 2)
    order = [held._clip(*divmod(index, 2)).start for index in range(2 * steps)]
    step, row = divmod(order.index(min(order)), 2)
    first = held.batch(step).conditioning
    assert first.history_sigmas[row] == 1
    torch.testing.assert_close(first.anchor[row], first.reference[row])
    others = torch.cat([held.batch(i).conditioning.history_sigmas for i in range(steps)])
    known = others[others < 1]
    assert len(known) and (known <= config.history.max_noise).all()
    assert first.history.shape[3] == 2  # five frames: the first alone, then four


def test_a_second_run_encodes_nothing(source, root, config, base, capsys):
    fill(source, root, config, base)
    assert f'{source.num_clips} of {source.num_clips} clips were there, none to encode' in (
        capsys.readouterr().out
    )


def test_an_epoch_takes_every_clip_once_and_the_next_in_another_order(source, root, config, base):
    held = fill(source, root, config, base)
    count = held.num_clips
    order = [held._clip(*divmod(index, 2)).start for index in range(2 * count)]
    assert sorted(order[:count]) == sorted(order[count:]) == list(source.episodes[0].starts)
    assert order[:count] != order[count:]


@pytest.mark.slow
def test_other_encoder_weights_are_noticed(source, root, config, folder, base, tmp_path, capsys):
    fill(source, root, config, base)
    capsys.readouterr()
    other = Path(shutil.copytree(folder, tmp_path / 'other'))
    file = other / 'autoencoder' / 'diffusion_pytorch_model.safetensors'
    tensors = load_file(file)
    tensors['quant_conv.bias'] += 1
    save_file(tensors, file)
    changed = load_base(config, Checkpoint.open(other), CPU, torch.float32, seed=0)
    held = fill(source, root, config, changed)
    said = capsys.readouterr().out
    assert 'is not used: autoencoder was' in said and '0 of' in said
    again = fill(
        source,
        root,
        config,
        load_base(config, Checkpoint.open(folder), CPU, torch.float32, seed=0),
    )
    assert not torch.allclose(held.batch(0).clean, again.batch(0).clean, atol=0.1)


@pytest.mark.parametrize(
    ('section', 'changes', 'said'),
    [
        ('video', {'width': 48}, 'video.width was 32, is 48'),
        ('rendering', {'half_life_s': 0.9}, 'rendering.half_life_s was 0.5, is 0.9'),
    ],
)
def test_other_settings_are_noticed(
    copied, root, config, base, robot, capsys, section, changes, said
):
    other = config.replace(**{section: getattr(config, section).replace(**changes)})
    fill(source_of(copied, other, robot), root, other, base)
    assert said in capsys.readouterr().out


def test_a_changed_episode_is_noticed(copied, root, config, base, robot, capsys):
    (copied / 'notes.txt').write_text('one more file is another content')
    source = source_of(copied, config, robot)
    fill(source, root, config, base)
    said = capsys.readouterr().out
    assert f'{source.num_clips} clips are not used, their episodes have changed: episode' in said
    assert f'0 of {source.num_clips} clips were there' in said


def test_too_little_space_is_said_before_anything_is_encoded(
    source, config, base, tmp_path, monkeypatch
):
    free = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(shutil, 'disk_usage', lambda _: free)
    with pytest.raises(TrainingError, match=r'take 0\.0 GB .* free there; give --latent-cache'):
        fill(source, tmp_path / 'new', config, base)
    assert list((tmp_path / 'new').iterdir()) == []


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'augment.start_noise': 0.5}, r'augment.start_noise is 0.5, but a latent cache holds'),
        ({'augment.failure_share': 0.3}, r'augment.failure_share is 0.3'),
        ({'self_rollout.share': 0.5}, r'self_rollout.share is 0.5'),
    ],
)
def test_what_a_cache_cannot_hold_is_refused(source, config, base, tmp_path, changes, message):
    ((dotted, value),) = changes.items()
    section, key = dotted.split('.')
    held = getattr(config, section).replace(**{key: value})
    with pytest.raises(ConfigError, match=message):
        fill(source, tmp_path, config.replace(**{section: held}), base)


def test_the_small_preset_needs_no_cache(source, base, tmp_path):
    with pytest.raises(ConfigError, match='only rearranges pixels'):
        fill(source, tmp_path, load_training_config('small'), base)
