"""The report of a ranking: tables and remarks, as Markdown, as HTML and on the console."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from typing import Any

from markupsafe import Markup

from mtv_world_ros.bench.ranking.judges import Agreement, COLUMNS, REPORTED
from mtv_world_ros.bench.ranking.optimism_tables import optimism_tables, worth_table
from mtv_world_ros.bench.ranking.optimism_tables import REMARK as OPTIMISM_REMARK
from mtv_world_ros.bench.ranking.ranking_summary import ALL_TASKS, Rate, Summary
from mtv_world_ros.bench.ranking.rollout_cards import rollout_cards
from mtv_world_ros.files import write_json, write_whole
from mtv_world_ros.lab.documents import DASH, render, Table
from mtv_world_ros.lab.evaluation.metrics.statistics import MIN_SCENES
from mtv_world_ros.lab.evaluation.report.charts import Point, scatter_chart
from mtv_world_ros.success.verdict import FAILURE_BELOW, SUCCESS_FROM

TITLE = 'Policy ranking'
#: hues of the report's style sheet
_NUM_HUES = 6
_MEANING = (
    "Success in the simulator: the task's relations hold on true object poses at the end. In "
    'imagination, which starts from the same first pictures, an estimate is made at the end: a '
    f'rate is the mean of the estimates; a verdict is success from {SUCCESS_FROM} on, failure '
    f'below {FAILURE_BELOW}, and open between. Scripted policies go by time and do not look: '
    'only the world that their commands meet differs. Policies that look may also send other '
    'commands in each world.'
)
_CEILING = (
    "'{seen}' is what imagination could reach at best: its errors are the estimator's, the rest "
    "are the world model's."
)
_WORTH = (
    'What decides: the foreseen motions of objects; pictures show them. In the first table, '
    'foreseen motions alone: the share of those that succeed, from the commands and the first '
    "frame. Pictures alone: the paper's way, trails and first masks are drawn and no motion is "
    'foreseen. Both: the estimate. The no-picture rule: an object sticks to a gripper that closes '
    "near it. Real frames: the same estimator on the simulator's. n: rollouts with an estimate."
)
_INTERVALS = (
    'Intervals of rates: Wilson, 95 %. The noise of few scenes makes the observed r too small and '
    'the observed MMRV too large. Noise-free: what they would be on endless scenes, an estimate '
    'and its 95 % interval; none below 4 scenes or 3 policies. MMRV weighs a wrongly ranked pair '
    'by how far its true rates lie apart; 0 is perfect.'
)


def tables(summary: Summary) -> list[Table]:
    """Returns the ranking's tables."""
    return [
        worth_table(summary.results, summary.worth),
        *optimism_tables(summary.optimism),
        _agreement(summary),
        *(_rates(summary, task) for task in (None, *summary.tasks)),
        _powered(summary),
        _confusion(summary),
        _speed(summary),
        *_ends(summary),
        *_failures(summary),
    ]


def remarks(summary: Summary) -> list[str]:
    """Returns what has to be known to read the numbers."""
    found = [
        _MEANING,
        _CEILING.format(seen=REPORTED['seen'].capitalize()),
        _truth_remark(summary),
        _WORTH,
        _agreement_remark(summary),
        _unknown_remark(summary),
        _INTERVALS,
        OPTIMISM_REMARK if summary.optimism else '',
    ]
    told = ' '.join(reason for result in summary.results for reason in result.imagined.reasons)
    if 'uncalibrated' in told:
        weights = (
            'stated ones, not fitted ones' if 'stated weights' in told else 'fitted elsewhere'
        )
        found.append(f'The estimates are not calibrated: their weights are {weights}.')
    cut = sum(not result.is_over for result in summary.results)
    if cut:
        found.append(f'{cut} rollouts were cut off by the limit of chunks.')
    if summary.failed:
        first, reason = next(iter(summary.failed.items()))
        found.append(
            f'{len(summary.failed)} rollouts have no result and are in no rate; the first, '
            f'{first.name}: {reason}'
        )
    return [remark for remark in found if remark]


def _truth_remark(summary: Summary) -> str:
    truth = summary.provenance.get('physics', '')
    return f'Truth of the simulator: {truth}.' if truth else ''


def _agreement_remark(summary: Summary) -> str:
    found = summary.agreement('imagined', None)['pearson']
    if not isfinite(found.value):
        return (
            'r is not defined: less than two policies have an imagined rate, or all rates are '
            'alike.'
        )
    if found.num_policies == 2:
        return 'Of two policies r is 1 or -1 whatever they do: it says nothing here.'
    low = found.interval[0]
    if not isfinite(low):
        return (
            f'r has no interval, so nothing follows from it: that takes at least {MIN_SCENES} '
            'scenes, and more than one value of r among them.'
        )
    if not low > 0:
        return (
            'The interval of the noise-free r reaches zero: these episodes do not show that '
            'imagination ranks these policies better than chance.'
        )
    return ''


