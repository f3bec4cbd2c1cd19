import numpy as np
import pytest

from mtv_world_ros.errors import ConfigError, PolicyError
from mtv_world_ros.ranking.jobs import make_jobs
from mtv_world_ros.ranking.rank import Checkpoint, run_jobs
from mtv_world_ros.ranking.runner import ComparisonRunner, Results, RolloutConfig, WantedJob

TASK = 'place_block_a2b_left'


@pytest.fixture(scope='module')
def results(runner, expert):
    jobs = make_jobs(('expert', 'expert-stop-0.3'), (TASK,), 1, 0, expert)
    return {job.policy: runner.score(job) for job in jobs}


def test_true_success_is_the_predicate_s_at_the_end(results):
    assert results['expert'].final and results['expert'].ever
    assert not results['expert-stop-0.3'].final
    for result in results.values():
        # plan of at most 6.5 s and .6 s at rest, in answers of 3.2 s
        assert result.num_chunks == result.num_imagined == 3 and result.is_over


def test_a_perfect_imagination_is_judged_like_the_simulator_s_own_frames(results):
    for result in results.values():
        assert result.imagined.probability == pytest.approx(result.seen.probability, abs=0.15)
    assert results['expert'].imagined.success == 1.0
    stopped = results['expert-stop-0.3'].imagined
    assert stopped.success == 0.0 or np.isnan(stopped.probability)


def test_two_checkpoints_share_one_simulated_rollout(runner, expert, results, monkeypatch):
    simulated = []
    simulate = runner.simulate
    monkeypatch.setattr(runner, 'simulate', lambda job: simulated.append(job) or simulate(job))
    (job,) = make_jobs(('expert-stop-0.3',), (TASK,), 1, 0, expert)
    both = ComparisonRunner([runner, runner])
    first, none = both.score(WantedJob(job, (0,))).by_checkpoint
    assert len(simulated) == 1 and none is None
    assert first.seen.probability == results['expert-stop-0.3'].seen.probability
    assert both.score(WantedJob(job, (1,))).as_json().keys() == {'1'}


def test_results_are_kept_and_not_run_again(expert, tmp_path, monkeypatch, make_result):
    """A second run takes what is there, a broken file is run again, other settings when asked."""
    jobs = make_jobs(('expert',), (TASK,), 2, 0, expert)
    scored = []

    class Counting:
        def score(self, wanted):
            job = wanted.job
            scored.append((job.index, *wanted.checkpoints))
            result = make_result(job.policy, job.index, True, np.nan, job.task, seed=job.seed)
            return Results(tuple(result if k in wanted.checkpoints else None for k in (0, 1)))

    monkeypatch.setattr(
        'mtv_world_ros.ranking.rank.make_runner', lambda make_pipeline, config: Counting()
    )

    def run(*names, overwrite=False):
        checkpoints = [
            Checkpoint(
                make_pipeline=lambda: None, out=tmp_path / str(k), settings={'checkpoint': name}
            )
            for k, name in enumerate(names)
        ]
        found, failed = run_jobs(
            jobs,
            checkpoints,
            config=RolloutConfig(),
            overwrite=overwrite,
            show_progress=False,
        )
        assert not failed and len(found) == len(names)
        return found[0]

    first = run('a')
    assert scored == [(0, 0), (1, 0)] and [result.index for result in first] == [0, 1]
    again = run('a')
    assert len(scored) == 2
    np.testing.assert_equal(again[0].as_json()['seen'], first[0].as_json()['seen'])
    (tmp_path / '0' / 'rollouts' / f'{jobs[1].name}.json').write_text('{"settings"')
    run('a')
    assert scored[2:] == [(1, 0)]
    with pytest.raises(ConfigError, match="other settings .checkpoint 'a', now 'b'"):
        run('b')
    run('b', overwrite=True)
    assert scored[3:] == [(0, 0), (1, 0)]
    # a second checkpoint is imagined alone where the first one's results are there
    run('b', 'c')
    assert scored[5:] == [(0, 1), (1, 1)]
    assert not list(tmp_path.rglob('*.part'))


def test_a_policy_that_cannot_answer_is_told_and_the_others_go_on(
    expert, tmp_path, monkeypatch, make_result
):
    class Failing:
        def score(self, wanted):
            if wanted.job.index == 0:
                raise PolicyError('its server is gone')
            return Results((make_result('expert', 1, True, 0.9, seed=wanted.job.seed),))

    monkeypatch.setattr(
        'mtv_world_ros.ranking.rank.make_runner', lambda make_pipeline, config: Failing()
    )
    jobs = make_jobs(('expert',), (TASK,), 2, 0, expert)
    alone = Checkpoint(make_pipeline=lambda: None, out=tmp_path, settings={})
    found, failed = run_jobs(jobs, [alone], config=RolloutConfig(), show_progress=False)
    assert [result.index for result in found[0]] == [1]
    assert failed == {jobs[0]: 'its server is gone'}


def test_wrong_limits_are_refused():
    with pytest.raises(ConfigError, match='--max-chunks'):
        RolloutConfig(max_chunks=0)
