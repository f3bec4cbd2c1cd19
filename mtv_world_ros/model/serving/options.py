"""How a world model is served: what makes it faster or smaller, and its setting."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
import shlex
from typing import Any

from mtv_world_ros.errors import ConfigError, nearest

WEIGHTS = ('same', 'float8')
#: an offloaded block is elsewhere each time, which a graph or compiled code does not expect
_APART = {
    'offload': ('compile', 'cuda_graphs', 'context_parallel'),
    'cuda_graphs': ('context_parallel',),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ServingOptions:
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

    fuse_lora: bool = True
    compile: bool = False
    cuda_graphs: bool = False
    attention: str = ''
    weights: str = 'same'
    offload: bool = False
    tiny_decoder: str = ''
    tiny_encoder: bool = False
    context_parallel: int = 1

    def __post_init__(self) -> None:
        if self.context_parallel < 1:
            raise ConfigError(
                f'serving: context_parallel is {self.context_parallel}; it must be 1 or more'
            )
        if self.weights not in WEIGHTS:
            raise ConfigError(
                f"serving: weights is '{self.weights}'; it must be one of {', '.join(WEIGHTS)}"
            )
        for one, others in _APART.items():
            for other in others:
                if self._is_on(one) and self._is_on(other):
                    raise ConfigError(f'serving: {one} and {other} exclude each other')
        fixed = self.context_parallel > 1 or self.cuda_graphs or self.offload
        if not self.fuse_lora and (fixed or self.weights == 'float8'):
            raise ConfigError(
                'serving: context_parallel, cuda_graphs, offload and weights=float8 need '
                'fuse_lora=true: they know the weights alone, no adapter that is exchanged beside '
                'them'
            )
        if self.tiny_encoder and not self.tiny_decoder:
            raise ConfigError("serving: tiny_encoder=true needs tiny_decoder, the weights' file")

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
        values: dict[str, Any] = {}
        kinds = {field.name: type(field.default) for field in fields(cls)}
        for part in _words(text):
            name, _, value = part.partition('=')
            if name not in kinds:
                raise ConfigError(
                    f"serving: '{name}' is not one of {', '.join(kinds)}{nearest(name, kinds)}"
                )
            values[name] = _PARSERS[kinds[name]](name, value)
        return cls(**values)


def _number(name: str, value: str) -> int:
    if not value.isdecimal():
        raise ConfigError(f"serving: {name} is '{value}'; it must be a whole number")
    return int(value)


def _truth(name: str, value: str) -> bool:
    if value not in ('true', 'false'):
        raise ConfigError(f"serving: {name} is '{value}'; it must be true or false")
    return value == 'true'


def _text(_: str, value: str) -> str:
    return value


_PARSERS: Mapping[type, Callable[[str, str], Any]] = {int: _number, bool: _truth, str: _text}


def _words(text: str) -> list[str]:
    try:
        return shlex.split(text)
    except ValueError as error:
        raise ConfigError(f"serving: '{text}' cannot be read: {error}") from error
