"""The report of a ranking: tables and remarks, as Markdown, as HTML and on the console."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Any

from markupsafe import Markup

from mtv_world_ros.core.documents import DASH, render, Table
from mtv_world_ros.core.estimate_words import (
    CANNOT_TELL,
    FITTED_HERE,
    NOT_FITTED_HERE,
    state_of,
    trust_of,
)
from mtv_world_ros.core.files import write_json, write_whole
from mtv_world_ros.evaluation.metrics.statistics import MIN_EPISODES, MIN_SCENES
from mtv_world_ros.ranking.judges import (
    COLUMNS,
    JUDGES,
    MEASURES,
    REPORTED,
    RULE,
    Score,
    true_rate,
)
from mtv_world_ros.ranking.policy_order import MIN_CONFIDENCE, MIN_TELLING, PolicyOrder
from mtv_world_ros.ranking.ranking_summary import ALL_TASKS, Optimism, Summary
from mtv_world_ros.reports.charts import Point, scatter_chart
from mtv_world_ros.reports.result_cards import result_cards
from mtv_world_ros.simulation.faults.catalogue import FAULTS
from mtv_world_ros.success.comparison import RULE as COMPARISON_RULE
from mtv_world_ros.success.estimator import FAILURE_BELOW, SUCCESS_FROM

TITLE = 'Policy ranking'
#: number of hues of the report's style sheet
_NUM_HUES = 6
#: maximum number of policies that a sentence names
_MAX_LISTED = 4
#: maximum number of characters in the head of a column
_NAME_LENGTH = 17


def tables(summary: Summary) -> list[Table]:
    """Return the ranking's tables."""
    return [
        _worth(summary),
        *_pairs(summary),
        *optimism_tables(summary.optimism),
        _agreement(summary),
        *(_rates(summary, task) for task in (None, *summary.tasks)),
        _powered(summary),
        _confusion(summary),
        _speed(summary),
        *_ends(summary),
        *_failures(summary),
    ]


def order_table(order: PolicyOrder) -> Table:
    """Return the table of the partial order: for each policy those that it is better than."""
    number = {name: str(k) for k, name in enumerate(order.policies, 1)}
    rows = []
    for name, strength, interval in zip(
        order.policies, order.strengths, order.intervals, strict=True
    ):
        mine = [pair for pair in order.pairs if name in (pair.first, pair.second)]
        below = [pair.other(name) for pair in mine if pair.better == name]
        open_pairs = [pair.other(name) for pair in mine if not pair.better]
        rows.append(
            [
                number[name],
                name,
                f'{strength:.2f} {_interval(interval)}' if isfinite(strength) else DASH,
                ', '.join(number[other] for other in below) or DASH,
                ', '.join(number[other] for other in open_pairs) or DASH,
            ]
        )
    return Table(
        caption=f'Order of the policies: {order.num_ordered} of {len(order.pairs)} pairs are '
        f'ordered, {order.num_scenes} scene{"s" * (order.num_scenes != 1)} under common futures',
        head=['no.', 'policy', 'strength', 'better than no.', 'not told from no.'],
        rows=rows,
        num_labels=2,
    )


def best_policy(summary: Summary) -> tuple[str, str]:
    """Return which policy is best and how sure that is, and its class in the style sheet."""
    order = summary.order
    best, *rest = order.policies
    if not rest:
        rate = _rate(summary.judged_rate(best, None, 'imagined'))
        return f'One policy, {best}: imagined success rate {rate}.', 'few'
    if not order.pairs:
        return _highest_rate(summary), 'few'
    pairs = [pair for pair in order.pairs if best in (pair.first, pair.second)]
    below = [pair for pair in pairs if pair.better == best]
    above = [pair.better for pair in pairs if pair.better not in ('', best)]
    others = [pair.other(best) for pair in pairs if not pair.better]
    scenes = f'{order.num_scenes} scene{"s" * (order.num_scenes != 1)}'
    if not below:
        text = (
            f'No policy can be called best after {scenes}: the first, {best}, is not told from '
            f'{_listed([*others, *above])}. A pair takes {MIN_TELLING} scenes that tell, or more.'
        )
        return text, 'few'
    sure = min(pair.confidence for pair in below)
    text = f'better than {_listed([pair.other(best) for pair in below])}'
    text += f', with probability {sure:.2f} or more ({scenes})'
    if above:
        return f'{best} comes first: {text}; yet {_listed(above)} beats it in pairs.', 'doubt'
    if others:
        return f'{best} comes first: {text}; not told from {_listed(others)}.', ''
    return f'Best policy: {best}, {text}.', ''


def _highest_rate(summary: Summary) -> str:
    """Return the policy with the highest imagined rate, where no pairs can be compared."""
    rates = {name: summary.judged_rate(name, None, 'imagined') for name in summary.policies}
    known = [name for name in rates if rates[name].count]
    if not known:
        return 'No policy can be called best: no imagined rollout has an estimate.'
    best = max(known, key=lambda name: rates[name].value)
    return (
        'No policy can be called best: no two rollouts can be compared in pairs. Highest imagined '
        f'success rate: {best}, {_rate(rates[best])}.'
    )


