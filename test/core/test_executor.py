import os
import sys

import pytest

from mtv_world_ros.core.errors import ConfigError, MtvWorldError
from mtv_world_ros.core.executor import run_all, score_all
from mtv_world_ros.core.workers import Workers


@pytest.fixture
def make_scorer():
    """Classes made here travel to Ray's processes, which cannot import this file, by value."""

    class Half:
        def __init__(self, job):
            self.job = job

        def as_json(self):
            return {'job': self.job, 'half': self.job / 2, 'nothing': float('nan')}

    class HalfScorer:
        def score(self, job):
            if job == 3:
                raise MtvWorldError('three has no half')
            return Half(job)

    return HalfScorer


@pytest.fixture
def ray_environment(own_ray):
    """Ray is installed, and finds no cluster of another process."""
    return pytest.importorskip(
        'ray', reason="Ray is not installed: pip install 'mtv_world_ros[rank]'"
    )


@pytest.fixture
def make_mortal(make_scorer, tmp_path):
    """A scorer whose process dies of a job, as often as the job says."""
    base, folder = make_scorer, tmp_path

    class Mortal(base):
        def score(self, job):
            name, deaths = job
            died = len(list(folder.glob(f'{name}_*')))
            if died < deaths:
                (folder / f'{name}_{died}').touch()
                os._exit(1)
            return super().score(name)

    return Mortal


@pytest.mark.slow
@pytest.mark.usefixtures('ray_environment')
def test_a_job_whose_ray_worker_died_goes_to_another(make_mortal, capsys):
    jobs = [(1, 0), (2, 2), (4, 0)]
    found = dict(score_all(jobs, make_mortal, Workers(count=3, ray='')))
    assert {job[0]: outcome['half'] for job, outcome in found.items()} == {1: 0.5, 2: 1.0, 4: 2.0}
    assert capsys.readouterr().out.count('a Ray worker died') == 2


@pytest.mark.slow
@pytest.mark.usefixtures('ray_environment')
def test_a_job_that_ray_workers_die_of_is_an_error_after_three(make_mortal):
    jobs = [(5, 9), *((number, 0) for number in (6, 8, 10))]
    with pytest.raises(MtvWorldError, match='3 Ray workers died of the same job'):
        dict(score_all(jobs, make_mortal, Workers(count=4, ray='')))


@pytest.mark.slow
@pytest.mark.usefixtures('ray_environment')
def test_without_a_ray_worker_left_it_is_an_error(make_mortal):
    with pytest.raises(MtvWorldError, match='all Ray workers died'):
        dict(score_all([(7, 9)], make_mortal, Workers(count=1, ray='')))


@pytest.mark.slow
@pytest.mark.usefixtures('ray_environment')
def test_more_ray_workers_than_cores_wait_and_do_no_harm(make_scorer):
    workers = 1 + (os.cpu_count() or 1)
    found = dict(score_all(range(4, 9), make_scorer, Workers(count=workers, ray='')))
    assert {job: outcome['half'] for job, outcome in found.items()} == {
        job: job / 2 for job in range(4, 9)
    }


@pytest.mark.slow
@pytest.mark.usefixtures('ray_environment')
def test_ray_scores_as_processes_do(make_scorer):
    jobs = [1, 2, 3, 4]
    found = dict(score_all(jobs, make_scorer, Workers(count=1, ray='')))
    assert found == dict(score_all(jobs, make_scorer, Workers(threads=1)))
    assert found[3] == 'three has no half' and found[4] == {'job': 4, 'half': 2.0, 'nothing': None}


def test_without_ray_the_extra_is_named(make_scorer, monkeypatch):
    monkeypatch.setitem(sys.modules, 'ray', None)
    monkeypatch.setenv('RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER', '0')  # is set, and given back
    with pytest.raises(ConfigError, match=r'mtv_world_ros\[rank\].*--workers'):
        next(score_all([1], make_scorer, Workers(count=1, ray='')))


def test_less_than_one_worker_is_refused(make_scorer):
    with pytest.raises(ConfigError, match='workers is 0'):
        next(score_all([1], make_scorer, Workers(count=0, ray='')))


