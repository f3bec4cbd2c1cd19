"""What verdicts are worth on faults that a seed drew: one table of several fresh seeds.

    python experiments/unseen_faults.py --seeds 72046,16337,64608 --logs out/unseen --readme

For each seed the expert and fault kinds that the seed drew (`--policies`) act in `--physics`, as
`shifted_worlds.py` has it; logs are kept in `--logs` and the same command goes on. Seeds are drawn
after the code is frozen, so that nothing could be fitted to them. All seeds are pooled; intervals
are over scenes (tasks of a seed): AUROC jackknife, shares clustered Wilson. `--readme` writes the
first table between the markers `unseen-faults` of docs/results.md; the four numbers of
README.md are written by hand, and a test compares them.

*Both* is the estimate with imagined frames, in the physics `--pictures`. In every physics but
`nominal` nothing was fitted in the robot cell: *foreseen motions alone* draws contact parameters
from the wide prior. *As if fitted here* takes the parameters of `nominal` all the same; its silent
errors are what the prior is for. With `--before FILE`, a calibration of before ShareFit, the old
estimate, which counts frames beside the motion that was drawn into them, is computed from the same
rollouts; physics that show the same first picture as `nominal` share it.

Coverage: rollouts are grouped by their estimate, in each truth. A group is covered if its success
rate lies, to half a rollout, within the mean 95 % interval of its estimates; or, up to its own
sampling error, if the 95 % Wilson interval of the rate reaches the mean interval. Given is the share
of rollouts in covered groups. The picture has the groups of `nominal`, of `bold`, and of all truths
but `nominal` together.

The last table is of robot cells in which nothing was fitted, where the ends of rollouts may confirm
the fitted parameters; see `shifted_worlds.py`. Nominal is taken as such a cell, too.
"""  # noqa: E501

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
import copy
from datetime import date
from math import isfinite, nan
from pathlib import Path
import re
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
import numpy as np
from page import parse_arguments, publish, ROOT, table
from shifted_worlds import (
    ACROSS,
    across,
    AS_FITTED,
    BOTH,
    compared_text,
    CONFIRMED,
    confirmed_rows,
    estimated,
    FITTED,
    FORESEEN,
    HEAD,
    over_truths,
    Row,
    row,
    RULE,
    ruled,
    run,
    SAME_PICTURE,
    Scenes,
    watch_rows,
    WATCHED,
)
from shifted_worlds import (
    more as shifted_options,
)

from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.data.episode import NOMINAL
from mtv_world_ros.evaluation.metrics.statistics import wilson
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.success.calibration import Calibration, DOUBTS
from mtv_world_ros.success.estimator import capped
from mtv_world_ros.success.share_fit import ShareEstimate

#: what a table of coverage is grouped by [probability]
EDGES = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0 + 1e-9)
#: judge: the estimate of before, of `--before`
BEFORE = 'both, before'
COVERED = ('truth', 'judged by', 'estimates', 'covered', 'up to the sampling error of rates')
BLOCK = ('judged by', 'nominal: verdicts', 'right: success; failure',
         'AUROC, no verdict .5', 'others: verdicts',
         'right there: success; failure', 'AUROC there, mean (worst)',
         'AUROC there, no verdict .5, mean (worst)', 'from .9 on succeed there')  # fmt: skip
_MARKED = re.compile(
    r'(<!-- unseen-faults: begin -->\n).*?(<!-- unseen-faults: end -->)', re.DOTALL
)
#: text of a reason that states the 95 % error of the margin [mm]
_KNOWN_TO = re.compile(r'(held|missed) by \d+ mm, known to (\d+) mm')
Line = dict[str, Any]


def more(parser: argparse.ArgumentParser) -> None:
    """Add options."""
    shifted_options(parser)
    parser.set_defaults(
        physics='nominal,bold,mass_triple,camera_off,joint_zeros_1deg,objects_small,dart',
        pictures=NOMINAL,
        policies=8,
        log=Path(),
    )
    for action in parser._actions:
        action.required = False
    parser.add_argument('--seeds', required=True, help='comma-separated, drawn for this page')
    parser.add_argument('--logs', type=Path, required=True, help='folder of the logs')
    parser.add_argument('--before', type=Path, help='calibration of before, for the rows before')
    parser.add_argument('--readme', action='store_true', help='write docs/results.md')


