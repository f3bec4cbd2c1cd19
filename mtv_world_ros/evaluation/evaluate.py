"""Scores a pipeline on recorded episodes: J per view and object, baselines, intervals."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
import json
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from tqdm import tqdm

from mtv_world_ros.data.clips import load_recording, Recording
from mtv_world_ros.data_types import ByteArray
from mtv_world_ros.errors import ConfigError, EpisodeError, MtvWorldError
from mtv_world_ros.evaluation import tables
from mtv_world_ros.evaluation.results import EpisodeResult, Summary
from mtv_world_ros.evaluation.rollout_store import (
    join,
    rollout_path,
    save_rollout,
    stored_stretch,
    StoredRollout,
)
from mtv_world_ros.evaluation.rollouts import (
    check_mode,
    imagine_stretch,
    predicted_frames,
    Stretch,
    stretches,
)
from mtv_world_ros.evaluation.scores import (
    find_masks,
    score_frames,
    score_rows,
    ScoreRow,
    true_masks,
)
from mtv_world_ros.evaluation.statistics import episode_means
from mtv_world_ros.pipeline import Pipeline
from mtv_world_ros.prediction import Prediction
from mtv_world_ros.success.describer import objects_from_instruction
from mtv_world_ros.success.jaccard import mean_of_known, object_scores

#: sends (V, T, H, W, 3) frames through the model's autoencoder and back
Reconstruct = Callable[[ByteArray], ByteArray]


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationConfig:
    """What is imagined and how it is scored.

    Attributes:
        mode: `observe`: every chunk from the real frames at its start; `imagine`: chunks chained
            from the episode's first frame.
        seed: of the noise, of the choice of shuffled actions, of the bootstrap.
        num_inference_steps: denoising steps.
        shuffle: imagine everything a second time with the actions of another episode.
        use_ids: score against the recorded identities instead of the segmenter's masks of the
            recorded frames.
        num_resamples: of the bootstrap.
    """

    mode: str = 'observe'
    seed: int = 0
    num_inference_steps: int = 4
    shuffle: bool = True
    use_ids: bool = False
    num_resamples: int = 2000


def evaluate(
    pipeline: Pipeline,
    episode_paths: Sequence[Path],
    out: Path,
    *,
    name: str = '',
    reconstruct: Reconstruct | None = None,
    provenance: Mapping[str, str] = MappingProxyType({}),
    show_progress: bool = True,
    **options: Any,
) -> str:
    """Scores a pipeline and writes `metrics.json`, `rows.csv` and `tables.md`.

    Episodes that were scored before with the same settings are taken from `out/episodes`.
    Episodes that cannot be used are listed with their reason.

    Args:
        pipeline: imagines and segments.
        episode_paths: recorded episodes.
        out: folder for the results.
        name: identifies the checkpoint in the tables; only results of the same name are taken
            over, and none without a name.
        reconstruct: the autoencoder's round trip, for the ceiling.
        provenance: what the results were made with, by heading; goes into metrics.json.
        show_progress: draw a progress bar.
        **options: fields of `EvaluationConfig`.

    Returns:
        The tables, as Markdown.

    Raises:
        ConfigError: unknown option or mode.
        EpisodeError: no episode can be used.
    """
    config = _config(options)
    run = _Run(pipeline, list(episode_paths), Path(out), name, config, reconstruct)
    results, failed = [], {}
    bar = tqdm(run.results(), total=len(run.paths), unit='ep', disable=not show_progress)
    for path, result in bar:
        if isinstance(result, EpisodeResult):
            results.append(result)
            bar.set_postfix_str(_progress(results))
        else:
            failed[str(path)] = str(result)
    if not results:
        reason = next(iter(failed.items()), ('', 'none was given'))
        raise EpisodeError(f'no episode could be scored; {reason[0]}: {reason[1]}')
    summary = Summary(
        name=name,
        spec=pipeline.spec,
        settings={**asdict(config), 'segmenter': pipeline.segmenter.name},
        provenance=provenance,
        results=sorted(results, key=lambda result: result.episode),
        failed=failed,
        seed=config.seed,
        num_resamples=config.num_resamples,
    )
    return summary.write(run.out)


def _config(options: dict[str, Any]) -> EvaluationConfig:
    try:
        config = EvaluationConfig(**options)
    except TypeError as error:
        raise ConfigError(f'evaluation: {error}') from error
    check_mode(config.mode)
    return config


def _progress(results: Sequence[EpisodeResult]) -> str:
    means = [episode_means(result.rows, None) for result in results]
    moving, copy = (
        float(mean_of_known(np.array([found[key] for found in means])))
        for key in ('j_moving', 'j_copy_moving')
    )
    return f'J moving {moving:.3f}, persistence {copy:.3f}'


class _Run:
    """Scores episodes one by one, in an order in which each lends its actions to the next."""

    def __init__(
        self,
        pipeline: Pipeline,
        paths: list[Path],
        out: Path,
        name: str,
        config: EvaluationConfig,
        reconstruct: Reconstruct | None,
    ) -> None:
        self.pipeline, self.out, self.name, self.config = pipeline, out, name, config
        self.reconstruct = reconstruct
        order = np.random.default_rng(config.seed).permutation(len(paths))
        self.paths = [paths[index] for index in order]
        self._load = lru_cache(maxsize=2)(self._read)
        spec = pipeline.spec
        self.settings = {
            **asdict(config),
            'name': name,
            'spec': [list(spec.views), spec.fps, spec.num_frames, spec.width, spec.height],
            'ceiling': reconstruct is not None,
            'segmenter': pipeline.segmenter.name,
        }
        self.settings.pop('num_resamples')

    def results(self) -> Iterator[tuple[Path, EpisodeResult | MtvWorldError]]:
        for index, path in enumerate(self.paths):
            donor = self.paths[index - 1] if len(self.paths) > 1 else None
            try:
                yield path, self._cached(path, donor)
            except MtvWorldError as error:
                yield path, error

    def _read(self, path: Path) -> Recording:
        return load_recording(path, self.pipeline.spec, self.pipeline.robot)

    def _cached(self, path: Path, donor: Path | None) -> EpisodeResult:
        file = self.out / 'episodes' / f'{Path(path).name}.json'
        settings = {**self.settings, 'path': str(path), 'donor': str(donor)}
        try:
            stored = json.loads(file.read_text(encoding='utf-8'))
            if self.name and stored['settings'] == tables.plain(settings):
                return EpisodeResult.from_json(stored['result'])
        except (OSError, ValueError, KeyError, TypeError):
            pass  # not there, or of other settings or another version: score it again
        result = tables.plain(self._score(path, donor).as_json())
        tables.write_json(file, {'settings': settings, 'result': result})
        return EpisodeResult.from_json(result)

    def _score(self, path: Path, donor: Path | None) -> EpisodeResult:
        recording = self._load(path)
        actions = self._actions(donor)
        rows: list[ScoreRow] = []
        chunks: list[Prediction] = []
        shown: list[StoredRollout] = []
        for stretch in stretches(recording, self.pipeline.spec, self.config.mode):
            chunks = self._imagine(recording, stretch, recording)
            found, stored = self._rows(recording, stretch, chunks, actions)
            rows += found
            shown.append(stored)
        save_rollout(rollout_path(self.out, Path(path).name), join(shown))
        seconds = [sum(chunk.seconds.values()) for chunk in chunks]
        return EpisodeResult(
            episode=Path(path).name,
            task=recording.task,
            outcome=recording.outcome,
            rows=tuple(rows),
            probability=chunks[-1].success.probability,
            reasons=chunks[-1].success.reasons,
            seconds_per_chunk=float(np.mean(seconds)),
            has_ids=recording.object_ids is not None,
        )

    def _actions(self, donor: Path | None) -> Recording | None:
        """The episode that lends its actions; None if there is none that can be read."""
        if donor is None or not self.config.shuffle:
            return None
        try:
            return self._load(donor)
        except MtvWorldError:  # listed with its reason when its own turn comes
            return None

    def _imagine(
        self, recording: Recording, stretch: Stretch, actions: Recording
    ) -> list[Prediction]:
        return imagine_stretch(
            self.pipeline,
            recording,
            stretch,
            actions=actions,
            seed=self.config.seed + 1000 * stretch.index,
            num_inference_steps=self.config.num_inference_steps,
        )

    def _rows(
        self,
        recording: Recording,
        stretch: Stretch,
        chunks: list[Prediction],
        actions: Recording | None,
    ) -> tuple[list[ScoreRow], StoredRollout]:
        segmenter = self.pipeline.segmenter
        names = self.pipeline.objects or recording.objects
        truth = true_masks(
            stretch,
            segmenter,
            names or objects_from_instruction(recording.instruction),
            recording.objects,
            use_ids=self.config.use_ids,
        )
        shuffled = ceiling = None
        if actions is not None and truth.moving.any():
            frames = predicted_frames(self._imagine(recording, stretch, actions))
            shuffled = score_frames(frames, truth, segmenter)
        if self.reconstruct is not None:
            ceiling = score_frames(self.reconstruct(stretch.frames[:, 1:]), truth, segmenter)
        masks = find_masks(predicted_frames(chunks), truth, segmenter)
        predicted = object_scores(masks, truth.masks)
        rows = score_rows(stretch, self.pipeline.spec.views, truth, predicted, shuffled, ceiling)
        stored = stored_stretch(
            chunks,
            stretch,
            start_seconds=float(recording.times[stretch.start]),
            fps=self.pipeline.spec.fps,
            true_masks=truth.masks,
            masks=masks,
            j=predicted.frames,
        )
        return rows, stored
