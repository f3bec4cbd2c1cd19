"""Scores of several rankings together, e.g. of the same tasks with other seeds and faults.

    python experiments/pooled_rankings.py out/rank/61001 out/rank/61002 out/rank/61003

reads the rollouts of finished runs of `mtv-world rank` and prints the table of what a picture is
worth: of each run, and of all together. Scenes (tasks of a run) are the clusters of intervals:
AUROC jackknife, shares clustered Wilson, none for AUROC of fewer than four scenes. The last
columns are over all rollouts, where AUROC is over those with an estimate alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from math import isfinite
from pathlib import Path

from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.documents import DASH, Table
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.ranking.jobs import Result
from mtv_world_ros.ranking.judges import JUDGES, RULE, Score, scores, true_rate
from mtv_world_ros.ranking.run_jobs import FOLDER

HEAD = ('rankings', 'judged by', 'rollouts', 'AUROC', 'failures called a success', 'no verdict',
        'AUROC - rule')  # fmt: skip
ALL = 'all'


def read_results(folder: Path) -> tuple[list[Result], str]:
    """Return the rollouts of a ranking, and the checkpoint that imagined them.

    Raises:
        ConfigError: the ranking is not finished, or its files are of several checkpoints.
    """
    if not (folder / 'ranking.json').is_file():
        raise ConfigError(
            f"'{folder}' holds no finished ranking (ranking.json); give the --out of 'mtv-world "
            "rank', and run an interrupted command again: it goes on"
        )
    stored = [read_json(file) for file in sorted((folder / FOLDER).glob('*.json'))]
    made = {str(one['settings']['checkpoint']) for one in stored}
    if len(made) != 1:
        raise ConfigError(
            f"'{folder}' has rollouts of the checkpoints {sorted(made)}; one is needed: rank anew "
            'with --overwrite'
        )
    return [Result.from_json(one['result']) for one in stored if one.get('result')], made.pop()


def pooled(rankings: Sequence[Sequence[Result]]) -> list[Result]:
    """Return the rollouts of all rankings; scenes of two rankings are two scenes."""
    step = 1 + max((r.index for results in rankings for r in results), default=0)
    return [
        replace(result, index=result.index + number * step)
        for number, results in enumerate(rankings)
        for result in results
    ]


def rows(name: str, results: Sequence[Result]) -> list[tuple[str, ...]]:
    """Return a row of the table for each judge that gave an estimate."""
    found = []
    for key, judge in JUDGES.items():
        given = scores(results, results, key)
        if not given['auroc'].count or key == 'imagined' and _is_pictures(results):
            continue
        over_rule = DASH if key == RULE else cell(given['over_rule'])
        found.append((name, judge.title, str(len(results)), cell(given['auroc']),
                      cell(given['false_success']), cell(given['abstention']),
                      over_rule))  # fmt: skip
    return found


def cell(score: Score) -> str:
    """Return a value, its interval and the number of cases."""
    if not isfinite(score.value):
        return DASH
    low, high = score.interval
    interval = f' [{low:.2f}, {high:.2f}]' if isfinite(low) and isfinite(high) else ''
    return f'{score.value:.2f}{interval} of {score.count}'


def _is_pictures(results: Sequence[Result]) -> bool:
    """Return whether nothing was foreseen, so that the estimate is that of the pictures."""
    return all(not isfinite(result.foreseen.probability) for result in results)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('folders', nargs='+', type=Path, help='--out of rankings')
    folders = parser.parse_args(arguments).folders
    read = [read_results(folder) for folder in folders]
    made = sorted({checkpoint for _, checkpoint in read})
    if len(made) != 1:
        raise ConfigError(
            f'rankings of the checkpoints {made} cannot be pooled; give those of one'
        )
    rankings = [results for results, _ in read]
    every = pooled(rankings)
    lines = [
        line
        for folder, results in zip(folders, rankings, strict=True)
        for line in rows(folder.name, results)
    ]
    print(f'{made[0]}: {cell(true_rate(every))} rollouts really succeed\n')
    print(Table(head=HEAD, rows=tuple(lines + rows(ALL, every))).markdown())


if __name__ == '__main__':
    main()
