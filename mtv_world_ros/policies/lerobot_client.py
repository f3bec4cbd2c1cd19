"""A client of LeRobot's policy server (`lerobot.async_inference.policy_server`), over gRPC.

Messages are those of LeRobot's `transport/services.proto`, `transport/utils.py` and
`async_inference/helpers.py`: protobuf frames with pickled contents. Outgoing contents are written
as pickles; incoming ones are read by `timed_actions`, never by `pickle`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import pickle
import time
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from mtv_world_ros.core.bounded_input import limits
from mtv_world_ros.core.config import Count, Schema, Seconds
from mtv_world_ros.core.data_types import FloatArray, JointTrajectory, Observation
from mtv_world_ros.core.errors import ConfigError, PolicyError, PolicyServerError
from mtv_world_ros.core.shown_text import shown
from mtv_world_ros.policies.policy import EpisodeOrigin, PolicySettings
from mtv_world_ros.policies.server_mapping import ServerMapping
from mtv_world_ros.policies.timed_actions import read_timed_actions
from mtv_world_ros.robot.model import RobotModel

_SERVICE = '/transport.AsyncInference/'


class LeRobotPolicySettings(Schema):
    """The policy that the server loads."""

    type: str = Field(description='as LeRobot names it, e.g. `act`, `smolvla`, `pi0`')
    path: str = Field(description='folder or name of the pretrained policy, for the server')
    device: str = Field(default='cpu', description='of the policy, on the server')
    actions_per_chunk: Count = Field(default=50, description='actions of an answer')
    rename: Annotated[dict[str, str], BeforeValidator(lambda value: value or {})] = Field(
        default={}, description='from keys of the observation to those of the policy'
    )


class LeRobotConfig(ServerMapping, PolicySettings):
    """A policy behind the policy server of [LeRobot](https://github.com/huggingface/lerobot)."""

    server_address: ClassVar[str] = '127.0.0.1:{port}'
    serves_one_client: ClassVar[bool] = True

    kind: Literal['lerobot'] = 'lerobot'
    server: str = Field(description='e.g. `localhost:8080`')
    timeout_s: Seconds = Field(default=60.0, description='longest wait for an answer [s]')
    setup_timeout_s: Seconds = Field(
        default=600.0, description='longest wait until the server has loaded the policy [s]'
    )
    tls: bool = Field(
        default=False, description='encrypt, and check the certificate of the server'
    )
    policy: LeRobotPolicySettings = Field(description='policy that the server loads')

    @model_validator(mode='after')
    def _fits_the_protocol(self) -> Self:
        if len(self.state) != 1 or not self.state[0].names:
            raise ValueError(
                "'state' must have one entry with 'names', the motors in the order of "
                'observation.state'
            )
        nested = [image.key for image in self.images if len(image.key) > 1]
        if nested or any(not image.width for image in self.images):
            raise ValueError(
                "every image needs a plain 'key', the camera's name, and 'width' and 'height' as "
                "the robot's camera has them"
            )
        return self

    def check(self) -> None:
        """Raise if a package is missing."""
        try:
            import grpc  # noqa: F401
        except ImportError as error:
            raise ConfigError(
                "the client of LeRobot's server needs the package 'grpcio'; install it with: pip "
                "install 'mtv_world_ros[policies]'"
            ) from error

    def make(
        self, origin: EpisodeOrigin | None = None, robot: RobotModel | None = None
    ) -> LeRobotPolicy:
        """Return the client; it connects at its first reset.

        Raises:
            ConfigError: a package is missing.
        """
        self.check()
        return LeRobotPolicy(self)


class LeRobotPolicy:
    """Asks the server, one observation at a time.

    Args:
        config: address of the server, policy, and the mapping of its inputs and outputs.
    """

    def __init__(self, config: LeRobotConfig) -> None:
        self._config = config
        self._channel: Any = None
        self._is_set_up = False
        self._timestep = 0

    @property
    def name(self) -> str:
        """Type and path of the policy."""
        return f'lerobot {self._config.policy.type} {self._config.policy.path}'

    def reset(self, *, seed: int) -> None:
        """Reset the server's state, and load the policy if necessary."""
        del seed
        self._timestep = 0
        config = self._config
        self._call('Ready', b'', config.timeout_s)
        if not self._is_set_up:
            setup = {
                'policy_type': config.policy.type,
                'pretrained_name_or_path': config.policy.path,
                'lerobot_features': self._features(),
                'actions_per_chunk': config.policy.actions_per_chunk,
                'device': config.policy.device,
                'rename_map': dict(config.policy.rename),
            }
            self._call('SendPolicyInstructions', policy_setup(setup), config.setup_timeout_s)
            self._is_set_up = True

    def act(self, observation: Observation, instruction: str) -> JointTrajectory | None:
        """Return the server's chunk of actions as commands; it never ends an episode.

        Raises:
            PolicyError: no connection, no answer in time, or one that cannot be used.
        """
        config, state = self._config, self._config.state[0]
        raw: dict[str, Any] = {image.key[0]: image.image(observation) for image in config.images}
        raw |= dict(zip(state.names, state.values(observation).tolist(), strict=True))
        values = {
            'timestamp': time.time(),
            'timestep': self._timestep,
            'observation': {**raw, 'task': instruction},
            # or the server would leave out what looks like the one before
            'must_go': True,
        }
        self._timestep += self._config.policy.actions_per_chunk
        self._send_observation(values)
        answer = self._call('GetActions', b'', self._config.timeout_s)
        return config.actions.trajectory(read_actions(answer), observation)

    def close(self) -> None:
        """Close the connection; the next reset sets the policy up again."""
        channel, self._channel, self._is_set_up = self._channel, None, False
        if channel is not None:
            channel.close()

    def _features(self) -> dict[str, dict[str, Any]]:
        """Return the observation's features as LeRobot's data sets describe them."""
        names = list(self._config.state[0].names)
        features: dict[str, dict[str, Any]] = {
            'observation.state': {'dtype': 'float32', 'shape': (len(names),), 'names': names}
        }
        for image in self._config.images:
            features[f'observation.images.{image.key[0]}'] = {
                'dtype': 'image',
                'shape': (image.height, image.width, 3),
                'names': ['height', 'width', 'channels'],
            }
        return features

    def _send_observation(self, values: Mapping[str, Any]) -> None:
        stub = self._connected().stream_unary(f'{_SERVICE}SendObservations')
        self._guarded(lambda: stub(observation_parts(values), timeout=self._config.timeout_s))

    def _call(self, method: str, request: bytes, timeout_s: float) -> bytes:
        stub = self._connected().unary_unary(f'{_SERVICE}{method}')
        return self._guarded(lambda: stub(request, timeout=timeout_s))

    def _connected(self) -> Any:
        import grpc

        if self._channel is None:
            options = [('grpc.max_receive_message_length', limits().answer_bytes)]
            server = self._config.server
            if self._config.tls:
                credentials = grpc.ssl_channel_credentials()
                self._channel = grpc.secure_channel(server, credentials, options=options)
            else:
                self._channel = grpc.insecure_channel(server, options=options)
        return self._channel

    def _guarded(self, call: Any) -> Any:
        import grpc

        try:
            return call()
        except grpc.RpcError as error:
            self.close()
            code, details = error.code().name, error.details()  # type: ignore[attr-defined]
            raise PolicyServerError(
                f"the policy server '{self._config.server}' did not do it: {code}: "
                f'{shown(details)}'
            ) from error


_HELPERS = 'lerobot.async_inference.helpers'
#: maximum size of a part of a message, because gRPC's limit is 4 MB [bytes]
_PART_BYTES = 2 * 1024 * 1024
#: transfer state of the first part of a message (LeRobot's enum TransferState)
_TRANSFER_BEGIN = 1
#: transfer state of the parts between the first and the last
_TRANSFER_MIDDLE = 2
#: transfer state of the last part
_TRANSFER_END = 3
#: protobuf wire type of an integer
_WIRE_VARINT = 0
#: protobuf wire type of bytes with a length
_WIRE_BYTES = 2


def policy_setup(values: Mapping[str, Any]) -> bytes:
    """Return the message `PolicySetup` of a `RemotePolicyConfig` with these fields."""
    return _tagged(1, _pickled('RemotePolicyConfig', values))


def observation_parts(values: Mapping[str, Any]) -> Iterator[bytes]:
    """Yield the messages `Observation` of a `TimedObservation` with these fields, in parts."""
    data = _pickled('TimedObservation', values)
    for begin in range(0, len(data), _PART_BYTES):
        part = data[begin : begin + _PART_BYTES]
        is_last = begin + _PART_BYTES >= len(data)
        state = _TRANSFER_END if is_last else _TRANSFER_MIDDLE if begin else _TRANSFER_BEGIN
        yield bytes((1 << 3 | _WIRE_VARINT, state)) + _tagged(2, part)


def read_actions(message: bytes) -> FloatArray:
    """Return the (T, C) actions of a message `Actions`.

    Raises:
        PolicyError: there are none in it, or it holds something else.
    """
    data = _first_bytes(message)
    if not data:
        raise PolicyError(
            "the policy server gave no actions; its log says why (LeRobot's server answers "
            'failures with an empty message)'
        )
    return read_timed_actions(data)


def _pickled(name: str, values: Mapping[str, Any]) -> bytes:
    """Pickle of an object of one of LeRobot's dataclasses, which need not be installed here.

    Protocol 3, since it has no frames: the class by name, an instance without arguments, then its
    fields as state.
    """
    fields = pickle.dumps(dict(values), protocol=3)
    header, body = fields[:2], fields[2:-1]
    made = f'c{_HELPERS}\n{name}\n'.encode() + b')\x81'
    return header + made + body + b'b.'


def _tagged(field: int, data: bytes) -> bytes:
    return bytes((field << 3 | _WIRE_BYTES,)) + _varint(len(data)) + data


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _first_bytes(message: bytes) -> bytes:
    """Return field 1 of a message of byte fields; empty where it has none."""
    at = 0
    while at < len(message):
        tag, at = _read_varint(message, at)
        if tag & 7 != _WIRE_BYTES:
            raise PolicyError(f'the answer has a field of wire type {tag & 7}; expected bytes')
        length, at = _read_varint(message, at)
        if tag >> 3 == 1:
            return message[at : at + length]
        at += length
    return b''


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    value, shift = 0, 0
    while at < len(data):
        value |= (data[at] & 0x7F) << shift
        at += 1
        if not data[at - 1] & 0x80:
            return value, at
        shift += 7
        if shift > 63:
            break
    raise PolicyError('the answer is cut off or damaged')
