from math import isnan, nan

import numpy as np
import pytest

from mtv_world_ros.evaluation.metrics.success_agreement import area_under_roc
from mtv_world_ros.ranking.flips import (
    find_flips,
    flip_sheet,
    is_nearer,
    last_frames_png,
    objects_png,
    read_last_frames,
)
from mtv_world_ros.ranking.judges import area_interval
from mtv_world_ros.ranking.ranking_summary import Optimism
from mtv_world_ros.reports.ranking_report import optimism_tables
from mtv_world_ros.simulation.faults.catalogue import FAULTS, kinds_of, parse_variant, policies_of


@pytest.mark.parametrize('split', ['train', 'calibrate', 'test'])
def test_a_policy_set_covers_its_split_and_no_other(split):
    names = policies_of(split)
    kinds = {kind for name in names for kind in parse_variant(name).kinds}
    assert kinds == set(kinds_of(split))
    assert len(names) >= 13 and names[0] == 'expert' and len(set(names)) == len(names)
    assert all(parse_variant(name).name == name for name in names)


@pytest.fixture
def optimism(make_result):
    """Eight scenes: the expert succeeds; `high` really fails and is called a success."""
    results = []
    for index in range(8):
        results += [
            make_result('expert', index, True, 0.9),
            make_result('expert-high-0.03', index, False, 0.8, rule=index < 2),
            make_result('expert-elsewhere-0.1', index, False, nan if index < 4 else 0.1),
        ]
    flips = {r.name: r.policy == 'expert-elsewhere-0.1' for r in results if not r.final}
    return Optimism(results=results, flips=flips)


def test_false_successes_abstentions_and_flips_are_counted(optimism):
    found = optimism.scores('imagined')
    assert (found['false_success'].value, found['false_success'].count) == (8 / 12, 12)
    low, high = found['false_success'].interval
    assert low < 8 / 12 < high
    assert (found['abstention'].value, found['abstention'].count) == (4 / 24, 24)
    assert (found['flips'].value, found['flips'].count) == (0.5, 16)
    assert (found['contact_flips'].value, found['contact_flips'].count) == (0.0, 8)
    assert found['auroc'].value == 1.0 and found['over_rule'].count == 20
    # the rule: two of twelve failures called a success, of eight of them ties with successes
    assert found['over_rule'].value == pytest.approx(1 - (1 - 0.5 * 2 / 12))


def test_a_kind_is_measured_against_the_expert(optimism):
    assert optimism.kinds == ('grasp_height', 'goal_offset')
    high, elsewhere = (optimism.scores('imagined', kind) for kind in optimism.kinds)
    assert high['false_success'].value == 1.0 and high['auroc'].value == 1.0
    assert high['pearson'].count == 2 and high['flips'].count == 8
    assert elsewhere['false_success'].value == 0.0 and elsewhere['abstention'].value == 0.5
    assert elsewhere['contact_flips'].count == 0 and isnan(elsewhere['contact_flips'].value)
    rule = optimism.scores('no_picture', 'grasp_height')
    assert rule['false_success'].value == 0.25
    assert rule['flips'].count == 0 and isnan(rule['over_rule'].value)


def test_tables_fit_a_console(optimism):
    both = {'/data/somebody/new': optimism, 'bundled': optimism}
    for by_model in ({'bundled': optimism}, both):
        tables = optimism_tables(by_model)
        assert len(tables) == 1 + len(by_model)
        lines = '\n'.join(table.markdown() for table in tables).splitlines()
        assert max(map(len, lines)) <= 100
    assert '.67 [.34 .88] 12' in '\n'.join(lines) and 'goal_offset *' in '\n'.join(lines)
    assert optimism_tables({}) == []


@pytest.mark.parametrize(
    ('names', 'heads'),
    [
        (('/data/somebody/new', 'bundled'), ['…ata/somebody/new', 'bundled']),
        (('new/resource/checkpoint', 'old/resource/checkpoint'), ['new', 'old']),
        (('/a/much/longer/path/w', '/b/much/longer/path/w'), ['/a', '/b']),
        (('/one/longer/path/w', '/two/longer/path/v'), ['…ne/longer/path/w', '…wo/longer/path/v']),
        (('/a/run/longer/path/w', '/b/run/longer/path/w/'), ['/a', '/b']),
        (
            ('/one_of_two_long_names', '/two_of_two_long_names'),
            ['1 …f_two_long_names', '2 …f_two_long_names'],
        ),
    ],
)
def test_checkpoints_of_one_name_keep_a_column_each(optimism, names, heads):
    overall = optimism_tables(dict.fromkeys(names, optimism))[0]
    assert list(overall.head[1:3]) == heads and len(overall.head) == 5


