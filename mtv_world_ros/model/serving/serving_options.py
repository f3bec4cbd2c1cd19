"""How a world model is served: what makes it faster or smaller, and its setting."""

from __future__ import annotations

import shlex
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, model_validator

from mtv_world_ros.config import expected, Schema, validated, wrong
from mtv_world_ros.errors import ConfigError, nearest

#: an offloaded block is elsewhere each time, which a graph or compiled code does not expect
_APART = {
    'offload': ('compile', 'cuda_graphs', 'context_parallel'),
    'cuda_graphs': ('context_parallel',),
}


def _positive(value: int) -> int:
    if value < 1:
        raise wrong('1 or more')
    return value


class ServingOptions(Schema):
    """Ways to serve a checkpoint; the defaults are the plain one.

    Attributes:
        fuse_lora: add the adapter into the weights; nothing to compute for it in a step.
        compile: compile the transformer's repeated block; the first prediction waits for it.
        cuda_graphs: launch a pass of the transformer as one CUDA graph.
        attention: diffusers' name of the attention's implementation, e.g. `_native_cudnn`;
            empty = torch's choice.
        weights: `same` as loaded, or the blocks' in `float8`.
        offload: keep the transformer's blocks on the CPU, each on the device for its turn alone.
        tiny_decoder: file of TAEHV's `taew2_1` weights that decode in place of Wan's autoencoder.
        tiny_encoder: they encode, too.
        context_parallel: processes that share the token sequence, each on a device of its own.
    """

    section = ''

    fuse_lora: bool = True
    compile: bool = False
    cuda_graphs: bool = False
    attention: str = ''
    weights: Annotated[Literal['same', 'float8'], expected('one of same, float8')] = 'same'
    offload: bool = False
    tiny_decoder: str = ''
    tiny_encoder: bool = False
    context_parallel: Annotated[int, AfterValidator(_positive)] = 1

    @model_validator(mode='after')
    def _go_together(self) -> Self:
        for one, others in _APART.items():
            for other in others:
                if self._is_on(one) and self._is_on(other):
                    raise ValueError(f'{one} and {other} exclude each other')
        fixed = self.context_parallel > 1 or self.cuda_graphs or self.offload
        if not self.fuse_lora and (fixed or self.weights == 'float8'):
            raise ValueError(
                'context_parallel, cuda_graphs, offload and weights=float8 need '
                'fuse_lora=true: they know the weights alone, no adapter that is exchanged beside '
                'them'
            )
        if self.tiny_encoder and not self.tiny_decoder:
            raise ValueError("tiny_encoder=true needs tiny_decoder, the weights' file")
        return self

    def _is_on(self, name: str) -> bool:
        value: bool | int = getattr(self, name)
        return value if isinstance(value, bool) else value > 1

    @classmethod
    def parse(cls, text: str) -> ServingOptions:
        """Returns what a text like `compile=true weights=float8` says, apart by spaces.

        A value with spaces stands in quotes.

        Raises:
            ConfigError: an unknown name or a value that is not one.
        """
        values = {}
        for part in _words(text):
            name, _, value = part.partition('=')
            if name not in cls.model_fields:
                known = list(cls.model_fields)
                raise ConfigError(
                    f"serving: '{name}' is not one of {', '.join(known)}{nearest(name, known)}"
                )
            is_text = isinstance(cls.model_fields[name].default, str)
            values[name] = value if is_text else _plain(value)
        return validated(cls, values, 'serving')


def _plain(value: str) -> Any:
    if value.isdecimal():
        return int(value)
    return {'true': True, 'false': False}.get(value, value)


def _words(text: str) -> list[str]:
    try:
        return shlex.split(text)
    except ValueError as error:
        raise ConfigError(f"serving: '{text}' cannot be read: {error}") from error
