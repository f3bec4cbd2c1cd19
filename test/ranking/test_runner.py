from dataclasses import replace
import json

import numpy as np
import pytest

from mtv_world_ros.core.data_types import JointTrajectory
from mtv_world_ros.core.errors import ConfigError, PolicyError, TrajectoryError
from mtv_world_ros.ranking.episode_runner import (
    ComparisonRunner,
    EpisodeRunner,
    Results,
    RunnerConfig,
    WantedJob,
)
from mtv_world_ros.ranking.jobs import make_jobs
from mtv_world_ros.ranking.run_jobs import RankedCheckpoint, run_jobs
from mtv_world_ros.simulation.scenes.tasks import tasks_named
from mtv_world_ros.vision.describers.describer import DescribedObject
from test.support.own_task import write_shift_right

TASK = 'place_block_a2b_left'
COLOURS = ('red', 'blue', 'green', 'purple')


@pytest.fixture(scope='module')
def results(runner, expert):
    jobs = make_jobs(('expert', 'expert-stop-0.3'), tasks_named(TASK), 1, 0, expert)
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


def test_a_policy_sees_images_of_one_size_the_first_one_real(runner, expert):
    """In both worlds; and limits of joints are checked in both."""
    (job,) = make_jobs(('expert',), tasks_named(TASK), 1, 0, expert)

    class Watching:
        name = 'expert'

        def __init__(self, policy):
            self.policy, self.seen, self.seeds = policy, [], []

        def reset(self, *, seed):
            self.seeds.append(seed)
            self.seen.append([])
            self.policy.reset(seed=seed)

        def act(self, observation, instruction):
            self.seen[-1].append(observation)
            return self.policy.act(observation, instruction)

    def make_policy(*place):
        made.append(Watching(runner.config.make_policy(*place)))
        return made[-1]

    made = []
    watched = EpisodeRunner(runner.pipeline, replace(runner.config, make_policy=make_policy))
    result = watched.score(job)
    (policy,) = made
    real, imagined = policy.seen
    assert policy.seeds == [job.seed, job.seed]
    assert (result.end, result.imagined_end) == ('the policy ended it',) * 2
    (size,) = {seen.frames.shape for seen in (*real, *imagined)}
    assert size[1] > runner.pipeline.spec.height
    np.testing.assert_array_equal(real[0].frames, imagined[0].frames)
    assert [camera.width for camera in imagined[1].cameras] == [size[2]] * 2
    assert [a.stamp_ns for a in real] == [b.stamp_ns for b in imagined]
    # predicted at the model's size: alike, but not as sharp
    difference = np.abs(real[1].frames.astype(float) - imagined[1].frames)
    assert 0 < difference.mean() < 12

    class Beyond(Watching):
        def act(self, observation, instruction):
            return JointTrajectory(
                joint_names=runner.pipeline.robot.joint_names,
                times=[1.0],
                positions=[[99.0] * len(observation.positions)],
            )

    beyond = replace(runner.config, make_policy=lambda *place: Beyond(made[0].policy))
    with pytest.raises(TrajectoryError, match='limit'):
        EpisodeRunner(runner.pipeline, beyond).simulate(job)


def test_frames_come_with_joints_as_measured_and_as_commanded(runner, expert):
    (job,) = make_jobs(('expert',), tasks_named(TASK), 1, 0, expert)
    world = runner.simulate(job).world
    for chunk in world.chunks:
        assert len(chunk.positions) == 1 + chunk.frames.shape[1] == 1 + len(chunk.commands)
    np.testing.assert_array_equal(world.chunks[-1].positions[-1], world.observation.positions)
    lag = np.abs(world.chunks[0].positions[1:] - world.chunks[0].commands)
    assert 1e-4 < lag.max() < 0.5


def test_a_describer_is_asked_once_about_the_simulator_s_first_frame(runner, expert):
    """What it names is followed and judged in both worlds."""
    shown = []

    class Describer:
        def describe(self, first_frame, instruction):
            shown.append(first_frame)
            return tuple(DescribedObject(id=colour, name=f'{colour} block') for colour in COLOURS)

    (job,) = make_jobs(('expert-stop-0.3',), tasks_named(TASK), 1, 0, expert)
    asking = EpisodeRunner(replace(runner.pipeline, describer=Describer()), runner.config)
    real = asking.simulate(job)
    result = asking.imagine(job, real)
    np.testing.assert_array_equal(shown, real.world.start.frames[:1])
    assert [len(row) for row in result.seen.jaccard] == [len(COLOURS)] * 2
    assert [len(row) for row in result.imagined.jaccard] == [len(COLOURS)] * 2


