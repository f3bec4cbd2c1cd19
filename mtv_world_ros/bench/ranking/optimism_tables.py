"""The optimism benchmark in tables that fit a console of 100 columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite

from mtv_world_ros.bench.expert.faults.catalogue import FAULTS
from mtv_world_ros.bench.ranking.judges import COLUMNS, JUDGES
from mtv_world_ros.bench.ranking.optimism import (
    MEASURES,
    Optimism,
    Score,
    true_rate,
)
from mtv_world_ros.bench.ranking.rollout_jobs import Result
from mtv_world_ros.lab.documents import DASH, Table

REMARK = (
    'Cells: value [95 % interval] count. False success: real failures called a success, of those '
    'with a verdict. AUROC: of the rollouts with an estimate. Flips: a command whose true '
    "outcome differs from the expert's in the same scene; how often the imagined last frame is "
    'nearer to what really happened than to what happened under the expert, over the pixels in '
    'which these differ; chance is .5. No pictures: a rule that sees the commands and the first '
    'frame alone: an object sticks to a gripper that closes near it. AUROC - rule: on the same '
    'rollouts. Intervals, over scenes: of shares clustered Wilson, of AUROC jackknife; none for '
    'few scenes. r and MMRV, noise-free: estimated for endless scenes, posterior median and '
    'interval; not below 3 policies. r, MMRV and AUROC of a kind: over its policies and the '
    'expert.'
)

#: characters in the head of a column
_NAME_LENGTH = 17


def worth_table(results: Sequence[Result], worth: Mapping[str, Mapping[str, Score]]) -> Table:
    """Returns what a picture is worth: one row a judge.

    Args:
        results: rollouts.
        worth: of each judge over them, see `Summary.worth`.
    """
    rows = [[judge.title, *_worth(worth[key])] for key, judge in JUDGES.items()]
    rate = true_rate(results)
    return Table(
        caption=f'What a picture is worth: {rate.count} rollouts, {rate.value:.0%} really succeed',
        head=['judged by', 'n', 'AUROC', 'false success', 'no verdict', 'r'],
        rows=rows,
    )


def _worth(scores: Mapping[str, Score]) -> list[str]:
    r, free = scores['pearson'], scores['pearson_noise_free']
    low, high = free.interval
    around = f' [{_number(low)} {_number(high)}]' if isfinite(low) else ''
    return [
        str(scores['auroc'].count),
        _value(scores['auroc']),
        _cell(scores['false_success']),
        _value(scores['abstention']),
        f'{_number(r.value)}{around}',
    ]


def _value(score: Score) -> str:
    return _cell(score).rpartition(' ')[0] or DASH


def optimism_tables(by_model: Mapping[str, Optimism]) -> list[Table]:
    """Returns the tables: overall, then by fault kind.

    Args:
        by_model: label of the checkpoint -> its numbers; the first one's stand for the judges
            that do not depend on imagination.
    """
    if not by_model:
        return []
    return [_overall(by_model), *(_by_kind(name, found) for name, found in by_model.items())]


def _overall(by_model: Mapping[str, Optimism]) -> Table:
    first = next(iter(by_model.values()))
    heads = _heads(list(by_model)) if len(by_model) > 1 else [COLUMNS['imagined']]
    columns = {
        head: found.scores('imagined')
        for head, found in zip(heads, by_model.values(), strict=True)
    }
    columns |= {COLUMNS[judge]: first.scores(judge) for judge in COLUMNS if judge != 'imagined'}
    rows = [
        [words, *(_cell(scores[measure]) for scores in columns.values())]
        for measure, words in MEASURES.items()
    ]
    rate = true_rate(first.rollouts(None))
    caption = f'Optimism: {rate.count} rollouts, of which {rate.value:.0%} really succeed'
    return Table(caption=caption, head=['judged on', *columns], rows=rows)


def _by_kind(name: str, found: Optimism) -> Table:
    rows = []
    for kind in found.kinds:
        scores, rule = (found.scores(judge, kind) for judge in ('imagined', 'no_picture'))
        rate = true_rate(found.rollouts(kind))
        rows.append(
            [
                kind if FAULTS[kind].contact else f'{kind} *',
                str(rate.count),
                _number(rate.value),
                f'{_number(scores["auroc"].value)} / {_number(rule["auroc"].value)}',
                _cell(scores['false_success']),
                _number(rule['false_success'].value),
                _number(scores['abstention'].value),
                _cell(scores['flips']),
            ]
        )
    head = ['kind', 'n', 'true', 'AUROC/rule', 'false success', 'rule', 'open', 'flips']
    caption = f'{name}, by fault kind (* shows in the path of the arm)'
    return Table(caption=caption, head=head, rows=rows)


def _heads(names: Sequence[str]) -> list[str]:
    """The ends of checkpoints' paths as heads of columns, without the folders in which all end."""
    parts = [name.rstrip('/').split('/') for name in names]
    while min(map(len, parts)) > 1 and len({part[-1] for part in parts}) == 1:
        parts = [part[:-1] for part in parts]
    ends = ['/'.join(part) for part in parts]
    ends = [end if len(end) <= _NAME_LENGTH else f'…{end[1 - _NAME_LENGTH :]}' for end in ends]
    return ends if len(set(ends)) == len(ends) else [f'{n} {end}' for n, end in enumerate(ends, 1)]


def _cell(score: Score) -> str:
    if not isfinite(score.value):
        return DASH
    low, high = score.interval
    interval = f' [{_number(low)} {_number(high)}]' if isfinite(low) else ''
    return f'{_number(score.value)}{interval} {score.count}'


def _number(value: float) -> str:
    """Two decimals without the zero in front, 0 or 1 without any; a dash where there is none."""
    if not isfinite(value):
        return DASH
    return {'0.00': '0', '-0.00': '0', '1.00': '1'}.get(
        f'{value:.2f}', f'{value:.2f}'.replace('0.', '.', 1)
    )
