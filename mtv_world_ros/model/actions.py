"""Actions as the transformer takes them: scaled joint positions or tool poses, or FAST tokens.

Shape letters: T frames of a chunk, J joints, A arms, D numbers an action, L tokens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import json
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.bounded_input import read_json
from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import CheckpointError, ConfigError, nearest, TrainingError

if TYPE_CHECKING:
    from tokenizers import Tokenizer

    from mtv_world_ros.geometry.robot.model import RobotModel

#: how actions may enter the model: the paper's method and its three baselines
CONTROLS = ('trajectory_video', 'policy2vec', 'ee_mlp', 'fast_tokens')
TRAJECTORY_VIDEO, POLICY2VEC, EE_MLP, FAST_TOKENS = CONTROLS

#: tokens of `fast_tokens`
VOCABULARY = 1024
#: these percentiles become -1 and 1
PERCENTILES = (1.0, 99.0)
#: how far outside of them a scaled number may lie. Ctrl-World clips at the percentiles. The others
#: need a bound too: the range of a joint that rarely moves is next to nothing
CLIP = {POLICY2VEC: 1.5, EE_MLP: 1.0, FAST_TOKENS: 1.5}
#: half of the least range that is stretched to [-1, 1] [m or rad]: below is noise
_LEAST_HALF_RANGE = 1e-3
#: cosine of the pitch from which on yaw is not told from roll
_VERTICAL = 1e-9


def check_control(name: str) -> str:
    """Returns the name; raises ConfigError if it is none of `CONTROLS`."""
    if name not in CONTROLS:
        raise ConfigError(
            f"control '{name}' is not one of {', '.join(CONTROLS)}{nearest(str(name), CONTROLS)}; "
            'set video.control or --control'
        )
    return name


def action_names(control: str, robot: RobotModel) -> tuple[str, ...]:
    """Returns the D names of what an action consists of."""
    if control != EE_MLP:
        return robot.joint_names
    parts = ('x', 'y', 'z', 'roll', 'pitch', 'yaw', 'opening')
    return tuple(f'{tool.arm} {part}' for tool in robot.tools for part in parts)


def action_features(control: str, robot: RobotModel, positions: FloatArray) -> FloatArray:
    """Returns (T, D) unscaled actions of joint positions (T, J) [rad or m]."""
    return tool_features(robot, positions) if control == EE_MLP else np.asarray(positions, float)


def tool_features(robot: RobotModel, positions: FloatArray) -> FloatArray:
    """Returns (T, 7 A): per arm x, y, z [m], roll, pitch, yaw [rad] and the opening in [0, 1].

    The poses are those of the tool points in the base frame. Angles jump at +-pi, as they do in
    Ctrl-World, which takes them like this.
    """
    poses = robot.tool_poses(positions)
    openings = robot.gripper_openings(positions)[..., None]
    angles = roll_pitch_yaw(poses[..., :3, :3])
    rows = np.concatenate([poses[..., :3, 3], angles, openings], axis=-1)
    return rows.swapaxes(0, 1).reshape(len(positions), -1)


def roll_pitch_yaw(rotations: FloatArray) -> FloatArray:
    """Returns (..., 3) angles [rad] of (..., 3, 3): R = Rz(yaw) Ry(pitch) Rx(roll).

    Straight up and down, where roll and yaw turn about the same axis, yaw is zero.
    """
    r = rotations
    level = np.hypot(r[..., 0, 0], r[..., 1, 0])
    pitch = np.arctan2(-r[..., 2, 0], level)
    yaw = np.where(level < _VERTICAL, 0.0, np.arctan2(r[..., 1, 0], r[..., 0, 0]))
    sine, cosine = np.sin(yaw), np.cos(yaw)
    roll = np.arctan2(
        sine * r[..., 0, 2] - cosine * r[..., 1, 2], cosine * r[..., 1, 1] - sine * r[..., 0, 1]
    )
    return np.stack([roll, pitch, yaw], axis=-1)


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionScaling:
    """Stretches each number of an action so that its 1st and 99th percentile become -1 and 1.

    Attributes:
        names: D names.
        low: (D,) 1st percentiles.
        high: (D,) 99th percentiles.
        clip: scaled numbers stay in [-clip, clip].
    """

    names: tuple[str, ...]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    clip: float

    @staticmethod
    def fit(control: str, robot: RobotModel, features: Sequence[FloatArray]) -> ActionScaling:
        """Returns the scaling of features, each (T, D)."""
        low, high = np.percentile(np.concatenate(features), PERCENTILES, axis=0)
        names = action_names(control, robot)
        return ActionScaling(names=names, low=low, high=high, clip=CLIP[control])

    def apply(self, features: FloatArray) -> FloatArray:
        """Returns (..., D) scaled numbers."""
        middle, half = (self.high + self.low) / 2, (self.high - self.low) / 2
        scaled = (features - middle) / np.maximum(half, _LEAST_HALF_RANGE)
        return scaled.clip(-self.clip, self.clip)

    def check(self, names: tuple[str, ...]) -> None:
        """Raises CheckpointError if these are not the numbers that it was made for."""
        if names != self.names:
            raise CheckpointError(
                f'the model was trained on actions {list(self.names)}, the robot has '
                f"{list(names)}; set 'robot_file' to the robot it was trained with"
            )


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
            CheckpointError: the robot is another one.
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
            found = read_json(folder / STATISTICS)
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
    return FastTokenizer.from_json(read_json(folder / TOKENIZER))


def collate(encoded: Sequence[np.ndarray]) -> np.ndarray:
    """Stacks the encoded actions of a batch; token rows (B, L) are filled up with -1."""
    if encoded[0].ndim == 2:
        return np.stack(encoded)
    rows = np.full((len(encoded), max(len(row) for row in encoded)), -1, dtype=np.int64)
    for row, tokens in zip(rows, encoded, strict=True):
        row[: len(tokens)] = tokens
    return rows


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
    """FAST: chunks of scaled actions to a few discrete tokens and back.

    Cosine transform along time, rounding, byte-pair encoding (Pertsch et al., "FAST: Efficient
    Action Tokenization for Vision-Language-Action Models", 2025).

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
        from tokenizers import models, Tokenizer, trainers

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
        from tokenizers import Tokenizer

        try:
            tokenizer = Tokenizer.from_str(json.dumps(values['tokenizer']))
        except Exception as error:  # the library raises nothing narrower
            raise ValueError(f'the tokenizer cannot be used: {error}') from error
        return FastTokenizer(tokenizer, int(values['smallest']), int(values['largest']))
