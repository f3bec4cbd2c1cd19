import sys

import pytest

from mtv_world_ros.errors import ConfigError, MtvWorldError
from mtv_world_ros.lab.jobs import score_all, score_with_ray


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


def test_ray_scores_as_processes_do(make_scorer):
    pytest.importorskip('ray', reason="Ray is not installed: pip install 'mtv_world_ros[rank]'")
    jobs = [1, 2, 3, 4]
    found = dict(score_with_ray(jobs, make_scorer, 1))
    assert found == dict(score_all(jobs, make_scorer, 1, 1))
    assert found[3] == 'three has no half' and found[4] == {'job': 4, 'half': 2.0, 'nothing': None}


def test_without_ray_the_extra_is_named(make_scorer, monkeypatch):
    monkeypatch.setitem(sys.modules, 'ray', None)
    with pytest.raises(ConfigError, match=r'mtv_world_ros\[rank\].*--workers'):
        next(score_with_ray([1], make_scorer, 1))


def test_less_than_one_worker_is_refused(make_scorer):
    with pytest.raises(ConfigError, match='workers is 0'):
        next(score_with_ray([1], make_scorer, 0))