def _listed(names: Sequence[str]) -> str:
    shown, rest = names[:_MAX_LISTED], len(names) - _MAX_LISTED
    return f'{", ".join(shown)} and {rest} more' if rest > 0 else ', '.join(shown)


def order_remark(order: PolicyOrder) -> str:
    """Describe the evidence behind the order of the policies, and its limits."""
    if not order.num_scenes:
        return (
            'The policies are not ordered: no two rollouts of one scene have common futures. That '
            'takes a checkpoint that foresees object motion, and results of this version (give '
            '--overwrite to run those of an earlier one again).'
        )
    text = (
        'Each scene is judged under futures that are the same for all policies. '
        f'{COMPARISON_RULE.text}. A pair of policies is ordered where one is better in most '
        f'scenes that tell, with probability {MIN_CONFIDENCE:.2f} or more. Strength '
        '(Bradley-Terry): probability to be better than a policy of mean strength.'
    )
    found = [text]
    if not order.is_fitted:
        found.append(
            'Contact parameters were not fitted in this robot cell, so that futures are drawn '
            'from a wide prior and most estimates of single rollouts are open: the order is the '
            'answer here. It says which policy is better under some contact, not how often one '
            'succeeds in this cell. Run `mtv-world fit contact` on recordings of this cell for '
            'that.'
        )
    if order.num_without:
        found.append(f'{order.num_without} rollouts without foreseen motion are not compared.')
    return ' '.join(found)


def _pairs(summary: Summary) -> list[Table]:
    """Return the table of all pairs of policies; empty = there is none."""
    if not summary.order.pairs:
        return []
    rows = [
        [
            pair.first,
            pair.second,
            str(pair.num_scenes),
            str(pair.num_first),
            str(pair.num_second),
            pair.better or 'not told',
            f'{pair.confidence:.2f}' if pair.leader else DASH,
        ]
        for pair in summary.order.pairs
    ]
    return [
        Table(
            caption='Pairs of policies under common futures: scenes in which one is better',
            head=['one', 'other', 'scenes', 'one better', 'other better', 'better', 'how sure'],
            rows=rows,
            num_labels=2,
        )
    ]


def remarks(summary: Summary) -> list[str]:
    """Return the remarks that explain the numbers."""
    text = render(
        'ranking_remarks.txt.j2',
        success_from=SUCCESS_FROM,
        failure_below=FAILURE_BELOW,
        seen=REPORTED['seen'].capitalize(),
        has_optimism=bool(summary.optimism),
    )
    return [*text.splitlines(), *_notes(summary)]


def _notes(summary: Summary) -> list[str]:
    """Return remarks on this ranking: its truth, agreement, calibration, and what is missing."""
    found = [_truth_remark(summary), _agreement_remark(summary), _unknown_remark(summary)]
    found.append(_trust_remark(summary))
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


def _trust_remark(summary: Summary) -> str:
    """Return how many imagined estimates are in each state of trust, with a sentence of each."""
    sentences: dict[str, list[str]] = {FITTED_HERE: [], NOT_FITTED_HERE: [], CANNOT_TELL: []}
    for result in summary.results:
        if state := state_of(result.imagined.reasons):
            sentences[state].append(trust_of(result.imagined.reasons))
    total = sum(map(len, sentences.values()))
    told = [
        f'{len(found)} of {total} {Counter(found).most_common(1)[0][0]}'
        for found in sentences.values()
        if found
    ]
    text = '; '.join(told)
    return f'Trust in the imagined estimates, with the commonest reason: {text}.' if text else ''


def _truth_remark(summary: Summary) -> str:
    truth = summary.provenance.get('physics', '')
    return f'Truth of the simulator: {truth}.' if truth else ''


def _agreement_remark(summary: Summary) -> str:
    found = summary.agreement('imagined', None)
    if not isfinite(found['pearson'].value):
        return (
            'r is not defined: less than two policies have an imagined rate, or all rates are '
            'alike.'
        )
    if found['pearson'].count == 2:
        return 'Of two policies r is 1 or -1 whatever they do: it says nothing here.'
    low = found['pearson_noise_free'].interval[0]
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


def _rate(rate: Score) -> str:
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


def _worth(summary: Summary) -> Table:
    """Return the table of the accuracy of judges with and without pictures, one row a judge."""
    rate = true_rate(summary.results)
    return Table(
        caption=f'What a picture is worth: {rate.count} rollouts, {rate.value:.0%} really succeed',
        head=[
            'judged by', 'n', 'verdicts', 'right: success', 'right: failure', 'AUROC',
            'AUROC, all', 'r',
        ],
        rows=[[judge.title, *_worth_of(summary.worth[key])] for key, judge in JUDGES.items()],
    )  # fmt: skip


