"""How a world model is served: what makes it faster or smaller, and its setting."""

from __future__ import annotations

import shlex
from typing import Any, Self

from pydantic import model_validator

from mtv_world_ros.config import Schema, validated
from mtv_world_ros.errors import ConfigError, nearest


class ServingOptions(Schema):
    """Ways to serve a checkpoint; the defaults are the plain one.

    Attributes:
        fuse_lora: add the adapter into the weights; nothing to compute for it in a step.
        compile: compile the transformer's repeated block; the first prediction waits for it.
        attention: diffusers' name of the attention's implementation; empty = torch's choice.
        offload: keep the transformer's blocks on the CPU, each on the device for its turn alone.
        tiny_decoder: file of TAEHV's `taew2_1` weights that decode in place of Wan's autoencoder.
        tiny_encoder: the tiny autoencoder encodes, too.
    """

    section = ''

    fuse_lora: bool = True
    compile: bool = False
    attention: str = ''
    offload: bool = False
    tiny_decoder: str = ''
    tiny_encoder: bool = False

    @model_validator(mode='after')
    def _go_together(self) -> Self:
        if self.offload and self.compile:
            # an offloaded block is elsewhere each time, which compiled code does not expect
            raise ValueError('offload and compile exclude each other')
        if self.offload and not self.fuse_lora:
            raise ValueError(
                'offload needs fuse_lora=true: it knows the weights alone, no adapter that is '
                'exchanged beside them'
            )
        if self.tiny_encoder and not self.tiny_decoder:
            raise ValueError("tiny_encoder=true needs tiny_decoder, the weights' file")
        return self

    @classmethod
    def parse(cls, text: str) -> ServingOptions:
        """Returns what a text like `compile=true tiny_decoder=FILE` says, apart by spaces.

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
    return {'true': True, 'false': False}.get(value, value)


def _words(text: str) -> list[str]:
    try:
        return shlex.split(text)
    except ValueError as error:
        raise ConfigError(f"serving: '{text}' cannot be read: {error}") from error