def of_seed(options: argparse.Namespace, seed: int) -> argparse.Namespace:
    """Return the options of `shifted_worlds` for a seed."""
    chosen = copy.copy(options)
    chosen.seed, chosen.faults = seed, f'drawn:{seed}'
    chosen.log = options.logs / f'{seed}.jsonl'
    return chosen


def estimates_of(
    options: argparse.Namespace, pipelines: dict[str, Pipeline], lines: Sequence[Line]
) -> dict[tuple[str, str], tuple[list[Line], list[ShareEstimate]]]:
    """Return rollouts and estimates by physics and judge."""
    (name, pipeline), found, scenes = *pipelines.items(), {}, Scenes(pipelines, options)
    for physics in options.physics.split(','):
        chosen = [line for line in lines if line['job'][0] == physics]
        for judge in scenes.wanted(physics) if chosen else ():
            asked = [line for line in chosen if judge in line['said'][name]]
            said = [estimated(pipeline, judge, r['said'][name][judge], physics) for r in asked]
            if asked:
                found[physics, judge] = asked, said
        if chosen:
            found[physics, RULE] = chosen, [ruled(line) for line in chosen]
    if options.before is not None:
        found |= before(Calibration(**read_json(options.before)), lines, name)
    return found


def before(
    calibration: Calibration, lines: Sequence[Line], name: str
) -> dict[tuple[str, str], tuple[list[Line], list[ShareEstimate]]]:
    """Return what the estimate was that counted frames beside the drawn motion.

    Of physics whose rollouts begin with the same picture as those of `nominal`, thus have the same
    estimate: bodies differ, not pictures.
    """
    imagined = {
        tuple(line['job'][1:]): line['said'][name][BOTH]
        for line in lines
        if line['job'][0] == NOMINAL and BOTH in line['said'][name]
    }
    found: dict[tuple[str, str], tuple[list[Line], list[ShareEstimate]]] = {}
    for line in lines:
        physics, said = line['job'][0], imagined.get(tuple(line['job'][1:]))
        if said is None or physics not in (NOMINAL, *SAME_PICTURE):
            continue
        rows, estimates = found.setdefault((physics, BEFORE), ([], []))
        rows.append(line)
        estimates.append(_before(calibration, said))
    return found


def _before(calibration: Calibration, said: Line) -> ShareEstimate:
    """Return the old estimate: a logistic of frames and share; its interval: the margin's."""
    features = said.get('features')
    if features is None:
        return ShareEstimate(nan, nan, nan)
    features = {key: nan if value is None else value for key, value in features.items()}
    is_foreseen = isfinite(features.get('foreseen', nan))
    features |= dict.fromkeys(DOUBTS if is_foreseen else (), nan)
    margin, known = features.get('margin', nan), _KNOWN_TO.search('; '.join(said['reasons']))
    # one softness is 10 mm in most tasks
    spread = float(known[2]) / 10 if known else 0.0
    shifts = (-spread, 0.0, spread) if isfinite(margin) else (nan, nan, nan)
    margins = [float(np.clip(margin + shift, -3, 3)) for shift in shifts]
    if not isfinite(margin):
        margins = [-3.0, nan, 3.0]
    low, middle, high = (
        capped(calibration.probability({**features, 'margin': one}), features) for one in margins
    )
    return ShareEstimate(middle, low, high)


def judged(rows: Sequence[Row]) -> list[list[str]]:
    """Return a line of cells for each judge, see `BLOCK`."""
    lines = []
    for judge in (BOTH, FORESEEN, AS_FITTED, RULE):
        of = [r for r in rows if r.judge == judge]
        if not of:
            continue
        nominal = next((r for r in of if r.physics == NOMINAL), None)
        others = [r for r in of if r.physics != NOMINAL]
        if nominal is None and judge == AS_FITTED:
            nominal = next(r for r in rows if r.physics == NOMINAL and r.judge == FORESEEN)
        cells = ['–'] * 3
        if nominal is not None:
            verdicts, success, failure, area = (nominal.cells[k] for k in (4, 5, 6, 8))
            cells = [verdicts, f'{success}; {failure}', area]
        more = ['–'] * 5
        if others:
            verdicts, success, failure, *areas = over_truths(others)[:6]
            more = [verdicts, f'{success}; {failure}', *areas]
        lines.append([f'**{judge}**' if judge == BOTH else judge, *cells, *more])
    return lines


