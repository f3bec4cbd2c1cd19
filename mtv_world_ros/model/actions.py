"""What a control representation makes of a chunk's joint positions, learned from the training set.

Shape letters: T frames of a chunk, J joints, D numbers an action, L tokens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import json
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import CheckpointError
from mtv_world_ros.model.action_features import (
    action_features,
    action_names,
    ActionScaling,
    FAST_TOKENS,
)

if TYPE_CHECKING:
    from mtv_world_ros.geometry.robot import RobotModel
    from mtv_world_ros.model.fast_tokens import FastTokenizer

STATISTICS = 'action_statistics.json'
TOKENIZER = 'action_tokenizer.json'


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionEncoding:
    """Joint positions to what the transformer is given; kept beside the weights.

    Attributes:
        control: `policy2vec`, `ee_mlp` or `fast_tokens`.
        scaling: percentiles of the training set.
        tokenizer: of `fast_tokens`, else None.
    """

    control: str
    scaling: ActionScaling
    tokenizer: FastTokenizer | None = None

    @staticmethod
    def fit(control: str, robot: RobotModel, chunks: Sequence[FloatArray]) -> ActionEncoding:
        """Learns percentiles, and for `fast_tokens` a vocabulary, from positions (1 + T, J)."""
        features = [action_features(control, robot, chunk)[1:] for chunk in chunks]
        scaling = ActionScaling.fit(control, robot, features)
        tokenizer = None
        if control == FAST_TOKENS:
            from mtv_world_ros.model.fast_tokens import FastTokenizer

            tokenizer = FastTokenizer.train([scaling.apply(part) for part in features])
        return ActionEncoding(control=control, scaling=scaling, tokenizer=tokenizer)

    @property
    def dim(self) -> int:
        """D."""
        return len(self.scaling.names)

    def encode(self, robot: RobotModel, positions: FloatArray) -> np.ndarray:
        """Returns (1 + T, D) float32 scaled actions, or the (L,) int64 tokens of actions 1 .. T.

        Args:
            robot: the one it was fitted with.
            positions: (1 + T, J): row 0 the start, row k the command of frame k.

        Raises:
            CheckpointError: it is another robot.
        """
        self.scaling.check(action_names(self.control, robot))
        scaled = self.scaling.apply(action_features(self.control, robot, positions))
        if self.tokenizer is None:
            return scaled.astype(np.float32)
        return self.tokenizer.encode(scaled[1:])

    def save(self, folder: Path) -> None:
        """Writes it into a folder, as JSON."""
        scaling = self.scaling
        statistics = {
            'control': self.control,
            'names': list(scaling.names),
            'low': scaling.low.tolist(),
            'high': scaling.high.tolist(),
            'clip': scaling.clip,
        }
        (folder / STATISTICS).write_text(json.dumps(statistics, indent=2) + '\n')
        if self.tokenizer is not None:
            text = json.dumps(self.tokenizer.as_json(), ensure_ascii=False)
            (folder / TOKENIZER).write_text(text + '\n', encoding='utf-8')

    @staticmethod
    def load(folder: Path, control: str) -> ActionEncoding:
        """Reads what `save` wrote.

        Raises:
            CheckpointError: a file is missing, broken, or of another control.
        """
        try:
            found = json.loads((folder / STATISTICS).read_text())
            if found['control'] != control:
                raise CheckpointError(
                    f"'{folder / STATISTICS}' is of control '{found['control']}', "
                    f"the model's is '{control}'"
                )
            scaling = ActionScaling(
                names=tuple(found['names']),
                low=np.array(found['low'], float),
                high=np.array(found['high'], float),
                clip=float(found['clip']),
            )
            tokenizer = _load_tokenizer(folder) if control == FAST_TOKENS else None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise CheckpointError(
                f"'{folder}' lacks the action statistics of control '{control}' "
                f'({type(error).__name__}: {error}); export the checkpoint again'
            ) from error
        return ActionEncoding(control=control, scaling=scaling, tokenizer=tokenizer)


def _load_tokenizer(folder: Path) -> Any:
    from mtv_world_ros.model.fast_tokens import FastTokenizer

    return FastTokenizer.from_json(json.loads((folder / TOKENIZER).read_text(encoding='utf-8')))


def collate(encoded: Sequence[np.ndarray]) -> np.ndarray:
    """Stacks the encoded actions of a batch; token rows (B, L) are filled up with -1."""
    if encoded[0].ndim == 2:
        return np.stack(encoded)
    rows = np.full((len(encoded), max(len(row) for row in encoded)), -1, dtype=np.int64)
    for row, tokens in zip(rows, encoded, strict=True):
        row[: len(tokens)] = tokens
    return rows
