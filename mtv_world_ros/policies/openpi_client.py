"""A client of openpi's policy server: websocket, msgpack, metadata first, errors as text.

Arrays are written as the `openpi-client` package does (`msgpack_numpy.py`): an array is a map with
the byte keys `__ndarray__`, `data`, `dtype` and `shape`, a NumPy scalar one with `__npgeneric__`,
`data` and `dtype`. Nothing in it is executed.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
import logging
import os
import socket
import struct
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

from mtv_world_ros.core.bounded_input import limits
from mtv_world_ros.core.config import Seconds
from mtv_world_ros.core.data_types import JointTrajectory, Observation
from mtv_world_ros.core.errors import (
    ConfigError,
    masked,
    MissingPackageError,
    PolicyError,
    PolicyServerError,
)
from mtv_world_ros.core.shown_text import shown
from mtv_world_ros.policies.policy import EpisodeOrigin, PolicySettings
from mtv_world_ros.policies.server_mapping import find, Key, ServerMapping
from mtv_world_ros.robot.model import RobotModel

#: close code of a message that is larger than `max_size` [RFC 6455]
_MESSAGE_TOO_BIG = 1009
#: websockets logs tracebacks of what it raises as well
_SILENT = logging.getLogger(f'{__name__}.websockets')
_SILENT.addHandler(logging.NullHandler())
_SILENT.propagate = False


def _address(server: str) -> str:
    if not server.startswith(('ws://', 'wss://')):
        raise ValueError(f"'server' is '{server}'; expected ws://host:port or wss://...")
    return server


class OpenPiConfig(ServerMapping, PolicySettings):
    """A policy behind the websocket server of [openpi](https://github.com/Physical-Intelligence/openpi)."""

    basic: ClassVar = ('kind', 'server', 'state', 'actions')

    server_address: ClassVar[str] = 'ws://127.0.0.1:{port}'

    kind: Literal['openpi'] = 'openpi'
    server: Annotated[str, AfterValidator(_address)] = Field(
        description='e.g. `ws://localhost:8000`'
    )
    api_key_variable: str = Field(
        default='', description='environment variable with the API key; empty = none is needed'
    )
    timeout_s: Seconds = Field(
        default=60.0, description='longest wait for the connection, and for an answer [s]'
    )
    prompt: Annotated[Key | None, BeforeValidator(lambda value: value or None)] = Field(
        default=None, description='where the instruction goes; empty = nowhere'
    )

    def check(self) -> None:
        """Raise if a package is missing."""
        try:
            import msgpack  # noqa: F401
            import websockets  # noqa: F401
        except ImportError as error:
            raise MissingPackageError(
                "the client of openpi's server", error.name or 'websockets'
            ) from error

    def make(
        self, origin: EpisodeOrigin | None = None, robot: RobotModel | None = None
    ) -> OpenPiPolicy:
        """Return the client; it connects at its first reset.

        Raises:
            ConfigError: a package is missing.
        """
        self.check()
        return OpenPiPolicy(self)

    def request(self, observation: Observation, instruction: str) -> dict[str, Any]:
        """Return the request as nested mappings of arrays and text."""
        request: dict[str, Any] = {}
        for image in self.images:
            _put(request, image.key, image.image(observation))
        for state in self.state:
            _put(request, state.key, state.values(observation).astype(np.float32))
        if self.prompt:
            _put(request, self.prompt, instruction)
        return request


def _put(request: dict[str, Any], key: Key, value: Any) -> None:
    for part in key[:-1]:
        request = request.setdefault(part, {})
    request[key[-1]] = value


#: timeout of a server that does not close the connection [s]
_GOODBYE_S = 1.0


class OpenPiPolicy:
    """Asks the server.

    Attributes:
        metadata: the server's description of itself.

    Args:
        config: address of the server, and the mapping of its inputs and outputs.
    """

    def __init__(self, config: OpenPiConfig) -> None:
        self._config = config
        self._connection: Any = None
        self._opened = ExitStack()
        self._key = ''
        self.metadata: dict[str, Any] = {}

    @property
    def name(self) -> str:
        """The server's address."""
        return f'openpi {self._config.server}'

    def reset(self, *, seed: int) -> None:
        """Connect, if that is not done; the protocol knows neither episodes nor seeds."""
        del seed
        if self._connection is None:
            self._connect()

    def act(self, observation: Observation, instruction: str) -> JointTrajectory | None:
        """Return the server's chunk of actions as commands; it never ends an episode.

        Raises:
            PolicyError: no connection, no answer in time, the server failed, or its answer
                cannot be used.
        """
        self.reset(seed=0)
        request = self._config.request(observation, instruction)
        answer = self._exchange(pack(request))
        actions = self._config.actions
        return actions.trajectory(find(answer, actions.key), observation)

    def close(self) -> None:
        """Close the connection; the next question opens another."""
        self._connection = None
        self._opened.close()

    def _connect(self) -> None:
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect

        config, key = self._config, ''
        if config.api_key_variable:
            key = os.environ.get(config.api_key_variable, '')
        if config.api_key_variable and not key:
            raise ConfigError(
                f"the environment variable '{config.api_key_variable}' with the API key is not set"
            )
        try:
            connecting = connect(
                config.server,
                compression=None,
                max_size=limits().answer_bytes,
                open_timeout=config.timeout_s,
                # a server that never stops sending does not close the connection either
                close_timeout=min(config.timeout_s, _GOODBYE_S),
                # a busy server does not answer pings
                ping_interval=None,
                logger=_SILENT,
                additional_headers={'Authorization': f'Api-Key {key}'} if key else None,
            )
            self._connection = self._opened.enter_context(connecting)
            limit_sending(self._connection.socket, config.timeout_s)
        except (OSError, TimeoutError, WebSocketException, ValueError) as error:
            raise PolicyServerError(
                f"no connection to the policy server '{config.server}': "
                f'{masked(str(error), key)}; is it running?'
            ) from (None if key and key in str(error) else error)
        self._key = key
        self.metadata = self._receive()

    def _exchange(self, request: bytes) -> Any:
        self._guarded(lambda: self._connection.send(request))
        return self._receive()

    def _receive(self) -> Any:
        message = self._guarded(lambda: self._connection.recv(timeout=self._config.timeout_s))
        if isinstance(message, str):  # a traceback; the server closes the connection after it
            self.close()
            last = message.strip().splitlines()[-1] if message.strip() else 'no reason given'
            raise PolicyError(f'the policy server failed: {masked(last, self._key)}')
        return unpack(message)

    def _guarded(self, call: Callable[[], Any]) -> Any:
        """Close the connection at an error: a late answer would be taken for the next one."""
        from websockets.exceptions import WebSocketException

        server, timeout_s = self._config.server, self._config.timeout_s
        try:
            return call()
        except (OSError, WebSocketException) as error:  # TimeoutError is an OSError
            self.close()
            if isinstance(error, TimeoutError):
                raise PolicyServerError(
                    f"the policy server '{server}' did not answer within {timeout_s:g} s "
                    "('timeout_s')"
                ) from error
            raise PolicyServerError(
                f"the policy server '{server}' is gone: {masked(str(error), self._key)}"
                f'{_too_large(error)}'
            ) from error


def _too_large(error: Exception) -> str:
    sent = getattr(error, 'sent', None)
    if getattr(sent, 'code', None) != _MESSAGE_TOO_BIG:
        return ''
    return (
        f'; its answer has more than {limits().answer_bytes} bytes (the environment variable '
        'MTV_WORLD_MAX_ANSWER_BYTES allows more)'
    )


def limit_sending(connected: socket.socket, seconds: float) -> None:
    """Set a timeout for sending: a stopped server would block it for ever."""
    whole = int(seconds)
    value = struct.pack('ll', whole, int((seconds - whole) * 1e6))
    connected.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, value)


