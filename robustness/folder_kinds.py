"""Kinds that are read out of folders: episodes, data sets, adapters, caches, earlier results.

A case is one of the folder's files, damaged, behind its name; the others stay as they are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from functools import cache, partial
import importlib.util
import json
import os
from pathlib import Path
import shutil
import sys
import tempfile
from typing import Any

from mcap.writer import CompressionType, Writer
import numpy as np

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.robot.file import load_robot

ROOT = Path(__file__).resolve().parents[1]


@cache
def _home() -> tempfile.TemporaryDirectory[str]:
    """Hold all folders of this process; `clean_up` removes it, or the process's end."""
    return tempfile.TemporaryDirectory(prefix='mtv_world_fuzz_')


def new_folder() -> Path:
    """An empty folder that is removed with the others."""
    return Path(tempfile.mkdtemp(dir=_home().name))


@cache
def _made(make: Callable[[Path], None]) -> Path:
    """A folder that was filled once in this process."""
    folder = new_folder()
    make(folder)
    return folder


def clean_up() -> None:
    """Remove the folders of this process."""
    if _home.cache_info().currsize:
        _home().cleanup()
    _home.cache_clear()
    _made.cache_clear()


def parts(make: Callable[[Path], None], *endings: str) -> list[bytes]:
    """The files of a folder that are damaged, each behind its name."""
    folder = _made(make)
    return [
        f'{file.relative_to(folder)}\n'.encode() + file.read_bytes()
        for file in sorted(folder.rglob('*'))
        if file.is_file() and file.name.endswith(endings)
    ]


def with_part(make: Callable[[Path], None], data: bytes, folder: Path) -> Path:
    """The folder, in which one file is replaced."""
    source, copy = _made(make), folder / 'copy'
    name, _, content = data.partition(b'\n')
    path = name.decode()
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(source, copy, copy_function=os.symlink)
    (copy / path).unlink()
    (copy / path).write_bytes(content)
    return copy


def make_checkpoint(folder: Path) -> None:
    """The bundled checkpoint; its files are linked."""
    source = share_path('resource', 'checkpoint')
    shutil.copytree(source, folder, copy_function=os.symlink, dirs_exist_ok=True)


def make_episode(folder: Path) -> None:
    """A short recorded episode, neither compressed nor with checksums: all of it is looked at."""
    from mtv_world_ros.data.episode_writer import EpisodeWriter

    cameras = load_calibration(share_path('config', 'robots', 'yam_bimanual', 'cameras.yaml'))
    robot = _yam()
    pixels = np.random.default_rng(0).integers(0, 255, (24, 32, 3), dtype=np.uint8)
    with EpisodeWriter(
        folder / 'whole', task='', instruction='stop', robot='yam_bimanual',
        cameras=list(cameras.values()),
    ) as writer:  # fmt: skip
        for step in range(4):
            stamp_ns = 10**18 + step * 50_000_000
            writer.write_joint_states(stamp_ns, robot.joint_names, robot.lower)
            for view, camera in cameras.items():
                writer.write_camera_info(view, stamp_ns, camera)
                writer.write_image(view, stamp_ns, pixels, compressed=view == 'low')
    reader = BagReader(folder / 'whole')
    with (folder / 'bag_0.mcap').open('wb') as file:
        plain = Writer(
            file, compression=CompressionType.NONE, enable_crcs=False, use_chunking=False
        )
        plain.start(profile='ros2', library='fuzz')
        channels: dict[str, int] = {}
        for message in reader.messages():
            if message.topic not in channels:
                msgtype, text, qos = reader.declared()[message.topic]
                schema = plain.register_schema(msgtype, 'ros2msg', text.encode())
                channels[message.topic] = plain.register_channel(
                    message.topic, 'cdr', schema, {'offered_qos_profiles': qos}
                )
            plain.add_message(
                channels[message.topic], message.stamp_ns, message.data, message.stamp_ns
            )
        for name, values in reader.metadata.items():
            if name != 'rosbag2':
                plain.add_metadata(name, values)
        plain.finish()
    shutil.copy(folder / 'whole' / 'calibration.yaml', folder)
    shutil.rmtree(folder / 'whole')


def _read_episode(folder: Path) -> Any:
    from mtv_world_ros.data.episode_reader import read_episode

    episode = read_episode(folder)
    for _, frames in episode.images.values():
        np.asarray(frames)
    return episode


