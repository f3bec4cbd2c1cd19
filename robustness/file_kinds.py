"""Everything that is read from outside, by kind: samples, how they are damaged, what reads them.

Kinds whose name begins with `message` are ROS messages, see `node_messages`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import closing
from functools import cache, partial
import importlib
import importlib.util
from pathlib import Path
import pickle
import shutil
import sqlite3
import tempfile
from typing import Any, NamedTuple

import cv2
import numpy as np
import yaml

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.bag.image_decoding import compressed_to_rgb
from mtv_world_ros.data.bag.messages import deserialize, typestore
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.bag.writer import BagWriter
from mtv_world_ros.data.joint_plans import read_plan
from mtv_world_ros.importing.recover import recover
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.simulation.scenes.tasks import Task
from mtv_world_ros.success.task import load_task, load_tasks, match_task
from mtv_world_ros.vision.describers.describer import objects_from_instruction
from robustness import parameter_calls, wild_numbers, wild_plans, wild_scenes
from robustness.folder_kinds import answers, FOLDERS, make_checkpoint, parts, with_part
from robustness.node_messages import DAMAGE, damaged, send
from robustness.wild_numbers import judged, with_wild_number

#: a case that takes longer is a hang [s of the process]
MOST_S = 2.0
#: what is put into places of a file: numbers at the ends of formats, and words of YAML and JSON
WORDS = (
    b'.inf', b'-.inf', b'.nan', b'NaN', b'1e999', b'-1', b'0', b'null', b'[]', b'{}', b'""',
    b'[[[[', b'*a', b'&a', b'<<: *a', b'!!python/object:os.system', b'!!timestamp x', b'9' * 400,
    b'\0', b'\xff\xfe', b'\xff' * 8, b'\x7f\xff\xff\xff', b'\0' * 8, b'true', b'4294967296',
)  # fmt: skip


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """The data with a few bytes, words or parts changed."""
    out = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(0, len(out) + 1))
        word = WORDS[rng.integers(len(WORDS))]
        changes = (
            (at, at + 1, rng.bytes(1)),
            (at, at, word),
            (at, at + int(rng.integers(1, 9)), word),
            (at, at + int(rng.integers(1, 65)), b''),
            (at, at, bytes(out[at : at + int(rng.integers(1, 4096))])),
            (at, at + 8, rng.bytes(8)),
            (at, len(out) if rng.random() < 0.3 else at, b''),
        )
        begin, end, new = changes[rng.integers(len(changes))]
        out[begin:end] = new
    return bytes(out)


def _mutated_sample(samples: list[Any], rng: np.random.Generator) -> bytes:
    return mutated(samples[rng.integers(len(samples))], rng)


def _mutated_content(samples: list[Any], rng: np.random.Generator) -> bytes:
    """Of a file that stands behind its name, which stays."""
    name, _, content = samples[rng.integers(len(samples))].partition(b'\n')
    return name + b'\n' + mutated(content, rng)


class Kind(NamedTuple):
    """What is read.

    Attributes:
        samples: undamaged ones.
        read: reads a case; has a folder for files.
        most_s: how long that may take [s].
        damage: makes a case of the samples.
        share: cases, as a share of those that were asked for.
    """

    samples: Callable[[], list[Any]]
    read: Callable[[Any, Path], Any]
    most_s: float = MOST_S
    damage: Callable[[list[Any], np.random.Generator], Any] = _mutated_sample
    share: float = 1.0


def _file(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


@cache
def _yam() -> Any:
    return load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))


def _reads(name: str, function: str, *more: Callable[[], Any]) -> Callable[[bytes, Path], Any]:
    """Write a case to a file of a name and give it to `MODULE.FUNCTION` of the package."""
    module, _, of = function.rpartition('.')

    def read(data: bytes, folder: Path) -> Any:
        load = getattr(importlib.import_module(f'mtv_world_ros.{module}'), of)
        return load(_file(folder / name, data), *(make() for make in more))

    return read


def _config(folder: str) -> Callable[[], list[bytes]]:
    return lambda: [file.read_bytes() for file in share_path('config').glob(f'{folder}.yaml')]


def _read_task(data: bytes, folder: Path) -> Any:
    """With its scene, as `collect` reads it."""
    path = _file(folder / 'task.yaml', data)
    return Task.of(load_task(path), str(path))


def _read_robot(data: bytes, folder: Path) -> Any:
    """Beside the files that the bundled robots name."""
    for urdf in share_path('config', 'robots').glob('*/*.urdf'):
        shutil.copy(urdf, folder)
    return load_robot(_file(folder / 'mutated.yaml', data))


def _images() -> list[bytes]:
    pixels = np.random.default_rng(0).integers(0, 255, (40, 56, 3), dtype=np.uint8)
    pixels = cv2.GaussianBlur(pixels, (0, 0), 2)
    options = ([], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 2])
    jpegs = [cv2.imencode('.jpg', pixels, option)[1].tobytes() for option in options]
    return [*jpegs, cv2.imencode('.png', pixels)[1].tobytes()]


def _read_image(data: bytes, _: Path) -> Any:
    return compressed_to_rgb('jpeg', np.frombuffer(data, np.uint8))


def _bags() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        with BagWriter(Path(folder) / 'bag') as writer:
            for index in range(50):
                data = b'\0\1\0\0\5\0\0\0abcd\0' + bytes(40)
                writer.write_raw('/a', 'std_msgs/msg/String', index, data)
        return [(Path(folder) / 'bag' / 'bag_0.mcap').read_bytes()]


def _read_bag(name: str, data: bytes, folder: Path) -> None:
    reader = BagReader(_file(folder / name, data))
    for _ in reader.messages():
        pass
    if reader.truncated:
        raise MtvWorldError(reader.truncated)


def _recover(data: bytes, folder: Path) -> Any:
    shutil.rmtree(folder / 'out', ignore_errors=True)
    bag = recover(_file(folder / 'bag.mcap', data), folder / 'out')
    assert sum(bag.num_messages.values()) == len(list(BagReader(folder / 'out').messages()))


def _metadata() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        BagWriter(Path(folder) / 'bag').close()
        return [(Path(folder) / 'bag' / 'metadata.yaml').read_bytes()]


def _read_metadata(data: bytes, folder: Path) -> Any:
    (folder / 'x_0.mcap').write_bytes(b'\x89MCAP0\r\n')
    _file(folder / 'metadata.yaml', data)
    list(BagReader(folder).messages())


def _instructions() -> list[bytes]:
    return [b'stack the red block on the blue block', b'put the red block ' * 400]


def _match(data: bytes, _: Path) -> Any:
    text = data.decode(errors='replace')[:15_000]
    objects_from_instruction(text)
    return match_task(load_tasks(share_path('config', 'tasks')), text)


def _messages() -> list[bytes]:
    """Whole messages of several types, each behind its index."""
    names, empty = [b'a', b'b'], np.zeros(2)
    store = typestore().types
    stamp = store['builtin_interfaces/msg/Time'](sec=1, nanosec=2)
    header = store['std_msgs/msg/Header'](stamp=stamp, frame_id='base')
    after = store['builtin_interfaces/msg/Duration'](sec=1, nanosec=2)
    point = store['trajectory_msgs/msg/JointTrajectoryPoint'](
        positions=empty, velocities=empty, accelerations=empty, effort=empty, time_from_start=after
    )
    plan = store[TYPES[0]](
        header=header, joint_names=[name.decode() for name in names], points=[point]
    )
    state = store[TYPES[1]](
        header=header, name=['a', 'b'], position=empty, velocity=empty, effort=empty
    )
    return [
        bytes([index]) + bytes(typestore().serialize_cdr(message, TYPES[index]))
        for index, message in enumerate((plan, state))
    ]


TYPES = ('trajectory_msgs/msg/JointTrajectory', 'sensor_msgs/msg/JointState')


def _read_message(data: bytes, _: Path) -> Any:
    if data:
        message = deserialize(TYPES[data[0] % len(TYPES)], data[1:])
        if data[0] % len(TYPES) == 0:
            read_plan(message)


def _answers() -> list[bytes]:
    """Chunks of actions as the two kinds of servers send them."""
    from mtv_world_ros.policies.openpi_client import pack

    return [pack({'actions': np.ones((8, 7)), 'state': {'a': 1.5, 'b': ['x', 2]}})]


def _read_answer(data: bytes, _: Path) -> Any:
    from mtv_world_ros.policies.openpi_client import unpack

    return unpack(data)


def timed_actions(tensors: Iterable[Any]) -> bytes:
    """Return a list of timed actions as LeRobot's server sends them, made without LeRobot."""
    out = b'\x80\x03]('
    for tensor in tensors:
        out += b'clerobot.async_inference.helpers\nTimedAction\n)\x81}X\x06\0\0\0action'
        out += pickle.dumps(tensor, protocol=3)[2:-1] + b'sb'
    return out + b'e.'