def _unknown_remark(summary: Summary) -> str:
    per_task = {
        task: sum(summary.judged_rate(p, task, 'imagined').num_unknown for p in summary.policies)
        for task in summary.tasks
    }
    if not any(per_task.values()):
        return ''
    blind = [
        task
        for task in summary.tasks
        if not any(summary.judged_rate(p, task, 'imagined').count for p in summary.policies)
    ]
    by_task = ', '.join(f'{task}: {count}' for task, count in per_task.items())
    text = (
        f'{sum(per_task.values())} of {len(summary.results)} imagined episodes have no estimate '
        f'({by_task}). Rates, r and MMRV are of the others alone; if failures lack one more '
        'often, imagined rates are too high.'
    )
    if blind:
        text += f' It judged nothing of {", ".join(blind)}; that task is in no imagined rate.'
    return text


def _rate(rate: Rate) -> str:
    unknown = f'{rate.num_unknown} without an estimate'
    if not rate.count:
        return f'{DASH} ({unknown})' if rate.num_unknown else DASH
    text = f'{rate.value:.2f} {_interval(rate.interval)} of {rate.count}'
    return f'{text}, {unknown}' if rate.num_unknown else text


def _interval(interval: tuple[float, float], digits: int = 2) -> str:
    low, high = interval
    return f'[{low:.{digits}f}, {high:.{digits}f}]' if isfinite(low) else '[n too small]'


def _rates(summary: Summary, task: str | None) -> Table:
    rows = [
        [
            policy,
            _rate(summary.true_rate(policy, task)),
            *(_rate(summary.judged_rate(policy, task, judge)) for judge in REPORTED),
        ]
        for policy in summary.policies
        if summary.chosen(policy, task)
    ]
    head = ['policy', 'simulator', *REPORTED.values()]
    return Table(caption=f'Success rates, {task or ALL_TASKS}', head=head, rows=rows)


def _agreement(summary: Summary) -> Table:
    rows = []
    for label, task in {ALL_TASKS: None, **{name: name for name in summary.tasks}}.items():
        found = {judge: summary.agreement(judge, task) for judge in REPORTED}
        for judge, scores in found.items():
            rows.append([label, COLUMNS[judge], *_scores(scores)])
    return Table(
        caption='Agreement with the simulator, over the policies',
        head=[
            'task', 'judged on', "Pearson's r", 'r noise-free', 'MMRV', 'MMRV noise-free',
            'policies',
        ],
        rows=rows,
        num_labels=2,
    )  # fmt: skip


def _scores(found: Mapping[str, Agreement]) -> list[str]:
    cells = []
    for one in found.values():
        cells.append(f'{one.value:.3f}' if isfinite(one.value) else 'not defined')
        free = f'{one.noise_free:.3f} {_interval(one.interval, 3)}'
        cells.append(free if isfinite(one.noise_free) else '[n too small]')
    return [*cells, str(next(iter(found.values())).num_policies)]


def _powered(summary: Summary) -> Table:
    rows = []
    for policy in summary.policies:
        found, true = summary.powered(policy), summary.true_rate(policy, None)
        rows.append(
            [
                policy,
                f'{found.value:.2f} {_interval(found.interval)}',
                f'{found.weight:.2f}',
                f'{found.num_true} + {found.num_more}',
                f'{true.value:.2f} of {true.count}',
            ]
        )
    return Table(
        caption=f'Prediction-powered success rates: {summary.num_true} true episodes of each '
        'task, and all imagined ones (an abstention counts as one half)',
        head=['policy', 'estimate', 'weight of imagination', 'true + imagined', 'all true ones'],
        rows=rows,
    )


def _confusion(summary: Summary) -> Table:
    rows = []
    for judge, words in REPORTED.items():
        counts = summary.confusion(judge)
        failures = counts['success_failure'] + counts['failure_failure']
        share = counts['success_failure'] / failures if failures else 0.0
        interval = _interval(summary.false_success_interval(judge))
        rows.append(
            [
                words,
                *(str(count) for count in counts.values()),
                str(summary.abstained(judge).hits),
                f'{share:.2f} {interval}' if failures else DASH,
            ]
        )
    return Table(
        caption='Single rollouts: what was said, and what was true',
        head=[
            'judged on', 'success, true', 'success, false', 'failure, false', 'failure, true',
            'no verdict', 'false-success rate',
        ],
        rows=rows,
    )  # fmt: skip


def _speed(summary: Summary) -> Table:
    rows = [
        [words, f'{value:.0f}' if 'hour' in words else f'{value:.3f}']
        for words, value in summary.speed().items()
    ]
    caption = 'Speed of one process, wall time, means over the rollouts'
    return Table(caption=caption, head=['', ''], rows=rows)


def _ends(summary: Summary) -> list[Table]:
    """Why episodes ended, in both worlds."""
    pairs = [(result.end, result.imagined_end) for result in summary.results]
    known = sorted({end for pair in pairs for end in pair if end})
    if not known:
        return []
    rows = [
        [
            policy,
            *(
                f'{sum(r.end == end for r in found)} / {sum(r.imagined_end == end for r in found)}'
                for end in known
            ),
        ]
        for policy in summary.policies
        for found in [summary.chosen(policy, None)]
    ]
    return [
        Table(
            caption='How episodes ended, in the simulator / in imagination',
            head=['policy', *known],
            rows=rows,
        )
    ]