#: kinds of dtype that have no plain bytes: structures, objects, complex numbers
_REFUSED = 'VOc'
_LONGEST_DTYPE = 16


def pack(value: Any) -> bytes:
    """Return the bytes of nested mappings and lists of arrays, numbers and text."""
    import msgpack

    packed = msgpack.packb(value, default=_encode)
    assert packed is not None
    return packed


def unpack(data: bytes) -> Any:
    """Decode a msgpack message.

    Raises:
        PolicyError: the bytes are not msgpack, or hold a malformed array.
    """
    import msgpack

    try:
        return msgpack.unpackb(data, object_hook=_decode)
    except (
        ValueError, TypeError, LookupError, AttributeError, ArithmeticError, MemoryError,
        RecursionError, msgpack.UnpackException,
    ) as error:  # fmt: skip
        reason = str(error) or 'values lie too deep in each other'  # msgpack's StackError has none
        raise PolicyError(
            f'the answer is not msgpack as openpi writes it: {shown(reason)}'
        ) from error


def _encode(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind not in _REFUSED:
        if isinstance(value, np.generic):
            return {b'__npgeneric__': True, b'data': value.item(), b'dtype': value.dtype.str}
        data = np.ascontiguousarray(value).tobytes()
        kind, shape = value.dtype.str, list(value.shape)
        return {b'__ndarray__': True, b'data': data, b'dtype': kind, b'shape': shape}
    raise TypeError(f'a {type(value).__name__} cannot be sent')


def _decode(value: dict[Any, Any]) -> Any:
    if b'__ndarray__' in value:
        array = np.frombuffer(value[b'data'], _dtype(value))
        return array.reshape(tuple(value[b'shape']))
    if b'__npgeneric__' in value:
        return _dtype(value).type(value[b'data'])
    return value


def _dtype(value: dict[Any, Any]) -> np.dtype[Any]:
    text = value[b'dtype']
    if not isinstance(text, str) or len(text) > _LONGEST_DTYPE:
        raise ValueError('a dtype is a short text')
    dtype = np.dtype(text)
    if dtype.kind in _REFUSED:
        raise ValueError(f'arrays of {dtype} are not read')
    return dtype