def test_areas_agree_with_the_plain_one_and_scenes_are_left_out_whole():
    rng = np.random.default_rng(0)
    said, real = rng.integers(0, 5, 40) / 4, rng.uniform(size=40) < 0.4
    scenes = [('stack', k // 4) for k in range(40)]
    area, (low, high) = area_interval([said], real, scenes)
    assert area == pytest.approx(area_under_roc(said, real)) and 0 < low < area < high < 1
    # by hand: the spread of the areas without one scene each, on the logit scale
    rest = np.array(
        [
            area_under_roc(*(np.delete(one, range(4 * k, 4 * k + 4)) for one in (said, real)))
            for k in range(10)
        ],
        float,
    )
    error = np.sqrt(0.9 * ((rest - np.mean(rest)) ** 2).sum()) / (area * (1 - area))
    ends = [
        1 / (1 + np.exp(-(np.log(area / (1 - area)) + t * error))) for t in (-2.262157, 2.262157)
    ]
    assert (low, high) == pytest.approx(tuple(ends), abs=1e-6)
    other = area_under_roc(said[::-1], real)
    assert other is not None
    value, (low, high) = area_interval([said, said[::-1]], real, scenes)
    assert value == pytest.approx(area - other) and -1 <= low < high <= 1
    perfect, none = area_interval([real.astype(float)], real, scenes)
    assert perfect == 1.0 and np.isnan(none).all()


def test_a_flip_is_right_where_the_end_is_nearer_to_what_really_happened(tmp_path, make_result):
    rng = np.random.default_rng(0)
    table = rng.integers(0, 200, (2, 6, 8, 3), dtype=np.uint8)
    placed, left = table.copy(), table.copy()
    placed[:, :2, :2], left[:, 4:, 5:] = 255, 255
    ends = {'expert': (placed, placed), 'expert-high-0.03': (left, placed),
            'expert-late-0.6': (left, left), 'expert-turn-1': (placed, placed),
            'expert-loose-1': (left, left)}  # fmt: skip
    results = [make_result(p, 0, p in ('expert', 'expert-turn-1'), 0.9) for p in ends]
    for result in results[:-1]:  # the last one has no picture
        png = last_frames_png(*ends[result.policy])
        (tmp_path / f'{result.name}.png').write_bytes(png)
        shown = objects_png((ends[result.policy][0] == 255).all(-1)[:, None])
        (tmp_path / f'{result.name}.objects.png').write_bytes(shown)
    assert find_flips(results, tmp_path) == {
        'stack_blocks_two_00000_expert-high-0.03': False,
        'stack_blocks_two_00000_expert-late-0.6': True,
    }
    kept = read_last_frames(tmp_path / 'stack_blocks_two_00000_expert-high-0.03.png')
    assert kept is not None
    real, imagined = kept
    np.testing.assert_array_equal(real, np.concatenate(list(left), axis=1))
    np.testing.assert_array_equal(imagined, np.concatenate(list(placed), axis=1))
    flips = find_flips(results, tmp_path)
    sheet = flip_sheet(results, flips, tmp_path)
    one = flip_sheet(results, flips, tmp_path, count=1)
    assert sheet is not None and one is not None and len(sheet) == 2 * len(one)
    assert np.array_equal(sheet[: len(one)], one)
    assert flip_sheet(results[:1], {}, tmp_path) is None


def test_pixels_that_are_alike_in_both_ends_do_not_count():
    real, other = np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4, 3), np.uint8)
    other[0, 0] = 100
    imagined = np.full((4, 4, 3), 255, np.uint8)
    everywhere = np.ones((4, 4), bool)
    imagined[0, 0] = 49
    assert is_nearer(imagined, real, other, everywhere)
    imagined[0, 0] = 51
    assert not is_nearer(imagined, real, other, everywhere)


def test_arms_that_end_elsewhere_do_not_count():
    """The object is imagined at its goal, where it is not; the arm is where it is."""
    real, other = np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4, 3), np.uint8)
    real[2:], other[0, 0] = 90, 200  # a large arm, a small object
    imagined = real.copy()
    imagined[0, 0] = 200
    objects = np.zeros((4, 4), bool)
    objects[0, 0] = True
    assert not is_nearer(imagined, real, other, objects)
    assert is_nearer(imagined, real, other, np.ones((4, 4), bool))


def test_contact_is_in_the_catalogue():
    assert not FAULTS['goal_offset'].contact and FAULTS['grasp_lean'].contact
