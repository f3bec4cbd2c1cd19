"""Which plans the worker computes where they come faster than chunks, without any clock."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import count
import threading
import time
from types import SimpleNamespace
from typing import Any

import pytest

from mtv_world_ros.core.errors import RolloutPreempted
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.world_model import worker as worker_module
from mtv_world_ros.ros.world_model.worker import Ended, Request, RolloutWorker

LONGEST_S = 120.0


def request(number: int) -> Request:
    scene: Any = SimpleNamespace()
    plan: Any = SimpleNamespace()  # `_imagine` is replaced, so nobody looks at it
    return Request(
        rollout=number, plan=plan, stamp_ns=0, scene=scene, imagine=False, instruction='',
        settings=Settings(), received_s=0.0,
    )  # fmt: skip


@dataclass
class Plans:
    """A policy that sends so many plans while the first chunk of one is computed.

    Attributes:
        started: plans that were begun.
        judged: plans of which a first chunk was computed.
        arrivals: numbers of plans that come during the chunks to come.
    """

    started: list[int] = field(default_factory=list)
    judged: list[int] = field(default_factory=list)
    arrivals: list[int] = field(default_factory=list)
    sent: int = 0

    def send(self, worker: RolloutWorker) -> None:
        self.sent += 1
        worker.submit(request(self.sent))

    def imagine(self, worker: Any, running: Request) -> None:
        self.started.append(running.rollout)
        for _ in range(self.arrivals.pop(0) if self.arrivals else 0):
            self.send(worker)
        if worker._should_stop():
            raise RolloutPreempted('a newer plan came')
        worker._known.append(SimpleNamespace())
        self.judged.append(running.rollout)
        # the second chunk of a long plan is left for a newer one in any case
        if worker._should_stop():
            raise RolloutPreempted('a newer plan came')

    def run(self, monkeypatch, *bursts: list[int]) -> list[Ended]:
        """Send a plan, and those that come during its chunks and the next ones, of each burst.

        Returns:
            How all ended.
        """
        news = threading.Semaphore(0)
        monkeypatch.setattr(RolloutWorker, '_imagine', lambda w, r: self.imagine(w, r))
        pipeline: Any = SimpleNamespace(spec=SimpleNamespace(fps=5.0, num_frames=16))
        worker = RolloutWorker(pipeline, news.release)
        worker.start()
        ends: list[Ended] = []
        try:
            for burst in bursts:
                self.arrivals = list(burst)
                self.send(worker)
                end_s = time.monotonic() + LONGEST_S
                while len(ends) < self.sent or worker.busy:
                    assert time.monotonic() < end_s
                    news.acquire(timeout=0.02)
                    ends += [one for one in worker.take() if isinstance(one, Ended)]
        finally:
            worker.close()
        return ends


@pytest.mark.parametrize('each', [1, 2, 3])
def test_of_plans_faster_than_chunks_all_that_are_begun_but_the_first_are_judged(
    each, monkeypatch
):
    plans = Plans()
    ends = plans.run(monkeypatch, [each] * 20)
    assert sorted(end.request.rollout for end in ends) == list(range(1, plans.sent + 1))
    assert plans.judged == plans.started[1:] and len(plans.judged) == 20
    # the newest plan is taken each time
    assert plans.started == [1, *(1 + each * (1 + k) for k in range(20))]


def test_plans_that_come_slowly_again_are_left_at_once_for_a_newer_one(monkeypatch):
    plans = Plans()
    ends = plans.run(monkeypatch, [1, 1, 0], [1, 0])
    assert plans.started == [1, 2, 3, 4, 5] and plans.judged == [2, 3, 5]
    states = {end.request.rollout: (end.state, end.num_chunks) for end in ends}
    assert states[4] == ('preempted', 0) and states[5] == ('done', 1)


@dataclass
class ForeseenPlans(Plans):
    """Plans whose futures are told before their frames; more plans come during either.

    Attributes:
        foreseen: plans whose verdict of futures was reported.
        later: numbers of plans that come after each verdict to come.
    """

    foreseen: list[int] = field(default_factory=list)
    later: list[int] = field(default_factory=list)

    def imagine(self, worker: Any, running: Request) -> None:
        worker._is_foreseeing = True
        self.started.append(running.rollout)
        for _ in range(self.arrivals.pop(0) if self.arrivals else 0):
            self.send(worker)
        if worker._should_stop():
            raise RolloutPreempted('a newer plan came before the verdict')
        plan: Any = SimpleNamespace(chunk=0, num_chunks=1)
        success: Any = SimpleNamespace(probability=0.5)
        worker._put_foreseen(running, plan, success)
        self.foreseen.append(running.rollout)
        for _ in range(self.later.pop(0) if self.later else 0):
            self.send(worker)
        if worker._should_stop():
            raise RolloutPreempted('a newer plan came before the frames')
        prediction = SimpleNamespace(chunk=0, num_chunks=1, success=success)
        worker._known.append(SimpleNamespace(prediction=prediction))
        worker._pictured_s = worker_module.time.monotonic()
        self.judged.append(running.rollout)


def test_each_plan_that_is_begun_is_judged_by_futures_and_frames_are_skipped(monkeypatch):
    plans = ForeseenPlans(later=[])
    ends = plans.run(monkeypatch, [1] * 20)
    assert plans.foreseen == plans.started == list(range(1, 22))
    # frames came at first, then not for as long as a chunk lasts, then of the last one, for which
    # no newer one waits
    assert plans.judged == [1, 21]
    states = {end.request.rollout: (end.state, end.num_chunks) for end in ends}
    assert states[1] == states[21] == ('done', 1)
    assert all(states[number] == ('preempted', 0) for number in range(2, 21))
    # a plan whose frames were skipped says what was known of it
    assert all(end.success is not None for end in ends)


def test_frames_are_left_for_a_plan_that_comes_after_the_verdict(monkeypatch):
    plans = ForeseenPlans(later=[0, 1, 0])
    ends = plans.run(monkeypatch, [0], [0])
    assert plans.foreseen == [1, 2, 3] and plans.judged == [1, 3]
    assert [end.state for end in sorted(ends, key=lambda e: e.request.rollout)] == [
        'done', 'preempted', 'done'
    ]  # fmt: skip


def test_frames_come_again_once_none_came_for_as_long_as_a_chunk(monkeypatch):
    plans, clock = ForeseenPlans(), count()
    # each look at the clock takes a fifth of a second, a chunk lasts 3.2 s
    ticks = SimpleNamespace(monotonic=lambda: next(clock) / 5)
    monkeypatch.setattr(worker_module, 'time', ticks)
    plans.run(monkeypatch, [1] * 40)
    assert plans.foreseen == plans.started == list(range(1, 42))
    assert 4 <= len(plans.judged) <= 20
