"""FAST: a chunk of actions as a few discrete tokens.

Cosine transform along time, rounding, byte-pair encoding (Pertsch et al., "FAST: Efficient Action
Tokenization for Vision-Language-Action Models", 2025).

Shape letters: T actions of a chunk, D numbers an action, L tokens.
"""

from __future__ import annotations

from collections.abc import Sequence
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tokenizers import models, Tokenizer, trainers

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import TrainingError
from mtv_world_ros.model.action_features import VOCABULARY

IntArray = NDArray[np.int64]

#: coefficients are multiplied by this before they are rounded
SCALE = 10.0
#: a coefficient becomes a character from here on: a long run of letters without case or spaces
_FIRST_CHARACTER = 0x4E00


def cosine_matrix(size: int) -> FloatArray:
    """Returns the orthonormal (size, size) matrix of the cosine transform (DCT-II)."""
    frequency, time = np.arange(size)[:, None], np.arange(size)[None]
    matrix = np.cos(np.pi * frequency * (2 * time + 1) / (2 * size)) * np.sqrt(2 / size)
    matrix[0] /= np.sqrt(2)
    return matrix


def quantise(actions: FloatArray) -> IntArray:
    """Returns (T, D) rounded coefficients, lowest frequency first, of scaled actions (T, D)."""
    return np.rint(SCALE * cosine_matrix(len(actions)) @ actions).astype(np.int64)


def dequantise(coefficients: IntArray) -> FloatArray:
    """Returns the (T, D) actions that rounded coefficients (T, D) stand for."""
    return cosine_matrix(len(coefficients)).T @ (coefficients / SCALE)


class FastTokenizer:
    """Chunks of scaled actions to tokens and back.

    Args:
        tokenizer: byte-pair encoding of the coefficients written as characters.
        smallest: coefficient that the first character stands for; lower ones are raised to it.
        largest: highest coefficient; higher ones are lowered to it.
    """

    def __init__(self, tokenizer: Tokenizer, smallest: int, largest: int) -> None:
        self._tokenizer = tokenizer
        self.smallest, self.largest = smallest, largest

    @staticmethod
    def train(chunks: Sequence[FloatArray], vocabulary: int = VOCABULARY) -> FastTokenizer:
        """Learns which coefficients come together, from chunks of scaled actions (T, D).

        Raises:
            TrainingError: the coefficients take more values than there are tokens.
        """
        coefficients = [quantise(chunk) for chunk in chunks]
        smallest = min(int(part.min()) for part in coefficients)
        largest = max(int(part.max()) for part in coefficients)
        if largest - smallest >= vocabulary:
            raise TrainingError(
                f'rounded action coefficients run from {smallest} to {largest}, more values than '
                f'the {vocabulary} tokens; shorten video.num_frames'
            )
        made = FastTokenizer(Tokenizer(models.BPE()), smallest, largest)
        alphabet = [chr(_FIRST_CHARACTER + i) for i in range(largest - smallest + 1)]
        trainer = trainers.BpeTrainer(
            vocab_size=vocabulary,
            min_frequency=2,
            initial_alphabet=alphabet,
            special_tokens=[],
            show_progress=False,
        )
        made._tokenizer.train_from_iterator((made._text(c) for c in coefficients), trainer)
        return made

    @property
    def vocabulary(self) -> int:
        """Tokens in use."""
        return self._tokenizer.get_vocab_size()

    def encode(self, actions: FloatArray) -> IntArray:
        """Returns the (L,) tokens of a chunk of scaled actions (T, D)."""
        return np.array(self._tokenizer.encode(self._text(quantise(actions))).ids, dtype=np.int64)

    def decode(self, tokens: IntArray, num_actions: int) -> FloatArray:
        """Returns the (T, D) actions that (L,) tokens stand for."""
        words = [self._tokenizer.id_to_token(int(token)) or '' for token in tokens]
        values = [ord(letter) - _FIRST_CHARACTER + self.smallest for letter in ''.join(words)]
        return dequantise(np.array(values, dtype=np.int64).reshape(num_actions, -1))

    def _text(self, coefficients: IntArray) -> str:
        bounded = coefficients.clip(self.smallest, self.largest) - self.smallest
        return ''.join(chr(_FIRST_CHARACTER + value) for value in bounded.ravel().tolist())

    def as_json(self) -> dict[str, Any]:
        """Returns plain values."""
        return {
            'smallest': self.smallest,
            'largest': self.largest,
            'tokenizer': json.loads(self._tokenizer.to_str()),
        }

    @staticmethod
    def from_json(values: dict[str, Any]) -> FastTokenizer:
        """The inverse of `as_json`."""
        tokenizer = Tokenizer.from_str(json.dumps(values['tokenizer']))
        return FastTokenizer(tokenizer, int(values['smallest']), int(values['largest']))
