"""The short, repeatable part of `make fuzz`: nothing that is read ends in a traceback or hangs."""

from __future__ import annotations

import fuzz
import numpy as np
import pytest

SEED = 20261122
COUNT = 60


@pytest.mark.parametrize('name', fuzz.KINDS)
def test_mutated_input_is_read_or_refused_with_a_reason(name, tmp_path) -> None:
    kind = fuzz.KINDS[name]
    samples = kind.seeds()
    outcomes = [fuzz.attempt(kind, sample, tmp_path)[0] for sample in samples[:3]]
    assert set(outcomes) == {'survived'}  # what is not mutated is read
    for case in range(max(COUNT // fuzz.SLOW.get(name, 1), 2)):
        rng = np.random.default_rng([SEED, case])
        data = fuzz.mutated(samples[rng.integers(len(samples))], rng)
        outcome, _ = fuzz.attempt(kind, data, tmp_path)
        assert outcome in ('rejected', 'survived'), f'--seed {SEED} --case {case}: {outcome}'


def test_an_error_that_is_not_ours_and_a_slow_case_are_failures(tmp_path) -> None:
    def crash(data, folder):
        raise KeyError('of somebody')

    kind = fuzz.Kind(lambda: [b'x'], crash)
    assert 'KeyError' in fuzz.attempt(kind, b'x', tmp_path)[0]
    slow = fuzz.Kind(lambda: [b'x'], lambda data, folder: sum(range(10**6)), most_s=0.0)
    assert 'took' in fuzz.attempt(slow, b'x', tmp_path)[0]
