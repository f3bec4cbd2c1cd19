"""A policy server that speaks openpi's protocol, written from its description, not our client.

Wire format (openpi-client): websocket; the server sends a msgpack map of metadata first; then each
binary request gets a binary answer, or a text with a traceback after which the server closes.
Arrays are msgpack maps {b'__ndarray__': True, b'data', b'dtype', b'shape'}.
"""

import asyncio
import http
import sys
import time
import traceback

import msgpack
import numpy as np
import websockets
from websockets.asyncio.server import serve


def to_wire(value):
    assert isinstance(value, np.ndarray)
    return {
        b'__ndarray__': True,
        b'data': value.tobytes(),
        b'dtype': value.dtype.str,
        b'shape': value.shape,
    }


def from_wire(value):
    if b'__ndarray__' in value:
        return np.ndarray(
            buffer=value[b'data'], dtype=np.dtype(value[b'dtype']), shape=value[b'shape']
        )
    return value


#: joint velocities of the stand-in for a DROID checkpoint, in its unit of 0.2 rad a step
DROID_VELOCITIES = np.array([0.5, -0.25, 0.0, 1.0, -1.0, 0.1, 0.0])


def infer_droid(request):
    """Return a chunk as DROID checkpoints do: (15, 8) joint velocities and gripper positions.

    Velocities have the other sign from the eighth action on; the gripper closes from there on.
    """
    if request['observation/joint_position'].shape != (7,):
        raise ValueError('observation/joint_position must have 7 values')
    if request['observation/gripper_position'].shape != (1,):
        raise ValueError('observation/gripper_position must have 1 value')
    for view in ('exterior_image_1_left', 'wrist_image_left'):
        image = request[f'observation/{view}']
        if image.shape != (224, 224, 3) or image.dtype != np.uint8:
            raise ValueError(f'{view} is {image.shape}, {image.dtype}')
    actions = np.zeros((15, 8))
    actions[:7, :7], actions[7:, :7] = DROID_VELOCITIES, -DROID_VELOCITIES
    actions[7:, 7] = 1.0
    return {'actions': actions, 'server_timing': {'infer_ms': 1.0}}


def infer(request):
    """Move every joint by 0.01 an action; the prompt says what goes wrong."""
    prompt = request['prompt']
    if 'observation/joint_position' in request:
        return infer_droid(request)
    if prompt == 'fail':
        raise KeyError('no such checkpoint')
    if prompt == 'sleep':
        time.sleep(3.0)
    actions = request['state'][None] + 0.01 * np.arange(1, 11)[:, None]
    if prompt == 'nan':
        actions[3, 2] = np.nan
    images = {name: [*image.shape, str(image.dtype)] for name, image in request['images'].items()}
    mean = np.array([request['images'][name].mean() for name in sorted(request['images'])])
    return {
        'actions': actions.astype(np.float32),
        'seen': images,
        'mean': mean,
        'state_dtype': str(request['state'].dtype),
        'server_timing': {'infer_ms': 1.0},
    }


async def handle(connection):
    await connection.send(msgpack.packb({'model': 'tiny', 'action_horizon': 10}))
    while True:
        try:
            request = msgpack.unpackb(await connection.recv(), object_hook=from_wire)
            answer = await asyncio.to_thread(infer, request)
            await connection.send(msgpack.packb(answer, default=to_wire))
        except websockets.ConnectionClosed:
            return
        except Exception:
            await connection.send(traceback.format_exc())
            await connection.close(code=1011, reason='Internal server error.')
            raise


def check_key(connection, request):
    if request.headers.get('Authorization') != 'Api-Key secret':
        return connection.respond(http.HTTPStatus.UNAUTHORIZED, 'no key\n')
    return None


async def main():
    options: dict = {'process_request': check_key} if '--key' in sys.argv else {}
    options |= {'compression': None, 'max_size': None}
    port = int(sys.argv[sys.argv.index('--port') + 1]) if '--port' in sys.argv else 0
    async with serve(handle, '127.0.0.1', port, **options) as server:
        print(server.sockets[0].getsockname()[1], flush=True)
        await server.serve_forever()


if __name__ == '__main__':
    asyncio.run(main())
