"""The rows of `control_representations.py` and the tables of what they reached."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Any

import numpy as np
from page import table

from mtv_world_ros.lab.evaluation.metrics.statistics import Estimate
from mtv_world_ros.lab.evaluation.report.evaluation_summary import EvaluationSummary
from mtv_world_ros.lab.evaluation.report.tables import cell


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A row of the table: its title and what it changes of the preset."""

    title: str
    control: str = 'trajectory_video'
    views: tuple[str, ...] = ()
    object_mask: bool = True


ROWS = {
    'trajectory_video': Row(title='trajectory video (MTV-World)'),
    'policy2vec': Row(title='Policy2Vec (World-Eval)', control='policy2vec'),
    'ee_mlp': Row(title='action MLP (Ctrl-World)', control='ee_mlp'),
    'fast_tokens': Row(title='FAST tokens (Fast-Token)', control='fast_tokens'),
    'single_view_low': Row(title='trajectory video, Single-View low', views=('low',)),
    'single_view_high': Row(title='trajectory video, Single-View high', views=('high',)),
    'no_mask': Row(title='trajectory video, w/o Mask', object_mask=False),
}
#: the rows that differ in the control alone
CONTROL_ROWS = tuple(ROWS)[:4]

#: numbers of the table by heading
COLUMNS = {
    'J all': 'j_object_mean',
    'J moving': 'j_moving',
    'persistence': 'j_copy_moving',
    'skill': 'skill_moving',
    'shuffled': 'j_shuffled_moving',
    'zero': 'j_zero_moving',
    'mirrored': 'j_mirrored_moving',
}
_ABOUT = (
    'J all: of all objects; the other columns: of the objects that really move. Persistence: the '
    'first frame held; skill: (J moving - persistence) / (1 - persistence). Shuffled, zero, '
    "mirrored: J moving when another episode's actions, held joints, or the other arm's motion "
    'are imagined instead; a model that obeys its actions loses there. Brackets: 95 % t intervals '
    'over episodes. The rows without a drawn trajectory have cross-attention that the drawn ones '
    'do not need, hence more parameters; their trajectory channels are zero, so they are not '
    'given the object masks either (compare w/o Mask).'
)


def difference(one: EvaluationSummary, other: EvaluationSummary, seed: int) -> Estimate:
    """J moving of one minus that of the other, over the episodes that both scored."""
    means = [{r.episode: r.means(None)['j_moving'] for r in s.results} for s in (one, other)]
    shared = [means[0][name] - means[1][name] for name in means[0] if name in means[1]]
    values = np.array([value for value in shared if np.isfinite(value)])
    if not len(values):
        return Estimate(value=np.nan, interval=(np.nan, np.nan), num_episodes=0)
    draws = np.random.default_rng(seed).integers(0, len(values), (2000, len(values)))
    low, high = np.percentile(values[draws].mean(1), [2.5, 97.5])
    return Estimate(
        value=float(values.mean()), interval=(float(low), float(high)), num_episodes=len(values)
    )


def body(summaries: dict[str, EvaluationSummary], rows: dict[str, Any], seed: int) -> str:
    """The tables: a line per row and view, and the trajectory video against the others."""
    lines = []
    for name, summary in summaries.items():
        views = [*summary.spec.views]
        for view in [*views, None] if len(views) > 1 else views:
            found = summary.estimates(view)
            numbers = [cell(found.get(key)) for key in COLUMNS.values()]
            lines.append([ROWS[name].title, view or 'all', *numbers])
    parts = [_ABOUT, table(['control', 'view', *COLUMNS], lines)]
    costs = [
        [
            ROWS[n].title,
            f'{r["parameters"] / 1e6:.2f} M',
            f'{r["loss"]:.4f}',
            f'{r["seconds"]:.0f}',
        ]
        for n, r in rows.items()
    ]
    parts.append(table(['row', 'parameters', 'training loss', 'training [s]'], costs))
    first = summaries.get('trajectory_video')
    if first is not None and len(summaries) > 1:
        others = [name for name in CONTROL_ROWS[1:] if name in summaries]
        gaps = {name: difference(first, summaries[name], seed) for name in others}
        parts.append(verdict(gaps))
    return '\n\n'.join(parts)


def verdict(gaps: dict[str, Estimate]) -> str:
    """Whether the trajectory video is first among the controls, by J moving over all views."""
    lines = [[ROWS[name].title, cell(gap), str(gap.num_episodes)] for name, gap in gaps.items()]
    ahead = all(gap.interval[0] > 0 for gap in gaps.values())
    behind = [ROWS[name].title for name, gap in gaps.items() if gap.interval[1] < 0]
    if ahead:
        words = 'The trajectory video is first: every interval is above zero.'
    elif behind:
        words = f'The trajectory video is not first: it is behind {", ".join(behind)}.'
    else:
        words = 'These episodes do not tell the trajectory video from all others.'
    return (
        'J moving of the trajectory video minus that of the others, paired by episode:\n\n'
        f'{table(["control", "difference", "episodes"], lines)}\n\n{words}'
    )


def budget(options: argparse.Namespace, rows: dict[str, Any], summary: EvaluationSummary) -> str:
    """What every row was given."""
    trained = next(iter(rows.values()))['trained_on']
    changes = f', {" ".join(options.set)}' if options.set else ''
    return (
        f'Budget of each row: preset {options.preset}{changes}, {options.steps} steps of batch '
        f'{options.batch_size} ({options.steps * options.batch_size} clips drawn from '
        f'{trained["clips"]} of {trained["episodes"]} episodes, {len(trained["tasks"])} tasks), '
        f'from scratch, on {options.device}. Scored on {len(summary.results)} held-out episodes '
        f'of {len(summary.tasks)} tasks, chunk by chunk from real frames, '
        f'{options.denoising_steps} denoising steps, masks by the colour segmenter.'
    )