@cache
def _yam() -> Any:
    return load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))


def make_card(folder: Path) -> None:
    """A data set of two episodes and its card."""
    for name in ('episode_00000', 'episode_00001'):
        (folder / name).mkdir()
        (folder / name / 'metadata.yaml').write_text('')
        (folder / name / f'{name}_0.mcap').write_text('')
    entries = [
        {'name': 'episode_00000', 'scene': 'a', 'zero_shot': ''},
        {'name': 'episode_00001', 'scene': 'a', 'zero_shot': 'object'},
    ]
    splits = {'train': ['episode_00000', 'episode_00001'], 'test': []}
    (folder / 'dataset.json').write_text(json.dumps({'splits': splits, 'episodes': entries}))


def _read_card(folder: Path) -> Any:
    from mtv_world_ros.data.splits import select

    return select(folder, 'train')


def make_calibration(folder: Path) -> None:
    """What `mtv-world fit success` stores."""
    for name in ('success_calibration.json', 'horizon.json'):
        shutil.copy(share_path('resource', 'checkpoint', name), folder)


def _read_calibration(folder: Path) -> Any:
    from mtv_world_ros.success.calibration import Calibration, HorizonCurve, load_fit

    return load_fit(folder, Calibration), load_fit(folder, HorizonCurve)


def make_ranking(folder: Path) -> None:
    """One result of a ranking."""
    from mtv_world_ros.core.files import write_json
    from mtv_world_ros.ranking.jobs import Result, StoredEstimate
    from mtv_world_ros.ranking.run_jobs import FOLDER

    judged = StoredEstimate(
        probability=0.5, interval=(0.25, 0.75), jaccard=((0.5,),), reasons=('a',)
    )
    result = Result(
        policy='expert', task='stack', index=0, seed=1, ever=True, final=True, imagined=judged,
        seen=judged, no_picture=judged, num_chunks=3, num_imagined=3, is_over=False,
        seconds={'model': 1.0},
    )  # fmt: skip
    content = {'settings': {}, 'definition': '', 'result': result.as_json()}
    write_json(folder / FOLDER / 'a.json', content)


def _read_ranking(folder: Path) -> Any:
    from mtv_world_ros.ranking.run_jobs import read_results

    return read_results(folder)


def make_evaluation(folder: Path) -> None:
    """An evaluation of one episode."""
    from mtv_world_ros.evaluation.metrics.jaccard_scores import ScoreRow
    from mtv_world_ros.evaluation.results import EpisodeResult

    numbers = dict.fromkeys(
        ('j', 'j_visible', 'j_copy', 'j_shuffled', 'j_zero', 'j_ceiling', 'j_self'),
        0.5,
    )
    row = ScoreRow(
        stretch=0, num_frames=2, view='low', name='block', status='ok', moving=True,
        j_frames=(0.5, 0.5), j_copy_frames=(0.5, 0.5), j_shuffled_frames=(),
        moving_imagined=True, **numbers, **dict.fromkeys(('f', 'f_copy', 'f_self'), 0.5),
    )  # fmt: skip
    result = EpisodeResult(
        episode='a', task='stack', zero_shot='', outcome='success', rows=(row,),
        quality={'low': {'psnr': 20.0}}, probability=0.5, reasons=(), notes=(),
        seconds_per_chunk=1.0, seconds={}, has_ids=True,
    )  # fmt: skip
    empty = dict.fromkeys(('provenance', 'overall', 'tasks', 'failed', 'success'), {})
    model = {'views': ['low'], 'fps': 5, 'num_frames': 2, 'width': 48, 'height': 40, 'robot': 'a'}
    metrics = {'name': 'a', 'label': 'a', 'episodes': ['a'], 'views': {'low': {}}, 'model': model}
    metrics |= empty
    (folder / 'metrics.json').write_text(json.dumps(metrics))
    (folder / 'episodes').mkdir()
    (folder / 'episodes' / 'a.json').write_text(json.dumps({'result': result.as_json()}))


def _read_evaluation(folder: Path) -> Any:
    from mtv_world_ros.reports.read_back import read_evaluations

    return read_evaluations(folder)


