"""FAST tokens: the cosine transform, rounding, and byte-pair encoding without loss."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mtv_world_ros.control.fast_tokens import dequantise, FastTokenizer, quantise, SCALE
from mtv_world_ros.core.errors import TrainingError


@pytest.fixture(scope='module')
def chunks() -> list[np.ndarray]:
    """200 smooth motions of 16 actions of 6 numbers in [-1, 1]."""
    rng = np.random.default_rng(0)
    time = np.linspace(0, 1, 16)[:, None]
    ends = rng.uniform(-1, 1, (200, 2, 6))
    return [a + (b - a) * time**2 for a, b in ends]


@pytest.fixture(scope='module')
def tokenizer(chunks: list[np.ndarray]) -> FastTokenizer:
    return FastTokenizer.train(chunks)


def test_coefficients_are_ten_times_the_orthonormal_cosine_transform_rounded():
    """By its definition, DCT-II; lowest frequency first."""
    actions = np.random.default_rng(2).uniform(-1, 1, (16, 3))
    frequency, time = np.arange(16)[:, None], np.arange(16)[None]
    matrix = np.sqrt(2 / 16) * np.cos(np.pi * frequency * (2 * time + 1) / 32)
    matrix[0] /= np.sqrt(2)
    np.testing.assert_array_equal(quantise(actions), np.rint(SCALE * matrix @ actions))
    held = quantise(np.full((16, 2), [0.5, -0.25]))
    # only the mean of a constant is left: sqrt(16) * value * 10
    np.testing.assert_array_equal(held[0], [20, -10])
    assert not held[1:].any()


def test_rounding_loses_at_most_half_a_step(chunks):
    for chunk in chunks[:20]:
        error = dequantise(quantise(chunk)) - chunk
        # the transform keeps lengths: 16 coefficients of a column, each off by 0.05 at most
        assert np.linalg.norm(error, axis=0).max() <= 0.05 * np.sqrt(16) + 1e-12


def test_decodes_to_the_quantised_actions(chunks, tokenizer):
    for chunk in chunks:
        tokens = tokenizer.encode(chunk)
        assert tokens.min() >= 0 and tokens.max() < tokenizer.vocabulary <= 1024
        np.testing.assert_allclose(
            tokenizer.decode(tokens, 16), dequantise(quantise(chunk)), atol=1e-12
        )


def test_takes_fewer_tokens_than_numbers(chunks, tokenizer):
    lengths = [len(tokenizer.encode(chunk)) for chunk in chunks]
    assert np.mean(lengths) < 0.5 * chunks[0].size


def test_what_training_never_saw_still_becomes_tokens(tokenizer):
    rough = np.random.default_rng(1).uniform(-0.9, 0.9, (16, 6))
    bounded = quantise(rough).clip(tokenizer.smallest, tokenizer.largest)
    found = tokenizer.decode(tokenizer.encode(rough), 16)
    np.testing.assert_allclose(found, dequantise(bounded), atol=1e-12)


def test_read_back_from_json_it_is_the_same(chunks, tokenizer):
    again = FastTokenizer.from_json(json.loads(json.dumps(tokenizer.as_json())))
    for chunk in chunks[:20]:
        np.testing.assert_array_equal(again.encode(chunk), tokenizer.encode(chunk))


def test_more_values_than_tokens_are_refused(chunks):
    with pytest.raises(TrainingError, match=r'more values than the 16 tokens.*num_frames'):
        FastTokenizer.train(chunks, vocabulary=16)