def block(rows: Sequence[Row], num_scenes: int, seeds: str, count: int, num_kinds: int = 7) -> str:
    """Return the table of docs/results.md."""
    truths = sorted({r.physics for r in rows} - {NOMINAL})
    note = (
        f'*The expert and {num_kinds} fault kinds that each of {len(seeds.split(","))} seeds '
        f'({seeds}) drew after the code was frozen, x 6 tasks = {num_scenes} scenes; {count} '
        'rollouts in the nominal physics, and as many in each of '
        f'{", ".join(f"`{t}`" for t in truths)}; '
        f'{date.today().isoformat()}, `experiments/unseen_faults.py`. Brackets: 95 % intervals '
        'over scenes.*'
    )
    return f'{table(BLOCK, judged(rows))}\n\n{note}\n'


def groups(
    lines: Sequence[Line], estimates: Sequence[ShareEstimate]
) -> list[tuple[int, int, FloatRow]]:
    """Return successes, number, and mean (probability, low, high) of each group of estimates."""
    values = np.array(estimates, np.float64).reshape(-1, 3)
    real = np.array([line['final'] for line in lines], np.bool_)
    found = []
    for low, high in zip(EDGES[:-1], EDGES[1:], strict=True):
        at = (values[:, 0] >= low) & (values[:, 0] < high) & np.isfinite(values).all(1)
        if at.any():
            found.append((int(real[at].sum()), int(at.sum()), values[at].mean(0)))
    return found


FloatRow = Any


def coverage(lines: Sequence[Line], estimates: Sequence[ShareEstimate]) -> list[str]:
    """Return cells: estimates, and shares of them in groups that are covered."""
    found = groups(lines, estimates)
    total = sum(count for _, count, _ in found)
    if not total:
        return ['0', '–', '–']
    # a rate of n rollouts is known to half of one: none or all of them is no rate of 0 or 1
    strict = sum(
        count
        for hits, count, (_, low, high) in found
        if low <= (hits + 0.5) / count and (hits - 0.5) / count <= high
    )
    loose = 0
    for hits, count, (_, low, high) in found:
        bottom, top = wilson(hits, count)
        loose += count * (bottom <= high and low <= top)
    return [str(total), f'{strict / total:.2f}', f'{loose / total:.2f}']


def reliability(
    found: dict[tuple[str, str], tuple[list[Line], list[ShareEstimate]]], file: Path
) -> None:
    """Write the reliability diagram: nominal and all shifts, before and after."""
    figure = Figure(figsize=(11, 4.4), dpi=110, layout='constrained')
    FigureCanvasAgg(figure)
    panels: list[tuple[str, Callable[[str], bool]]] = [
        ('nominal', lambda physics: physics == NOMINAL),
        ('bold', lambda physics: physics == 'bold'),
        ('all shifts', lambda physics: physics != NOMINAL),
    ]
    styles = {
        BEFORE: ('C3', 's'),
        BOTH: ('C2', 'D'),
        FORESEEN: ('C0', 'o'),
        AS_FITTED: ('C1', '^'),
    }
    for axes, (title, holds) in zip(figure.subplots(1, 3), panels, strict=True):
        axes.plot([0, 1], [0, 1], color='0.7', lw=1)
        for number, (judge, (colour, mark)) in enumerate(styles.items()):
            pooled = [
                pair for (physics, who), pair in found.items() if who == judge and holds(physics)
            ]
            if not pooled:
                continue
            lines = [line for pair in pooled for line in pair[0]]
            values = [estimate for pair in pooled for estimate in pair[1]]
            for hits, count, (middle, low, high) in groups(lines, values):
                bottom, top = wilson(hits, count)
                x = middle + 0.006 * (number - 1.5)
                axes.plot([x, x], [bottom, top], color=colour, lw=1.2)
                axes.plot([low, high], [hits / count] * 2, color=colour, lw=0.8, ls=':')
                axes.plot(x, hits / count, mark, color=colour, ms=4 + min(count, 100) ** 0.5 / 2)
        axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02), title=title, aspect='equal')
        axes.set_xlabel('estimate (dotted: mean 95 % interval)')
    marks = [
        Line2D([], [], color=colour, marker=mark, ls='', label=judge)
        for judge, (colour, mark) in styles.items()
    ]
    figure.legend(handles=marks, loc='outside lower center', ncols=len(marks), fontsize=8)
    figure.axes[0].set_ylabel('share that succeeded (bar: 95 % Wilson)')
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file)