def _worth_of(found: Mapping[str, Score]) -> list[str]:
    r, free = found['pearson'], found['pearson_noise_free']
    low, high = free.interval
    around = f' [{_number(low)} {_number(high)}]' if isfinite(low) else ''
    return [
        str(found['auroc'].count),
        _number(1 - found['abstention'].value),
        _cell(found['right_success']),
        _cell(found['right_failure']),
        _value(found['auroc']),
        _value(found['auroc_all']),
        f'{_number(r.value)}{around}',
    ]


def _value(score: Score) -> str:
    return _cell(score).rpartition(' ')[0] or DASH


def optimism_tables(by_model: Mapping[str, Optimism]) -> list[Table]:
    """Return the tables: overall, then by fault kind.

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
        scores, rule = (found.scores(judge, kind) for judge in ('imagined', RULE))
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
    """Return two decimals without the zero in front, 0 or 1 without any.

    A dash where there is none.
    """
    if not isfinite(value):
        return DASH
    return {'0.00': '0', '-0.00': '0', '1.00': '1'}.get(
        f'{value:.2f}', f'{value:.2f}'.replace('0.', '.', 1)
    )


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


def _scores(found: Mapping[str, Score]) -> list[str]:
    cells = []
    for name in ('pearson', 'mmrv'):
        one, free = found[name], found[f'{name}_noise_free']
        cells.append(f'{one.value:.3f}' if isfinite(one.value) else 'not defined')
        text = f'{free.value:.3f} {_interval(free.interval, 3)}'
        cells.append(text if isfinite(free.value) else '[n too small]')
    return [*cells, str(found['pearson'].count)]


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
        found = summary.false_success(judge)
        rows.append(
            [
                words,
                *map(str, summary.confusion(judge).values()),
                str(summary.abstained(judge).hits),
                f'{found.value:.2f} {_interval(found.interval)}' if found.count else DASH,
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
    """Return the table of reasons for the end of episodes, in both worlds."""
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
    """Return the table of rollouts without a result, by policy and reason."""
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
    """Return the text for the console: order of policies, what decides, rates, remarks."""
    tables = [_worth(summary), _rates(summary, None), *_failures(summary)]
    if summary.order.num_scenes:
        tables.insert(0, order_table(summary.order))
    parts = [f'{found.caption}\n\n{found.text()}' for found in tables]
    parts.insert(bool(summary.order.num_scenes), order_remark(summary.order))
    parts.insert(0, best_policy(summary)[0])
    return '\n\n'.join([*parts, *_notes(summary)])


def markdown(summary: Summary) -> str:
    """Return the ranking as a page of Markdown."""
    return render('ranking.md.j2', **_content(summary))


def write_ranking(summary: Summary, out: Path) -> Path:
    """Write `ranking.json`, `ranking.md` and `ranking.html`; return the last one's path."""
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
        rollouts=result_cards(summary.results, out),
        # videos are separate files next to the page: a thousand videos would not fit into it
        files=" 'self' file:",
    )
    write_whole(path, page)
    return path


def _answer(summary: Summary) -> tuple[str, str]:
    """Return whether looking at the imagined pictures pays, and its class in the style sheet."""
    imagined, rule, gain = summary.gain_over_rule
    shares = (
        f'imagination is right in {imagined:.2f} of {gain.count} rollouts, a rule that sees the '
        f'commands and the first frame alone in {rule:.2f}: {gain.value:+.2f} '
        f'{_interval(gain.interval)}'
    )
    scenes = len({(result.task, result.index) for result in summary.results})
    if scenes < MIN_EPISODES:
        count = f'{scenes} scene{"s" * (scenes != 1)}'
        return f'Cannot tell from {count}: give at least {MIN_EPISODES} ({shares}).', 'few'
    if gain.interval[0] > 0:
        return f'Yes: {shares}.', ''
    if gain.interval[1] < 0:
        return f'No, they mislead: {shares}.', 'doubt'
    return f'Not shown: {shares}.', 'doubt'


def _tiles(summary: Summary) -> list[tuple[str, str, str]]:
    """Name, number and note of each tile."""
    tiles = []
    judges = {'imagined': 'imagined', RULE: 'no-picture rule', 'seen': "simulator's frames"}
    for name, label in (('pearson', "Pearson's r"), ('mmrv', 'MMRV, 0 is perfect')):
        for judge, who in judges.items():
            found = summary.agreement(judge, None)
            observed, free = found[name], found[f'{name}_noise_free']
            value = f'{observed.value:.2f}' if isfinite(observed.value) else DASH
            below = 'not defined' if value == DASH else '[n too small]'
            if isfinite(free.value):
                below = f'noise-free {free.value:.2f} {_interval(free.interval)}'
            tiles.append((f'{label}, {who}', value, below))
    return tiles


def _content(summary: Summary) -> dict[str, Any]:
    """Return the values that the Markdown and the HTML page share."""
    return {
        'title': TITLE,
        'best': best_policy(summary),
        'order': order_table(summary.order) if summary.order.num_scenes else None,
        'order_remark': order_remark(summary.order),
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
    """Return the policies, numbered from the best one in the simulator on."""
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