@pytest.mark.slow
def test_a_task_of_ones_own_is_simulated_and_judged_by_its_definition(runner, expert, tmp_path):
    """No bundled task has this instruction: without its definition the estimates abstain."""
    path = write_shift_right(tmp_path)
    (job,) = make_jobs(('expert',), tasks_named(str(path)), 1, 0, expert)
    path.unlink()  # the job has it
    real = runner.simulate(job)
    assert real.instruction.startswith('shift the') and real.final
    result = runner.imagine(job, real)
    assert (result.seen.success, result.imagined.success) == (1.0, 1.0)
    assert result.no_picture.success == 1.0
    unknown = runner.imagine(job, replace(real, task=None))
    assert np.isnan([unknown.seen.success, unknown.imagined.success]).all()
    assert 'is no known task' in unknown.seen.reasons[0]


@pytest.mark.slow
def test_two_checkpoints_share_one_simulated_rollout(runner, expert, results, monkeypatch):
    simulated = []
    simulate = runner.simulate
    monkeypatch.setattr(runner, 'simulate', lambda job: simulated.append(job) or simulate(job))
    (job,) = make_jobs(('expert-stop-0.3',), tasks_named(TASK), 1, 0, expert)
    both = ComparisonRunner([runner, runner])
    first, none = both.score(WantedJob(job, (0,))).by_checkpoint
    assert len(simulated) == 1 and none is None
    assert first.seen.probability == results['expert-stop-0.3'].seen.probability
    assert both.score(WantedJob(job, (1,))).as_json().keys() == {'1'}


def test_results_are_kept_and_not_run_again(expert, tmp_path, monkeypatch, make_result):
    """A second run takes what is there, a broken file is run again, other settings when asked."""
    jobs = make_jobs(('expert',), tasks_named(TASK), 2, 0, expert)
    scored = []

    class Counting:
        def score(self, wanted):
            job = wanted.job
            scored.append((job.index, *wanted.checkpoints))
            result = make_result(job.policy, job.index, True, np.nan, job.task, seed=job.seed)
            return Results(tuple(result if k in wanted.checkpoints else None for k in (0, 1)))

    monkeypatch.setattr(
        'mtv_world_ros.ranking.run_jobs.make_runner',
        lambda make_pipeline, config: Counting(),
    )

    def run(*names, overwrite=False):
        checkpoints = [
            RankedCheckpoint(
                make_pipeline=lambda: None, out=tmp_path / str(k), settings={'checkpoint': name}
            )
            for k, name in enumerate(names)
        ]
        found, failed = run_jobs(
            jobs,
            checkpoints,
            config=RunnerConfig(),
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


def test_results_of_another_definition_of_a_task_are_not_taken_over(
    expert, tmp_path, monkeypatch, make_result
):
    class Scoring:
        def score(self, wanted):
            job = wanted.job
            return Results((make_result('expert', 0, True, 0.9, job.task, seed=job.seed),))

    monkeypatch.setattr(
        'mtv_world_ros.ranking.run_jobs.make_runner', lambda make_pipeline, config: Scoring()
    )
    alone = RankedCheckpoint(make_pipeline=lambda: None, out=tmp_path, settings={})

    def run(distance_m, **options):
        path = write_shift_right(tmp_path, distance_m=distance_m)
        jobs = make_jobs(('expert',), tasks_named(str(path)), 1, 0, expert)
        return run_jobs(jobs, [alone], config=RunnerConfig(), show_progress=False, **options)

    run(0.1)
    (file,) = (tmp_path / 'rollouts').glob('*.json')
    assert '"offset_m": [0.1, 0.0, 0.0]' in json.loads(file.read_text())['task_definition']
    with pytest.raises(ConfigError, match="is of another definition of the task 'shift_right'"):
        run(0.12)
    run(0.12, overwrite=True)
    assert '"offset_m": [0.12, 0.0, 0.0]' in json.loads(file.read_text())['task_definition']


def test_a_policy_that_cannot_answer_is_told_and_the_others_go_on(
    expert, tmp_path, monkeypatch, make_result
):
    class Failing:
        def score(self, wanted):
            if wanted.job.index == 0:
                raise PolicyError('its server is gone')
            return Results((make_result('expert', 1, True, 0.9, seed=wanted.job.seed),))

    monkeypatch.setattr(
        'mtv_world_ros.ranking.run_jobs.make_runner', lambda make_pipeline, config: Failing()
    )
    jobs = make_jobs(('expert',), tasks_named(TASK), 2, 0, expert)
    alone = RankedCheckpoint(make_pipeline=lambda: None, out=tmp_path, settings={})
    found, failed = run_jobs(jobs, [alone], config=RunnerConfig(), show_progress=False)
    assert [result.index for result in found[0]] == [1]
    assert failed == {jobs[0]: 'its server is gone'}


def test_wrong_limits_are_refused():
    with pytest.raises(ConfigError, match='--max-chunks'):
        RunnerConfig(max_chunks=0)