def confirmed_text(rows: Sequence[Sequence[str]]) -> str:
    """Return means over all truths but the nominal one, of rows of `confirmed_rows`."""
    lines = []
    for tasks in dict.fromkeys(one[1] for one in rows):
        others = [one for one in rows if one[1] == tasks and one[0] != NOMINAL]
        if others:
            unknown, error = (np.mean([float(one[k]) for one in others]) for k in (4, 7))
            lines.append(
                f'Mean of {len(others)} truths but the nominal one, tasks {tasks}: no verdict '
                f'{unknown:.2f}, ECE {error:.2f}.'
            )
    return '\n'.join(lines)


def main() -> None:
    """Run what is missing, and print and write the tables."""
    options = parse_arguments(__doc__, 1, more)
    pipelines = {
        name: Pipeline.load(name, camera_check=not options.no_camera_check)
        for name in options.checkpoints.split(',')[:1]
    }
    lines: list[Line] = []
    for seed in map(int, options.seeds.split(',')):
        lines += run(of_seed(options, seed), pipelines)
    options.seed = int(options.seeds.split(',')[0])
    found = estimates_of(options, pipelines, lines)
    rows = [row(physics, judge, *pair) for (physics, judge), pair in found.items()]
    scenes = {tuple(line['job'][1:4:2]) for line in lines}
    count = sum(r['job'][0] == NOMINAL for r in lines)
    first = block(rows, len(scenes), options.seeds, count, options.policies - 1)
    if options.readme:
        path = ROOT / 'docs' / 'results.md'
        page = path.read_text(encoding='utf-8')
        page = _MARKED.sub(lambda match: match[1] + first + match[2], page)
        path.write_text(page, encoding='utf-8')
    covered = [
        [physics, judge, *coverage(*pair)]
        for (physics, judge), pair in found.items()
        if judge in (BEFORE, BOTH, FORESEEN, AS_FITTED, FITTED)
    ]
    folder = options.out or Path('out')
    picture = f'unseen_faults_{options.machine}_{date.today().isoformat()}.png'
    reliability(found, folder / picture)
    asked = ('seeds', 'physics', 'pictures', 'size', 'scenes', 'policies', 'tasks', 'before')
    command = ' '.join(f'--{k} {getattr(options, k)}' for k in asked if getattr(options, k))
    confirmed = confirmed_rows(options, pipelines, lines)
    parts = [
        (__doc__ or '').split('\n' * 2, 2)[-1].strip(),
        f'{len(lines)} rollouts.',
        first,
        'By truth:',
        table(HEAD, [r.cells for r in sorted(rows, key=lambda r: r.physics != NOMINAL)]),
        'Over all truths but the nominal one:',
        table(ACROSS, across(rows)),
        *compared_text(options, pipelines, lines),
        'Coverage of the 95 % intervals:',
        table(COVERED, covered),
        f'![Reliability diagram]({picture})',
        'Executed chunks against the futures of the fitted parameters:',
        table(WATCHED, watch_rows(options, lines, list(pipelines))),
        'Robot cells in which nothing was fitted, confirmed by how rollouts end:',
        table(CONFIRMED, confirmed),
        confirmed_text(confirmed),
    ]
    publish(
        'unseen_faults',
        'Verdicts on faults that fresh seeds drew',
        f'python experiments/unseen_faults.py {command}',
        '\n\n'.join(parts),
        options,
        'one process',
    )


if __name__ == '__main__':
    main()
