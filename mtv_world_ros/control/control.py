"""Protocol of a control (a way for a plan to enter the model), its source and its inputs.

Shape letters: V views, T frames of a chunk, O objects, H W pixels, L context tokens, D numbers of
a token or vector.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.core.data_types import BoolArray, ByteArray, FloatArray
from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.robot.model import RobotModel


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenFrame:
    """A real frame of a rollout.

    Attributes:
        frames: (V, H, W, 3) uint8 RGB.
        motion: one state: of the robot and the cameras in that frame.
    """

    frames: ByteArray
    motion: Motion


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlScene:
    """Input of a control: one chunk of a plan, and the frame that it starts from.

    Attributes:
        motion: 1 + T states of the robot and its cameras; row 0 is the start, row k command k.
        times: (1 + T,) [s].
        start_frames: (V, H, W, 3) uint8 RGB frame that the chunk starts from.
        masks: (V, O, H, W) object masks of that frame; None if the control uses none.
        objects: (V, 1 + T, H, W, 4) uint8 RGB and cover of the objects where they are expected to
            be; None if the control shows none, or their motion is not foreseen.
        seen: the last real frame, where the start frame is imagined; None = it is real, or no
            real frame is kept.
    """

    motion: Motion
    times: FloatArray
    start_frames: ByteArray
    masks: BoolArray | None = None
    objects: ByteArray | None = None
    seen: SeenFrame | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlInputs:
    """A chunk of a plan as the transformer takes it. None = the control does not feed this input.

    Attributes:
        num_frames: number of frames, T.
        video: (V, 1 + T, H, W, 3) uint8 RGB, encoded to latents that are concatenated by channel;
            frame k shows the state after command k.
        context: tokens of the cross-attention: (L,) int64 indices, or (L, D) float32 vectors.
        frame: (1 + T, D) float32, a vector a frame; a frame's tokens see the vectors of their own
            frames alone.
    """

    num_frames: int
    video: ByteArray | None = None
    context: NDArray[Any] | None = None
    frame: NDArray[np.float32] | None = None

    @classmethod
    def drawn(cls, frames: ByteArray) -> Self:
        """Return the input of a plan that is drawn: 1 + T frames (V, 1 + T, H, W, 3)."""
        return cls(num_frames=frames.shape[1] - 1, video=frames)


@dataclass(frozen=True, slots=True, kw_only=True)
class ContextInput:
    """Size of the input `context`, and how it joins the text tokens.

    Attributes:
        vector_size: D of tokens that are vectors; 0 = tokens are indices.
        vocabulary: number of indices; 0 = tokens are vectors.
        joins: `append`: tokens stand behind the text tokens, in an order that the model knows;
            `add`: the mean of the vectors is added to every text token.
        hidden_size: width of an MLP of three layers that embeds vectors; 0 = two layers of the
            transformer's width.
    """

    vector_size: int = 0
    vocabulary: int = 0
    joins: Literal['append', 'add'] = 'append'
    hidden_size: int = 0

    def __post_init__(self) -> None:
        if (self.vector_size > 0) == (self.vocabulary > 0):
            raise CheckpointError(
                f'a context input has vector_size {self.vector_size} and vocabulary '
                f'{self.vocabulary}; exactly one of them must be positive'
            )
        if self.joins not in ('append', 'add') or (self.vocabulary and self.joins == 'add'):
            raise CheckpointError(
                f'a context input of {"indices" if self.vocabulary else "vectors"} joins the text '
                f"by '{self.joins}'; indices take 'append', vectors 'append' or 'add'"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameInput:
    """Size of the input `frame`.

    Attributes:
        vector_size: length D of the vector.
        hidden_size: width of the MLP of three layers that embeds it.
    """

    vector_size: int
    hidden_size: int = 1024

    def __post_init__(self) -> None:
        if self.vector_size < 1 or self.hidden_size < 1:
            raise CheckpointError(
                f'a frame input has vector_size {self.vector_size} and hidden_size '
                f'{self.hidden_size}; both must be positive'
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class InputLayout:
    """Inputs of the transformer that a control feeds.

    Attributes:
        video: whether it feeds latents by channel; else these are zero.
        context: size and joining of the control's tokens for the cross-attention; None = it feeds
            none.
        frame: sizes of the control's vector for each frame; None = it feeds none.
    """

    video: bool = False
    context: ContextInput | None = None
    frame: FrameInput | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the inputs that are fed."""
        return tuple(name for name in ('video', 'context', 'frame') if getattr(self, name))

    def transformer_arguments(self) -> dict[str, Any]:
        """Return the transformer's arguments that this layout adds to a preset."""
        return {
            f'{name}_input': asdict(value)
            for name, value in (('context', self.context), ('frame', self.frame))
            if value is not None
        }

    def check(self, inputs: ControlInputs, name: str) -> None:
        """Raise if inputs do not have this layout.

        Args:
            inputs: inputs of one chunk.
            name: name of the control.

        Raises:
            CheckpointError: an input is missing, is not declared, or has another size or
                another number of frames.
        """
        for kind in ('video', 'context', 'frame'):
            if (getattr(inputs, kind) is not None) != bool(getattr(self, kind)):
                said = 'made' if getattr(inputs, kind) is not None else 'did not make'
                raise CheckpointError(
                    f"control '{name}' {said} the input '{kind}'; its layout has "
                    f'{list(self.names)}: declare in `layout` what `make` returns'
                )
        for kind, given in (('context', inputs.context), ('frame', inputs.frame)):
            size = getattr(getattr(self, kind), 'vector_size', 0)
            if given is not None and size and given.shape[1:] != (size,):
                raise CheckpointError(
                    f"control '{name}' made the input '{kind}' with shape {given.shape}; "
                    f'its layout says vectors of {size} numbers'
                )
        rows = {'video': 1, 'frame': 0}
        for kind, axis in rows.items():
            given = getattr(inputs, kind)
            if given is not None and given.shape[axis] != 1 + inputs.num_frames:
                raise CheckpointError(
                    f"control '{name}' made the input '{kind}' with shape {given.shape}; axis "
                    f'{axis} must be 1 + num_frames = {1 + inputs.num_frames} long: the start and '
                    'each frame'
                )


