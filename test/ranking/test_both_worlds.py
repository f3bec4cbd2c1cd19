"""Both worlds of a rollout: files, and the first moment at which they part."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from mtv_world_ros.core.data_types import SuccessEstimate
from mtv_world_ros.ranking.both_worlds import (
    command_gaps,
    first_apart,
    object_overlaps,
    verdicts_part,
)
from mtv_world_ros.ranking.episode_runner import ComparisonRunner
from mtv_world_ros.ranking.jobs import make_jobs, Result, WorldComparison
from mtv_world_ros.ranking.ranking_summary import Summary
from mtv_world_ros.ranking.run_jobs import RankedCheckpoint, read_results, run_jobs
from mtv_world_ros.reports.ranking_report import write_ranking
from mtv_world_ros.reports.result_cards import curves, verdict, when_they_part, worst_first
from mtv_world_ros.simulation.scenes.tasks import tasks_named
from mtv_world_ros.success.estimator import verdict_word
from mtv_world_ros.viewing.stored_rollout import load_rollout
from mtv_world_ros.viewing.video import decode_video
from test.support.browser import Browser

NAN = float('nan')
TASK = 'place_block_a2b_left'


def block(column, num_frames=6):
    """(1, 1, T, 12, 40) masks of a block of 6 x 6 pixels whose left edge is at `column`."""
    masks = np.zeros((1, 1, num_frames, 12, 40), bool)
    for t, x in enumerate(np.broadcast_to(column, num_frames)):
        masks[0, 0, t, 3:9, x : x + 6] = True
    return masks


def test_commands_part_where_a_joint_differs_and_are_unknown_where_one_world_ends():
    real = [np.zeros((2, 3)), np.zeros((2, 3))]
    imagined = [np.zeros((2, 3)), np.array([[0, 0.5, 0.1]])]
    np.testing.assert_allclose(command_gaps(real, imagined), [0, 0, 0.5, NAN])
    assert np.isnan(command_gaps(real, [])).all()


def test_an_object_has_parted_once_its_masks_stay_apart():
    # J of blocks 6 px wide: 2 px apart .5, 3 px 1/3
    moved = block([4, 4, 8, 4, 9, 9])
    overlaps = object_overlaps(block(4), moved)
    np.testing.assert_allclose(overlaps[0, [0, 1, 3]], 1.0)
    # one frame apart is no parting; from frame 4 on to the end is
    assert first_apart(overlaps) == [4]
    assert first_apart(object_overlaps(block(4), block(6))) == [-1]
    both = np.concatenate([block(4), block(20)]), np.concatenate([block(4), block(30)])
    # one view shows them together: nothing parts
    assert first_apart(object_overlaps(*both)) == [-1]


def test_what_no_view_shows_has_no_overlap():
    nothing = np.zeros_like(block(0))
    assert np.isnan(object_overlaps(nothing, nothing)).all()
    assert (object_overlaps(block(4), nothing) == 0).all()


def test_what_is_hidden_in_both_worlds_does_not_part():
    true, found = block(4), block(4)
    true[:, :, 2:, :, :9] = False  # a column of six is left, and none of the other
    found[:, :, 2:] = False
    assert np.isnan(object_overlaps(true, found)[0, 2:]).all()
    assert first_apart(object_overlaps(true, found)) == [-1]
    # lost in one world alone
    assert first_apart(object_overlaps(block(4), found)) == [2]


def said(probability, low, high):
    return SuccessEstimate(
        probability=probability, interval=(low, high), jaccard=np.zeros((1, 1)), reasons=()
    )


SURE = said(0.98, 0.87, 1.0)


@pytest.mark.parametrize(
    ('other', 'expected'),
    [
        (said(0.05, 0.0, 0.24), True),
        (said(0.3, 0.05, 0.8), False),  # open: it may well be a success
        (said(0.3, 0.1, 0.7), True),  # a failure, whose interval ends below that of the other
        (said(0.9, 0.8, 1.0), False),
        (said(NAN, NAN, NAN), False),
    ],
)
def test_verdicts_part_where_one_is_a_success_and_the_other_a_failure(other, expected):
    assert verdicts_part(SURE, other) is verdicts_part(other, SURE) is expected


def test_verdicts_whose_intervals_overlap_do_not_part():
    success, failure = said(0.8, 0.55, 0.95), said(0.3, 0.1, 0.7)
    assert verdict_word(success.probability, success.interval) == 'success'
    assert verdict_word(failure.probability, failure.interval) == 'failure'
    assert not verdicts_part(success, failure)
    assert verdicts_part(success, said(0.3, 0.1, 0.5))


@dataclass
class Shifted:
    """A world model that shows what another does, but with objects moved to the right."""

    world_model: object
    pixels: int

    def __getattr__(self, name):
        return getattr(self.world_model, name)

    def predict(self, *args, **options):
        return np.roll(self.world_model.predict(*args, **options), self.pixels, axis=3)


@pytest.fixture(scope='module')
def ranked(runner, expert, tmp_path_factory):
    """A ranking of a perfect imagination in a folder."""
    out = tmp_path_factory.mktemp('ranking')
    jobs = make_jobs(('expert', 'expert-stop-0.3'), tasks_named(TASK), 1, 0, expert)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            'mtv_world_ros.ranking.run_jobs.make_runner',
            lambda make_pipelines, config: ComparisonRunner([runner]),
        )
        checkpoint = RankedCheckpoint(make_pipeline=lambda: runner.pipeline, out=out, settings={})
        run_jobs(jobs, [checkpoint], config=runner.config, show_progress=False)
    return out, {result.policy: result for result in read_results(out)}


@pytest.mark.slow
def test_worlds_that_are_alike_do_not_part(ranked):
    for result in ranked[1].values():
        course = result.course
        assert np.isnan([course.commands_part_s, course.objects_part_s, course.part_s]).all()
        assert max(course.command_gaps) < 1e-6 and len(course.times) == len(course.overlaps)
        assert course.imagined == pytest.approx(course.seen, abs=0.15, nan_ok=True)
        assert when_they_part(course) == []


@pytest.mark.slow
def test_a_rollout_s_video_sheet_and_frames_lie_beside_its_result(ranked):
    out, results = ranked
    for result in results.values():
        stem = f'{TASK}_00000_{result.policy}'
        kept = load_rollout(out / 'rollouts' / f'{stem}.rollout.npz')
        num = len(result.course.times)
        assert kept.real.shape == (2, num, 144, 192, 3) and kept.fps == 5
        assert np.abs(kept.real.astype(int) - kept.imagined).mean() < 8
        frames = decode_video((out / 'rollouts' / f'{stem}.mp4').read_bytes())
        assert len(frames) == num and frames.std() > 20
        assert (out / 'rollouts' / f'{stem}.webp').stat().st_size > 5000


@pytest.mark.slow
def test_objects_that_are_imagined_elsewhere_part_and_the_page_says_when(
    runner, expert, ranked, tmp_path
):
    pipeline = replace(runner.pipeline, world_model=Shifted(runner.pipeline.world_model, 40))
    (job,) = make_jobs(('expert-stop-0.3',), tasks_named(TASK), 1, 0, expert)
    moved = type(runner)(pipeline, replace(runner.config, clips=False)).score(job)
    assert set(moved.files) == {'.png', '.objects.png'}
    assert moved.course.objects_part_s == pytest.approx(0.2) and moved.course.parted_object
    assert np.isnan(moved.course.commands_part_s)
    what = f'objects ({moved.course.parted_object})'
    assert (moved.course.objects_part_s, what) in when_they_part(moved.course)


@pytest.mark.slow
def test_every_rollout_can_be_played_from_the_page_the_worst_first(ranked):
    out, results = ranked
    wrong = replace(
        results['expert'],
        final=False,
        course=replace(results['expert'].course, objects_part_s=1.4, parted_object='red <block>'),
    )
    found = [results['expert-stop-0.3'], wrong]
    assert worst_first(found)[0] is wrong
    page = write_ranking(
        Summary(results=found, failed={}, num_true=1, provenance={}), out
    ).read_text()
    assert page.index('false success; part: objects (red &lt;block&gt;) at 1.4 s') < page.index(
        f'expert-stop-0.3 · {TASK} 0'
    )
    for policy in results:
        stem = f'rollouts/{TASK}_00000_{policy}'
        assert f'<video src="{stem}.mp4"' in page and f'src="{stem}.webp"' in page
    assert '<script' not in page and page.count('class="card ') == 2
    assert 'main:has(#policy option[value="1"]:checked) .card:not(.policy-1)' in page


def test_a_course_survives_its_file_and_old_results_have_none(make_result):
    course = WorldComparison(
        times=(0.2, 0.4), command_gaps=(0.0, NAN), overlaps=(1.0, 0.2), ends=(0.4,),
        seen=(NAN,), imagined=(0.7,), objects_part_s=0.4, parted_object='red block',
    )  # fmt: skip
    values = make_result('a', 0, True, 0.7, course=course).as_json()
    back = Result.from_json(values).course
    np.testing.assert_equal(back, course)
    assert Result.from_json({k: v for k, v in values.items() if k != 'course'}).course is None
    assert 'they part at 0.4 s' in curves(course)


def test_an_open_verdict_is_none_though_the_estimate_says_something(make_result):
    for said in (0.6, NAN):
        assert verdict(make_result('a', 0, True, said)) == 'no verdict'
    assert verdict(make_result('a', 0, False, 0.8)) == 'false success'


@pytest.mark.slow
def test_the_page_plays_and_filters_rollouts_in_a_browser(ranked, tmp_path):
    out, results = ranked
    wrong = replace(results['expert'], final=False)
    found = [results['expert-stop-0.3'], wrong]
    page = write_ranking(Summary(results=found, failed={}, num_true=1, provenance={}), out)
    browser = Browser(tmp_path / 'profile')
    try:
        browser.open(page.as_uri())
        assert [text.split(' · ')[0] for text in browser.shown()] == ['expert', 'expert-stop-0.3']
        browser.choose('verdict', 'false success')
        assert len(browser.shown()) == 1
        browser.choose('policy', 'expert-stop-0.3')
        assert browser.shown() == []
        browser.choose('verdict', 'all')
        assert [text.split(' · ')[0] for text in browser.shown()] == ['expert-stop-0.3']
        width, seconds = browser.play(1)
        browser.keep('ranking_report')
        assert width > 300 and seconds > 0
    finally:
        browser.close()