def _pickles() -> list[bytes]:
    import torch

    return [timed_actions(torch.full((4,), float(value)) for value in range(3))]


def _read_pickle(data: bytes, _: Path) -> Any:
    from mtv_world_ros.policies.timed_actions import read_timed_actions

    return read_timed_actions(data)


def _recorded_sqlite() -> list[bytes]:
    """A bag as rosbag2_storage_sqlite3 makes it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'bag.db3'
        with closing(sqlite3.connect(path)) as database:
            database.execute(
                'CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT '
                'NULL, serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)'
            )
            database.execute(
                'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, '
                'timestamp INTEGER NOT NULL, data BLOB NOT NULL)'
            )
            row = (1, '/a', 'std_msgs/msg/String', 'cdr', '')
            database.execute('INSERT INTO topics VALUES (?, ?, ?, ?, ?)', row)
            data = b'\0\1\0\0\5\0\0\0abcd\0'
            rows = [(None, 1, index, data) for index in range(50)]
            database.executemany('INSERT INTO messages VALUES (?, ?, ?, ?)', rows)
            database.commit()
        return [path.read_bytes()]


def _urdfs() -> list[bytes]:
    return [share_path('config', 'robots', 'yam_bimanual', 'yam_bimanual.urdf').read_bytes()]


def _read_urdf(data: bytes, folder: Path) -> Any:
    """By the bundled robot's YAML, which names it."""
    shutil.copy(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'), folder)
    _file(folder / 'yam_bimanual.urdf', data)
    return load_robot(folder / 'robot.yaml')


def _colladas() -> list[bytes]:
    """A triangle pyramid as COLLADA 1.4.1 has it."""
    corners = '0 0 0 1 0 0 0 1 0 0 0 1'
    faces = '0 1 2 0 1 3 1 2 3 0 2 3'
    return [
        f"""<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="0.01"/></asset><library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="12">{corners}</float_array><technique_common>
<accessor source="#a" count="4" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices><triangles count="4">
<input semantic="VERTEX" source="#v" offset="0"/><p>{faces}</p></triangles></mesh></geometry>
</library_geometries><library_visual_scenes><visual_scene id="s"><node>
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>""".encode()
    ]


def _read_collada(data: bytes, folder: Path) -> Any:
    from mtv_world_ros.robot.mesh_pieces import load_mesh

    return load_mesh(_file(folder / 'part.dae', data))


def _read_dataset_mapping(data: bytes, folder: Path) -> Any:
    from mtv_world_ros.importing.mapping import load_mapping

    robot = folder / 'robots' / 'yam_bimanual'
    robot.mkdir(exist_ok=True, parents=True)
    shutil.copy(share_path('config', 'robots', 'yam_bimanual', 'cameras.yaml'), robot)
    (folder / 'datasets').mkdir(exist_ok=True)
    return load_mapping(_file(folder / 'datasets' / 'mapping.yaml', data))


def _read_video_mapping(data: bytes, folder: Path) -> Any:
    from mtv_world_ros.importing.videos import find_recordings, load_video_mapping

    (folder / 'joints').mkdir(exist_ok=True)
    _file(folder / 'joints' / 'a.csv', b'q1,q2\n0,0\n')
    mapping = load_video_mapping(_file(folder / 'videos.yaml', data))
    find_recordings(folder, mapping)


def _video_mappings() -> list[bytes]:
    return [share_path('config', 'datasets', 'videos.yaml').read_bytes()]


def _object_lists() -> list[bytes]:
    return [b'objects: [red block, {name: plate}]\ninstructions:\n  stack them: [red block]\n']


def _read_vlm_answer(data: bytes, _: Path) -> Any:
    from mtv_world_ros.vision.describers.vlm import read_answer

    return read_answer(data.decode(errors='replace'))


def _trees() -> list[bytes]:
    return [b'{"step": 3, "seed": 0, "ema_step": 3, "lora.rank": 0, "recent": [0.5, 0.25]}']


def _read_state_card(data: bytes, folder: Path) -> Any:
    from mtv_world_ros.training.resume import read_card, STATE

    (folder / STATE).mkdir(exist_ok=True)
    _file(folder / STATE / 'state.json', data)
    return read_card(folder)


def _features() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'features.npz'
        np.savez(path, a=np.ones((4, 8), np.float32), b=np.zeros((2, 8), np.float32))
        return [path.read_bytes()]


def _videos() -> list[bytes]:
    from mtv_world_ros.viewing.video import encode_video

    return [encode_video(np.zeros((4, 32, 48, 3), np.uint8), 5.0)]


def _read_video(data: bytes, _: Path) -> Any:
    from mtv_world_ros.viewing.video import decode_video

    return decode_video(data)


def _weights() -> list[bytes]:
    """The autoencoder of the bundled checkpoint."""
    folder = share_path('resource', 'checkpoint')
    return [(folder / 'autoencoder' / 'diffusion_pytorch_model.safetensors').read_bytes()]


def _read_weights(data: bytes, folder: Path) -> Any:
    from mtv_world_ros.model.tensor_files import open_tensors

    path = folder / 'weights'
    path.mkdir(exist_ok=True)
    _file(path / 'diffusion_pytorch_model.safetensors', data)
    for tensor in open_tensors(path / 'diffusion_pytorch_model.safetensors').values():
        tensor.read()


def _responses() -> list[bytes]:
    folder = share_path('resource', 'checkpoint', 'object_motion')
    return [(folder / 'arm_response.json').read_bytes()]


def _read_response(data: bytes, folder: Path) -> Any:
    from mtv_world_ros.physics.checkpoint_files import load_response

    return load_response(_file(folder / 'arm_response.json', data).parent, _yam())


def _contacts() -> list[bytes]:
    folder = share_path('resource', 'checkpoint', 'object_motion')
    return [(folder / 'contact.json').read_bytes()]


def _read_contact(data: bytes, folder: Path) -> Any:
    from mtv_world_ros.physics.checkpoint_files import load_contact

    return load_contact(_file(folder / 'contact.json', data).parent)


def _scene_files() -> list[bytes]:
    """Two blocks, and a plan of the bundled robot's home."""
    block = {'name': 'red block', 'centre': [0.0, 0.3, 0.02], 'size': [0.04, 0.04, 0.04]}
    can = {'name': 'can', 'centre': [0.1, 0.3, 0.05], 'size': [0.06, 0.06, 0.1], 'round': True}
    rows = [[0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.03] * 2] * 3
    values = {'objects': [block, can | {'yaw': 0.5}], 'times': [0.0, 0.4, 1.0], 'positions': rows}
    return [yaml.safe_dump(values).encode()]


def _read_folder(make: Any, read: Callable[[Path], Any], data: bytes, folder: Path) -> Any:
    return read(with_part(make, data, folder))


def _load_checkpoint(folder: Path) -> Any:
    from mtv_world_ros.model.checkpoint import Checkpoint
    from mtv_world_ros.model.trained_model import load_trained_model

    return load_trained_model(Checkpoint.open(folder))


DESCRIBERS = 'vision.describers.describer_config'
READS_POLICY = _reads('policy.yaml', 'policies.kinds.load_policy_config', _yam)
READS_PRESET = _reads('preset.yaml', 'training.training_config.load_training_config')
READS_SCENE = _reads('scene.yaml', 'inspection.foreseen_scene.load_scene', _yam)
CHECKPOINT_PARTS = partial(parts, make_checkpoint, '.json')
LOADS_CHECKPOINT = partial(_read_folder, make_checkpoint, _load_checkpoint)
KINDS = {
    'scene file': Kind(_scene_files, READS_SCENE),
    'scene file, numbers': Kind(
        _scene_files, judged(READS_SCENE, wild_numbers.plausible_scene),
        damage=with_wild_number),
    'calibration': Kind(
        _config('robots/*/cameras'), lambda d, f: load_calibration(_file(f / 'c.yaml', d))),
    'robot': Kind(_config('robots/*/robot'), _read_robot),
    'urdf': Kind(_urdfs, _read_urdf),
    'COLLADA': Kind(_colladas, _read_collada),
    'task': Kind(_config('tasks/*'), _read_task),
    'policy': Kind(_config('policies/*'), READS_POLICY),
    'policy list': Kind(
        _config('rankings/*'),
        _reads('policies.yaml', 'ranking.policy_list.load_policy_list', _yam)),
    'preset': Kind(_config('models/*'), READS_PRESET),
    'bag mapping': Kind(lambda: [share_path('config', 'datasets', 'bag.yaml').read_bytes()],
                        _reads('mapping.yaml', 'data.bag_mapping.load_bag_mapping')),
    'dataset mapping': Kind(
        lambda: [share_path('config', 'datasets', 'example.yaml').read_bytes()],
        _read_dataset_mapping),
    'videos mapping': Kind(_video_mappings, _read_video_mapping),
    'describer': Kind(lambda: [share_path('config', 'describer.yaml').read_bytes()],
                      _reads('describer.yaml', f'{DESCRIBERS}.load_describer_config')),
    'object list': Kind(_object_lists, _reads('objects.yaml', f'{DESCRIBERS}.load_object_list')),
    'image': Kind(_images, _read_image),
    'video': Kind(_videos, _read_video),
    'bag': Kind(_bags, partial(_read_bag, 'bag.mcap')),
    'bag, sqlite3': Kind(_recorded_sqlite, partial(_read_bag, 'bag.db3')),
    'recover': Kind(_bags, _recover),
    'metadata': Kind(_metadata, _read_metadata),
    'training state': Kind(_trees, _read_state_card),
    'features': Kind(
        _features,
        _reads('features.npz', 'evaluation.metrics.feature_store.load_features')),
    'weights': Kind(_weights, _read_weights),
    'arm response': Kind(_responses, _read_response),
    'contact': Kind(_contacts, _read_contact),
    'checkpoint': Kind(CHECKPOINT_PARTS, LOADS_CHECKPOINT, 20.0, _mutated_content, 0.1),
    'instruction': Kind(_instructions, _match),
    'answer, msgpack': Kind(_answers, _read_answer),
    'answer, pickle': Kind(_pickles, _read_pickle),
    'answer, language model': Kind(answers, _read_vlm_answer),
    'message, CDR': Kind(_messages, _read_message),
    'contact, numbers': Kind(
        _contacts, judged(_read_contact, wild_numbers.plausible_contact),
        damage=with_wild_number),
    'arm response, numbers': Kind(
        _responses, judged(_read_response, wild_numbers.plausible_response),
        damage=with_wild_number),
    'robot, numbers': Kind(
        _config('robots/*/robot'), judged(_read_robot, wild_numbers.plausible_robot),
        damage=with_wild_number),
    'calibration, numbers': Kind(
        _config('robots/*/cameras'),
        judged(lambda d, f: load_calibration(_file(f / 'c.yaml', d)),
               wild_numbers.plausible_cameras),
        damage=with_wild_number),
    'checkpoint, numbers': Kind(
        CHECKPOINT_PARTS, judged(LOADS_CHECKPOINT, wild_numbers.plausible_checkpoint), 20.0,
        with_wild_number, 0.1),
    'task, numbers': Kind(_config('tasks/*'), _read_task, damage=with_wild_number),
    'policy, numbers': Kind(_config('policies/*'), READS_POLICY, damage=with_wild_number),
    'preset, numbers': Kind(_config('models/*'), READS_PRESET, damage=with_wild_number),
    'weights, numbers': Kind(
        _weights, wild_numbers.no_survivors(_read_weights, wild_numbers.are_finite),
        damage=wild_numbers.weights),
    'scene, foreseen': Kind(
        wild_scenes.samples, wild_scenes.foresee, wild_scenes.MOST_S, wild_scenes.damaged, 0.2),
    'plan, imagined': Kind(
        wild_plans.samples, wild_plans.imagine, 20.0, wild_plans.damaged, 0.1),
}  # fmt: skip


KINDS |= {
    name: Kind(
        partial(parts, make, *endings),
        partial(_read_folder, make, read),
        damage=_mutated_content,
    )
    for name, (make, endings, read) in FOLDERS.items()
}


def _is_installed(package: str) -> bool:
    return importlib.util.find_spec(package) is not None


def _damaged(key: str, samples: list[Any], rng: np.random.Generator) -> Any:
    return damaged(key, rng)


if _is_installed('rclpy'):
    KINDS |= {
        f'message, {key}': Kind(
            partial(list, [None]),
            lambda message, _, key=key: message and send(key, message),
            damage=partial(_damaged, key),
            share=4.0,
        )
        for key in DAMAGE
    }
    KINDS['parameter call'] = Kind(
        parameter_calls.samples, parameter_calls.call, 10.0, parameter_calls.damaged
    )
