"""Control `fast_tokens`: the chunk's actions as few discrete tokens behind the text tokens.

Shape letters: T actions of a chunk, D numbers of an action, L tokens.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import json
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct
from tokenizers import models, Tokenizer, trainers

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.control.action_scaling import ActionScaling, joint_features
from mtv_world_ros.control.control import (
    ContextInput,
    Control,
    ControlInputs,
    ControlOptions,
    ControlScene,
    InputLayout,
)
from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.errors import CheckpointError, TrainingError

IntArray = NDArray[np.int64]

#: number of tokens
VOCABULARY = 1024
#: coefficients are multiplied by this before they are rounded
SCALE = 10.0
#: the range of a joint that rarely moves is next to nothing, so that scaled numbers need a bound
CLIP = 1.5
#: character of the smallest coefficient; a long run of letters without case or spaces follows it
FIRST_CHARACTER = 0x4E00


@dataclass(frozen=True, slots=True, kw_only=True)
class FastTokens(Control):
    """Fast-Token's control: joint commands as context tokens behind the text tokens.

    FAST (Pertsch et al., "FAST: Efficient Action Tokenization for Vision-Language-Action Models",
    2025): scaled actions, orthonormal cosine transform along time, coefficients times 10 rounded,
    lowest frequency first, byte-pair encoding of 1,024. Needs the extra `fast-tokens`.

    Attributes:
        scaling: percentiles of the joint positions in the training set.
        tokenizer: byte-pair encoding of their coefficients; None = not fitted yet.
    """

    scaling: ActionScaling
    tokenizer: FastTokenizer | None = None

    @classmethod
    def create(cls, options: ControlOptions) -> Self:
        """Return the control of a robot, without a vocabulary."""
        return cls(scaling=ActionScaling.unfitted(options.robot.joint_names, CLIP))

    @property
    def layout(self) -> InputLayout:
        """Indices that are appended to the text tokens."""
        return InputLayout(context=ContextInput(vocabulary=VOCABULARY))

    def make(self, scene: ControlScene) -> ControlInputs:
        """Return the (L,) tokens of the chunk's commands.

        Raises:
            CheckpointError: the control was not fitted, or the robot is another one.
        """
        if self.tokenizer is None:
            raise CheckpointError(
                "control 'fast_tokens' has no vocabulary yet; fit it to chunks of a training set"
            )
        self.scaling.check(scene.motion.robot.joint_names)
        scaled = self.scaling.apply(joint_features(scene.motion)[1:])
        return ControlInputs(num_frames=len(scaled), context=self.tokenizer.encode(scaled))

    def fitted(self, motions: Sequence[Motion]) -> Self:
        """Return the control with percentiles and a vocabulary of the training set's chunks."""
        features = [joint_features(motion)[1:] for motion in motions]
        scaling = self.scaling.fitted(features)
        tokenizer = FastTokenizer.train([scaling.apply(part) for part in features])
        return replace(self, scaling=scaling, tokenizer=tokenizer)

    def state(self) -> dict[str, Any]:
        """Return percentiles and vocabulary."""
        known = {} if self.tokenizer is None else {'tokenizer': self.tokenizer.as_json()}
        return {**self.scaling.state(), **known}

    def restored(self, state: Mapping[str, Any]) -> Self:
        """Return the control with stored percentiles and vocabulary."""
        tokenizer = FastTokenizer.from_json(state['tokenizer'])
        return replace(self, scaling=self.scaling.restored(state), tokenizer=tokenizer)


def quantise(actions: FloatArray) -> IntArray:
    """Return the (T, D) rounded coefficients of scaled actions (T, D), lowest frequency first."""
    coefficients = np.asarray(dct(actions, axis=0, norm='ortho'))
    return np.rint(SCALE * coefficients).astype(np.int64)


def dequantise(coefficients: IntArray) -> FloatArray:
    """Return the (T, D) actions of rounded coefficients (T, D)."""
    return np.asarray(idct(coefficients / SCALE, axis=0, norm='ortho'))


class FastTokenizer:
    """Chunks of scaled actions to tokens and back.

    Args:
        tokenizer: byte-pair encoding of coefficients that are written as characters.
        smallest: coefficient of the first character; smaller ones are raised to it.
        largest: largest coefficient; larger ones are lowered to it.
    """

    def __init__(self, tokenizer: Tokenizer, smallest: int, largest: int) -> None:
        self._tokenizer = tokenizer
        self.smallest, self.largest = smallest, largest

    @classmethod
    def train(cls, chunks: Sequence[FloatArray], vocabulary: int = VOCABULARY) -> FastTokenizer:
        """Return the encoding of the most frequent runs of coefficients in chunks (T, D).

        Raises:
            TrainingError: coefficients take more values than there are tokens.
        """
        coefficients = [quantise(chunk) for chunk in chunks]
        smallest = min(int(part.min()) for part in coefficients)
        largest = max(int(part.max()) for part in coefficients)
        if largest - smallest >= vocabulary:
            raise TrainingError(
                f'rounded action coefficients run from {smallest} to {largest}, more values than '
                f'the {vocabulary} tokens; shorten video.num_frames'
            )
        made = cls(Tokenizer(models.BPE()), smallest, largest)
        alphabet = [chr(FIRST_CHARACTER + i) for i in range(largest - smallest + 1)]
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
        """Number of tokens in use."""
        return self._tokenizer.get_vocab_size()

    def encode(self, actions: FloatArray) -> IntArray:
        """Return the (L,) tokens of a chunk of scaled actions (T, D)."""
        return np.array(self._tokenizer.encode(self._text(quantise(actions))).ids, dtype=np.int64)

    def decode(self, tokens: IntArray, num_actions: int) -> FloatArray:
        """Return the (T, D) actions of (L,) tokens."""
        words = [self._tokenizer.id_to_token(int(token)) or '' for token in tokens]
        values = [ord(letter) - FIRST_CHARACTER + self.smallest for letter in ''.join(words)]
        return dequantise(np.array(values, dtype=np.int64).reshape(num_actions, -1))

    def _text(self, coefficients: IntArray) -> str:
        bounded = coefficients.clip(self.smallest, self.largest) - self.smallest
        return ''.join(chr(FIRST_CHARACTER + value) for value in bounded.ravel().tolist())

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        return {
            'smallest': self.smallest,
            'largest': self.largest,
            'bpe': json.loads(self._tokenizer.to_str()),
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> FastTokenizer:
        """Return the tokenizer of `as_json`.

        Raises:
            ValueError: the byte-pair encoding cannot be used.
        """
        try:
            tokenizer = Tokenizer.from_str(json.dumps(values['bpe']))
        except Exception as error:  # the library raises nothing narrower
            raise ValueError(f'the tokenizer cannot be used: {error}') from error
        return cls(tokenizer, int(values['smallest']), int(values['largest']))
