"""LeRobot's asynchronous inference protocol on the server side, written from its description.

The messages come from a descriptor of services.proto through protobuf; contents are pickles of
dataclasses in `lerobot.async_inference.helpers`, as LeRobot's own server reads and writes them.
"""

from concurrent import futures
from dataclasses import dataclass, field
import pickle
import sys
import time
from types import ModuleType

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
import grpc
import torch

HELPERS = 'lerobot.async_inference.helpers'


@dataclass
class TimedData:
    timestamp: float
    timestep: int


@dataclass
class TimedAction(TimedData):
    action: torch.Tensor


@dataclass
class TimedObservation(TimedData):
    observation: dict
    must_go: bool = False


@dataclass
class RemotePolicyConfig:
    policy_type: str
    pretrained_name_or_path: str
    lerobot_features: dict
    actions_per_chunk: int
    device: str = 'cpu'
    rename_map: dict = field(default_factory=dict)


def install_helpers():
    """As if LeRobot were installed: pickles name its classes by module."""
    for name in ('lerobot', 'lerobot.async_inference', HELPERS):
        sys.modules[name] = ModuleType(name)
    for kind in (TimedAction, TimedObservation, RemotePolicyConfig):
        kind.__module__, kind.__qualname__ = HELPERS, kind.__name__
        setattr(sys.modules[HELPERS], kind.__name__, kind)


def make_messages():
    file = descriptor_pb2.FileDescriptorProto(
        name='services.proto', package='transport', syntax='proto3'
    )
    state, data = ('transfer_state', 5), ('data', 12)  # enum as int32, bytes
    for name, fields in {
        'Observation': (state, data),
        'Actions': (data,),
        'PolicySetup': (data,),
        'Empty': (),
    }.items():
        message = file.message_type.add(name=name)
        for number, (field_name, kind) in enumerate(fields, 1):
            message.field.add(name=field_name, number=number, type=kind, label=1)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {
        name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f'transport.{name}'))
        for name in ('Observation', 'Actions', 'PolicySetup', 'Empty')
    }


class Server:
    def __init__(self):
        self.messages = make_messages()
        self.observation, self.config, self.loads = None, None, 0

    def ready(self, request, context):
        self.observation = None
        return self.messages['Empty']()

    def set_up(self, request, context):
        self.config = pickle.loads(request.data)  # noqa: S301 - as LeRobot's server does
        assert isinstance(self.config, RemotePolicyConfig)
        self.loads += 1
        return self.messages['Empty']()

    def observe(self, requests, context):
        buffer, states = b'', []
        for request in requests:
            states.append(request.transfer_state)
            buffer = request.data if request.transfer_state == 1 else buffer + request.data
        assert states[-1] == 3 and set(states[1:-1]) <= {2}, states
        self.observation = pickle.loads(buffer)  # noqa: S301
        assert isinstance(self.observation, TimedObservation)
        return self.messages['Empty']()

    def act(self, request, context):
        """Move every motor by 1 an action; the task says what goes wrong."""
        raw = self.observation.observation
        if raw['task'] == 'fail' or self.config is None:
            return self.messages['Empty']()
        if raw['task'] == 'sleep':
            time.sleep(5.0)
        if raw['task'] == 'evil':
            return self.messages['Actions'](data=pickle.dumps(Evil()))
        features = self.config.lerobot_features
        names = features['observation.state']['names']
        for name, feature in features.items():
            if 'images' in name:
                image = raw[name.removeprefix('observation.images.')]
                assert image.shape == feature['shape'] and image.dtype == 'uint8'
        state = torch.tensor([raw[name] for name in names])
        steps = torch.arange(1.0, self.config.actions_per_chunk + 1)[:, None]
        chunk = state + steps  # rows of one storage, as LeRobot's are
        actions = [
            TimedAction(timestamp=self.observation.timestamp + k / 30,
                        timestep=self.observation.timestep + k, action=action)
            for k, action in enumerate(chunk)
        ]  # fmt: skip
        return self.messages['Actions'](data=pickle.dumps(actions))


class Evil:
    def __reduce__(self):
        import os

        return os.system, ('touch /tmp/mtv_world_ros_was_here',)


def main():
    install_helpers()
    server = Server()
    messages, unary = server.messages, grpc.unary_unary_rpc_method_handler

    def handler(make, call, kind):
        return make(
            call, request_deserializer=messages[kind].FromString,
            response_serializer=lambda message: message.SerializeToString(),
        )  # fmt: skip

    handlers = {
        'Ready': handler(unary, server.ready, 'Empty'),
        'SendPolicyInstructions': handler(unary, server.set_up, 'PolicySetup'),
        'SendObservations': handler(
            grpc.stream_unary_rpc_method_handler, server.observe, 'Observation'
        ),
        'GetActions': handler(unary, server.act, 'Empty'),
    }
    running = grpc.server(futures.ThreadPoolExecutor(4))
    running.add_generic_rpc_handlers(
        (grpc.method_handlers_generic_handler('transport.AsyncInference', handlers),)
    )
    port = running.add_insecure_port('127.0.0.1:0')
    running.start()
    print(port, flush=True)
    running.wait_for_termination()


if __name__ == '__main__':
    main()