def _failures(summary: Summary) -> list[Table]:
    """How many rollouts have no result, by policy, and why."""
    if not summary.failed:
        return []
    by_policy: dict[str, list[str]] = {}
    for job, reason in summary.failed.items():
        by_policy.setdefault(job.policy, []).append(reason)
    rows = [
        [policy, str(len(reasons)), str(len(summary.chosen(policy, None))), reasons[0]]
        for policy, reasons in by_policy.items()
    ]
    return [
        Table(
            caption='Rollouts without a result, by policy',
            head=['policy', 'without', 'with', 'the first reason'],
            rows=rows,
        )
    ]


def console(summary: Summary) -> str:
    """Returns what is worth a look at once: agreement, rates over all tasks, speed."""
    tables = [
        worth_table(summary.results, summary.worth),
        *optimism_tables(summary.optimism),
        _agreement(summary),
        _rates(summary, None),
        _powered(summary),
        _speed(summary),
        *_failures(summary),
    ]
    parts = [f'{found.caption}\n\n{found.text()}' for found in tables]
    return '\n\n'.join([*parts, *remarks(summary)[2:]])


def markdown(summary: Summary) -> str:
    """Returns the ranking as a page of Markdown."""
    return render('ranking.md.j2', **_content(summary))


def write_ranking(summary: Summary, out: Path) -> Path:
    """Writes `ranking.json`, `ranking.md` and `ranking.html`; returns the last one's path."""
    write_json(out / 'ranking.json', summary.as_json())
    write_whole(out / 'ranking.md', markdown(summary))
    path = out / 'ranking.html'
    charts = [
        (f'{task or ALL_TASKS}: {REPORTED[judge]}', _chart(summary, judge, task))
        for task in (None, *summary.tasks)
        for judge in REPORTED
        if any(summary.judged_rate(p, task, judge).count for p in summary.policies)
    ]
    page = render(
        'ranking.html.j2',
        **_content(summary),
        answer=_answer(summary),
        tiles=_tiles(summary),
        charts=charts,
        policies=_points(summary, next(iter(REPORTED)), None),
        rollouts=rollout_cards(summary.results, out),
        # the videos lie beside the page: a thousand of them would not fit into it
        files=" 'self' file:",
    )
    write_whole(path, page)
    return path


def _answer(summary: Summary) -> tuple[str, bool]:
    """Returns whether looking at the imagined pictures pays, and whether that is shown."""
    found = summary.gain_over_rule
    shares = (
        f'imagination is right in {found.imagined:.2f} of {len(summary.results)} rollouts, a rule '
        f'that sees the commands and the first frame alone in {found.rule:.2f}: '
        f'{found.difference:+.2f} {_interval(found.interval)}'
    )
    if found.interval[0] > 0:
        return f'Yes: {shares}.', True
    if found.interval[1] < 0:
        return f'No, they mislead: {shares}.', False
    return f'Not shown: {shares}.', False


def _tiles(summary: Summary) -> list[tuple[str, str, str]]:
    """Name, number and what is below it."""
    tiles = []
    for name, label in (('pearson', "Pearson's r"), ('mmrv', 'MMRV, 0 is perfect')):
        judges = {
            'imagined': summary.agreement('imagined', None)[name],
            'no-picture rule': summary.rule_agreement[name],
            "simulator's frames": summary.agreement('seen', None)[name],
        }
        for who, found in judges.items():
            value = f'{found.value:.2f}' if isfinite(found.value) else DASH
            below = 'not defined' if value == DASH else '[n too small]'
            if isfinite(found.noise_free):
                below = f'noise-free {found.noise_free:.2f} {_interval(found.interval)}'
            tiles.append((f'{label}, {who}', value, below))
    return tiles


def _content(summary: Summary) -> dict[str, Any]:
    """What both pages hold."""
    return {
        'title': TITLE,
        'remarks': remarks(summary),
        'tables': tables(summary),
        'made': summary.provenance,
    }


def _chart(summary: Summary, judge: str, task: str | None) -> Markup:
    return scatter_chart(
        f'{task or ALL_TASKS}: {REPORTED[judge]}',
        _points(summary, judge, task),
        'success rate in the simulator',
        'judged success rate',
    )


def _points(summary: Summary, judge: str, task: str | None) -> list[Point]:
    """Policies, numbered from the best one in the simulator on."""
    points = []
    for number, policy in enumerate(summary.policies):
        if not summary.chosen(policy, task):
            continue
        true = summary.true_rate(policy, task)
        judged = summary.judged_rate(policy, task, judge)
        points.append(
            Point(
                label=str(number + 1),
                title=policy,
                x=true.value,
                y=judged.value,
                x_interval=true.interval,
                y_interval=judged.interval,
                colour=f'c{number % _NUM_HUES}',
            )
        )
    return points