def make_rollout(folder: Path) -> None:
    """The frames of a scored episode."""
    from mtv_world_ros.viewing.scored_rollout import StoredRollout
    from mtv_world_ros.viewing.stored_rollout import save_rollout

    frames, masks = np.zeros((2, 3, 32, 48, 3), np.uint8), np.zeros((2, 1, 3, 32, 48), bool)
    rollout = StoredRollout(
        views=('low', 'high'), objects=('block',), fps=5.0, stretches=np.zeros(3),
        times=np.arange(3) / 5.0, real=frames, trajectory=frames, imagined=frames,
        true_masks=masks, masks=masks, j=np.zeros((2, 1, 3)),
    )  # fmt: skip
    save_rollout(folder / 'rollout.npz', rollout)


def _read_rollout(folder: Path) -> Any:
    from mtv_world_ros.viewing.stored_rollout import load_rollout

    return load_rollout(folder / 'rollout.npz')


@cache
def _layers() -> Any:
    import torch

    block = torch.nn.ModuleDict({'to_q': torch.nn.Linear(4, 6), 'to_k': torch.nn.Linear(4, 6)})
    return torch.nn.ModuleDict({'blocks': torch.nn.ModuleList([block])})


def make_lora(folder: Path) -> None:
    """The factors of two layers."""
    from safetensors.torch import save_file
    import torch

    tensors = {}
    for layer in ('blocks.0.to_q', 'blocks.0.to_k'):
        tensors[f'{layer}.lora_A.weight'] = torch.ones(2, 4)
        tensors[f'{layer}.lora_B.weight'] = torch.ones(6, 2)
        tensors[f'{layer}.alpha'] = torch.tensor(2.0)
    save_file(tensors, folder / 'adapter.safetensors', {'lora_adapter_metadata': '{"r": 2}'})


def _read_lora(folder: Path) -> Any:
    from mtv_world_ros.model.lora_file import read_lora

    return read_lora(folder / 'adapter.safetensors', _layers())


CACHE_SETTINGS = {'autoencoder': 'a', 'width': 48}


def make_latents(folder: Path) -> None:
    """A cache of two clips, and one of other settings."""
    import torch

    from mtv_world_ros.training.clips.latent_cache import LatentCache

    for settings in (CACHE_SETTINGS, {'autoencoder': 'b'}):
        with_clips = LatentCache(folder, settings)
        for key in ('a', 'b'):
            with_clips.add(key, f'clip {key}', {'latents': torch.ones(4, 3)})
        with_clips.flush()


def _read_latents(folder: Path) -> Any:
    from mtv_world_ros.training.clips.latent_cache import LatentCache

    LatentCache(folder, {'autoencoder': 'c'})
    held = LatentCache(folder, CACHE_SETTINGS)
    held.changed({'clip a': 'x'})
    for key in [key for key in ('a', 'b') if key in held]:
        held.read(key)
    if held.notes:
        raise MtvWorldError(held.notes[0])


def make_shards(folder: Path) -> None:
    """Weights in two shards with an index."""
    from safetensors.torch import save_file
    import torch

    places = {}
    for number in (1, 2):
        name = f'model-0000{number}-of-00002.safetensors'
        save_file({f'w{number}': torch.ones(3)}, folder / name)
        places[f'w{number}'] = name
    index = {'metadata': {'total_size': 24}, 'weight_map': places}
    (folder / 'model.safetensors.index.json').write_text(json.dumps(index))


def _read_shards(folder: Path) -> Any:
    from mtv_world_ros.model.tensor_files import open_tensors

    return [tensor.read() for tensor in open_tensors(folder).values()]


def make_description(folder: Path) -> None:
    """A description that was kept."""
    from mtv_world_ros.vision.describers.vlm import DescriptionCache, read_answer

    objects = read_answer(answers()[0].decode())
    DescriptionCache(folder).put('a', objects, 'model')
    assert asdict(objects[0])


def _read_description(folder: Path) -> Any:
    from mtv_world_ros.vision.describers.vlm import DescriptionCache

    if DescriptionCache(folder).get('a') is None:
        raise MtvWorldError('nothing that can be read')


def answers() -> list[bytes]:
    """Answers of language models, the second one in a text."""
    item = {'id': 'red_block', 'name': 'red block', 'colour': 'red', 'category': 'block',
            'role': 'manipuland', 'box': [412, 530, 468, 601]}  # fmt: skip
    text = json.dumps({'objects': [item]})
    return [text.encode(), f'I see this:\n```json\n{text}\n```'.encode()]


