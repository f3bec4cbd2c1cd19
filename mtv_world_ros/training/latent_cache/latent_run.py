"""`mtv-world train --latent-cache`: what encoders make of the clips, ready before training."""

from __future__ import annotations

from pathlib import Path

import torch
from tqdm import tqdm

from mtv_world_ros.errors import ConfigError
from mtv_world_ros.training.base import Base
from mtv_world_ros.training.clips.batches import BatchSource
from mtv_world_ros.training.config import TrainingConfig
from mtv_world_ros.training.latent_cache.cached_batches import CachedSource
from mtv_world_ros.training.latent_cache.clips import (
    CachedClip,
    fill,
    list_clips,
    read_clip,
    settings_of,
)
from mtv_world_ros.training.latent_cache.store import LatentCache
from mtv_world_ros.training.processes import Processes

#: stale clips that are named
_MOST_NAMED = 3


def cached(
    source: BatchSource,
    root: Path,
    config: TrainingConfig,
    base: Base | None,
    *,
    seed: int,
    dtype: torch.dtype,
    processes: Processes,
) -> CachedSource:
    """Encodes what the cache lacks, says what it did, and returns batches from the cache.

    Args:
        source: of the same clips, not cached; it is closed.
        root: of caches.
        config: the preset.
        base: whose encoders are used.
        seed: of the clips' order.
        dtype: that latents are kept in.
        processes: that train together.

    Raises:
        ConfigError: the preset disturbs pictures, or has no encoder worth a cache.
        TrainingError: the disk is full.
    """
    _check(config)
    assert base is not None
    source.close()
    controls, spec = source.controls, config.spec
    settings = settings_of(config, base.folder, controls.robot, controls.segmenter.name, dtype)
    cache = LatentCache(root, settings)
    clips = list_clips(source.starts)
    for note in [*cache.notes, *_changed(cache, clips)]:
        tqdm.write(f'latent cache: {note}')
    steps = fill(
        cache,
        clips,
        lambda clip: read_clip(clip, spec, controls, config.history),
        base.encoders,
        processes.device,
        dtype,
    )
    held = sum(clip.key in cache for clip in clips)
    made = 'none to encode'
    for build in tqdm(steps, total=len(clips) - held, desc='encoding clips', unit='clip'):
        made = (
            f'{build.num_encoded} encoded in {build.seconds:.1f} s ({build.clips_per_s:.2f} '
            f'clips/s, {build.clip_bytes / 1e6:.2f} MB each)'
        )
    tqdm.write(f"latent cache '{cache.folder}': {held} of {len(clips)} clips were there, {made}")
    return CachedSource(
        cache,
        clips,
        objective=config.objective,
        text=base.encoders.text,
        batch_size=config.optimizer.batch_size,
        seed=seed,
        numbers=processes.share(config.optimizer.batch_size),
        device=processes.device,
        controls=controls,
        spec=spec,
    )


def _check(config: TrainingConfig) -> None:
    """Raises ConfigError where latents that are kept are not what training would see."""
    if config.autoencoder.get('_class_name', 'SpaceToDepthAutoencoder') != 'AutoencoderKLWan':
        raise ConfigError(
            "--latent-cache is for presets with Wan's autoencoder; this one's only rearranges "
            'pixels, which costs less than reading latents: leave --latent-cache out'
        )
    augment = config.augment
    disturbed = {
        'augment.start_noise': augment.start_noise,
        'augment.colour_permutation': augment.colour_permutation,
        'augment.failure_share': augment.failure_share,
        'self_rollout.share': config.self_rollout.share,
    }
    for name, value in disturbed.items():
        if value:
            raise ConfigError(
                f'{name} is {value}, but a latent cache holds every clip once, as it was '
                f'recorded: set {name} to 0, or leave --latent-cache out'
            )


def _changed(cache: LatentCache, clips: list[CachedClip]) -> list[str]:
    """A note on clips whose episodes are no longer what was encoded."""
    stale = cache.changed({clip.key: clip.label for clip in clips})
    if not stale:
        return []
    named = ', '.join(stale[:_MOST_NAMED]) + (', ...' if len(stale) > _MOST_NAMED else '')
    return [f'{len(stale)} clips are not used, their episodes have changed: {named}']