@pytest.mark.parametrize(
    ('address', 'environment', 'is_local'),
    [('', {}, True), ('192.0.2.1:6392', {}, False), ('', {'RAY_ADDRESS': '192.0.2.1:6392'}, False),
     ('', {'AT_HAND': '1'}, False)],
)  # fmt: skip
def test_a_cluster_that_is_started_here_listens_on_this_machine_alone(
    address, environment, is_local, make_scorer, monkeypatch, tmp_path
):
    """Ray 2.60 reads the variable when it is imported."""
    monkeypatch.setitem(sys.modules, 'ray', None)
    monkeypatch.setenv('RAY_TMPDIR', str(tmp_path))
    monkeypatch.delenv('RAY_ADDRESS', raising=False)
    monkeypatch.setenv('RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER', '1')
    monkeypatch.delenv('RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER')
    if environment.pop('AT_HAND', None):
        (tmp_path / 'ray').mkdir()
        (tmp_path / 'ray' / 'ray_current_cluster').write_text('192.0.2.1:6392')
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ConfigError, match='needs ray'):
        next(score_all([(7, 9)], make_scorer, Workers(ray=address)))
    assert (os.environ.get('RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER') == '0') == is_local


@pytest.fixture
def make_adder():
    """Returns a function that adds one, or raises."""

    def make():
        def add(job):
            if job < 0:
                raise MtvWorldError(f'{job} is below 0')
            return job + 1

        return add

    return make


@pytest.mark.slow
@pytest.mark.usefixtures('ray_environment')
def test_what_a_job_raises_on_ray_is_raised_here(make_adder, tmp_path):
    assert dict(run_all([1, 2], make_adder, Workers(ray='', writes=tmp_path))) == {1: 2, 2: 3}
    # the files that tell machines the folder of results do not stay
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(MtvWorldError, match='-1 is below 0'):
        dict(run_all([-1], make_adder, Workers(ray='')))


@pytest.mark.slow
@pytest.mark.usefixtures('ray_environment')
def test_gpus_that_no_machine_has_are_an_error_at_once(make_adder):
    with pytest.raises(ConfigError, match='asks for 1 CPU cores and 3 GPUs.*--gpus-per-worker'):
        dict(run_all([1], make_adder, Workers(ray='', gpus=3)))


@pytest.mark.slow
@pytest.mark.usefixtures('ray_environment')
def test_a_file_that_a_machine_lacks_is_named(make_adder, tmp_path):
    lost = tmp_path / 'data'
    with pytest.raises(ConfigError, match=f"has no '{lost}'; put it under the same path"):
        dict(run_all([1], make_adder, Workers(ray='', reads=(lost,))))


def test_a_folder_of_results_that_a_machine_does_not_see_is_named(tmp_path, monkeypatch):
    from mtv_world_ros.core import ray_actors

    monkeypatch.setattr(ray_actors, 'SHARED_FILE_TIMEOUT_S', 0.0)
    problem = ray_actors._unseen([], tmp_path / 'out' / '.workers_1')
    assert f"does not see '{tmp_path / 'out'}'" in str(problem)


@pytest.mark.slow
def test_a_cluster_of_another_version_is_an_error(make_adder, ray_environment, monkeypatch):
    def refuse(**_):
        raise RuntimeError('Version mismatch: The cluster was started with:\n    Ray: 2.9.0')

    monkeypatch.setattr(ray_environment, 'init', refuse)
    with pytest.raises(ConfigError, match=r'another version than the .*Ray: 2\.9\.0'):
        dict(run_all([1], make_adder, Workers(ray='192.0.2.1:6392')))


def test_threads_are_those_asked_for_or_what_ray_reserves():
    assert Workers(ray='', cpus=4).num_threads == 4
    assert Workers(ray='', cpus=4, threads=2).num_threads == 2
    cores = len(os.sched_getaffinity(0))
    assert Workers(count=cores).num_threads == 1 and Workers().num_threads == cores