def make_mesh(folder: Path) -> None:
    """A robot of one moving link with a mesh of four faces."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = [corners[[a, b, c]] for a, b, c in ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))]
    rows = b''.join(bytes(12) + face.tobytes() + bytes(2) for face in faces)
    (folder / 'link.stl').write_bytes(bytes(80) + np.uint32(4).tobytes() + rows)
    (folder / 'robot.urdf').write_text(
        '<robot name="r"><link name="base"/><link name="tool"><visual><geometry>'
        '<mesh filename="link.stl"/></geometry></visual></link><joint name="j" type="revolute">'
        '<parent link="base"/><child link="tool"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
    )
    (folder / 'robot.yaml').write_text(
        'name: r\nurdf: robot.urdf\ntools: [{arm: only, link: tool}]\n'
    )


def _read_mesh(folder: Path) -> Any:
    from mtv_world_ros.robot.shape import load_shape

    return load_shape(load_robot(folder / 'robot.yaml'))


@cache
def _dataset_writer() -> Any:
    spec = importlib.util.spec_from_file_location('datasets', ROOT / 'test/importing/conftest.py')
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules['datasets_of_tests'] = module
    spec.loader.exec_module(module)
    return module


def make_dataset(version: str, folder: Path) -> None:
    """A LeRobot dataset of a version, without its videos."""
    _dataset_writer().WRITERS[version](folder / 'data')
    shutil.rmtree(folder / 'data' / 'videos', ignore_errors=True)


make_dataset_v2 = partial(make_dataset, 'images')
make_dataset_v3 = partial(make_dataset, 'v3.0')


def _read_dataset(folder: Path) -> Any:
    from mtv_world_ros.importing.lerobot import LeRobotDataset

    dataset = LeRobotDataset(folder / 'data')
    for entry in dataset.episodes.values():
        rows = dataset.rows(entry, ['observation.state', 'timestamp'])
        if dataset.version != 'v3.0':
            list(dataset.frames(entry, 'observation.images.front', rows['timestamp'].ravel()))
    for feature in dataset.features:
        dataset.column_names(feature)


def make_camera_file(folder: Path) -> None:
    """Camera parameters of a data set's own."""
    look = {'K': [[70.0, 0, 31.5], [0, 70, 23.5], [0, 0, 1]], 'size': [64, 48],
            'distortion': [0.1, 0, 0, 0, 0], 'pose': np.eye(4).tolist()}  # fmt: skip
    (folder / 'cameras.json').write_text(json.dumps({'front': look}))


def _read_camera_file(folder: Path) -> Any:
    from mtv_world_ros.importing.camera_parameters import camera_track, CameraSource

    source = CameraSource.model_validate(
        {
            'view': 'front',
            'feature': 'x',
            'camera': {
                'file': 'cameras.json',
                'intrinsics': 'front.K',
                'distortion': 'front.distortion',
                'extrinsics': 'front.pose',
                'mount_link': 'base',
            },
        }
    )
    return camera_track(source, folder, 0, {}, (64, 48)).camera


#: kind -> makes the folder, which files are damaged, reads it
FOLDERS: dict[str, tuple[Callable[[Path], None], tuple[str, ...], Callable[[Path], Any]]] = {
    'episode': (make_episode, ('.mcap', '.yaml'), _read_episode),
    'data set card': (make_card, ('dataset.json',), _read_card),
    'success calibration': (make_calibration, ('.json',), _read_calibration),
    'ranking': (make_ranking, ('.json',), _read_ranking),
    'evaluation': (make_evaluation, ('.json',), _read_evaluation),
    'rollout': (make_rollout, ('.npz',), _read_rollout),
    'LoRA': (make_lora, ('.safetensors',), _read_lora),
    'latent cache': (make_latents, ('.safetensors', '.json'), _read_latents),
    'weights in shards': (make_shards, ('.safetensors', '.json'), _read_shards),
    'kept description': (make_description, ('.json',), _read_description),
    'mesh': (make_mesh, ('.stl', '.urdf'), _read_mesh),
    'LeRobot v2.1': (make_dataset_v2, ('.json', '.jsonl', '.parquet'), _read_dataset),
    'LeRobot v3.0': (make_dataset_v3, ('.json', '.parquet'), _read_dataset),
    'camera parameters': (make_camera_file, ('.json',), _read_camera_file),
}