#: layout of controls that draw the plan, as the paper's
VIDEO_ONLY = InputLayout(video=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlOptions:
    """Source of a control: robot, views and size that it is created for.

    Attributes:
        robot: the robot that the model is trained on.
        rendering: section `rendering` of the preset or checkpoint, for controls that draw.
        object_mask: whether drawings carry the objects' masks.
        num_frames: number of frames, T.
    """

    robot: RobotModel
    rendering: Mapping[str, Any]
    object_mask: bool
    num_frames: int


class Control(Protocol):
    """Method that turns a plan into inputs of the world model.

    Subclass it, or write a class of the same shape. Instances are immutable and picklable:
    training prepares clips in other processes. `mtv-world train --set video.control=NAME` selects
    it by its registered name, by the name of an entry point of the group `mtv_world.controls`, or
    as `module:Class`.

    Attributes:
        links: names of links whose poses `make` reads from `scene.motion.links`.
        uses_masks: whether `make` reads `scene.masks`.
        shows_objects: whether `make` reads `scene.objects`: models that are trained to see where
            objects are expected to be.
        dropout: probability of a training sample without this control's inputs.
        ablations: names of what is left out of the method, for the rows of tables.
    """

    links: tuple[str, ...] = ()
    uses_masks: bool = False
    shows_objects: bool = False
    dropout: float = 0.0
    ablations: tuple[str, ...] = ()

    @classmethod
    def create(cls, options: ControlOptions) -> Self:
        """Return the control of a new training, before `fitted`."""
        ...

    @property
    def layout(self) -> InputLayout:
        """Inputs of the transformer that it feeds."""
        ...

    def make(self, scene: ControlScene) -> ControlInputs:
        """Return the inputs of one chunk, as its layout says.

        Raises:
            MtvWorldError: the plan or the robot is none that it can encode.
        """
        ...

    def unmarked(self, scene: ControlScene) -> ByteArray | None:
        """Return real appearance in the control frames (V, 1 + T, H, W, 4), without plan marks.

        None = the control draws no such pictures. A model that may copy them copies marks, too.
        """
        del scene
        return None

    def fitted(self, motions: Sequence[Motion]) -> Self:
        """Return the control with statistics of the training set's chunks, if it needs any."""
        del motions
        return self

    def state(self) -> dict[str, Any]:
        """Return the fitted statistics as plain values, for a JSON file."""
        return {}

    def restored(self, state: Mapping[str, Any]) -> Self:
        """Return the control with a stored `state`.

        Raises:
            CheckpointError, KeyError, TypeError, ValueError: the state cannot be used.
        """
        del state
        return self

    def cache_key(self) -> dict[str, Any]:
        """Return plain values that the inputs depend on, other than clip, robot and segmenter."""
        return {'control.state': self.state()}
