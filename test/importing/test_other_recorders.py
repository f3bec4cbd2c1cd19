"""Recordings of other recorders: ROS 1 bags, MCAP files with Foxglove's schemas and Protobuf."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
import yaml

from mtv_world_ros.cli import main
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.bag.video_packets import is_key
from mtv_world_ros.data.episode_reader import read_episode
from test.support.robot_recordings import camera, events, FPS, JOINTS, ns, positions, SECONDS

#: checksum of tf2_msgs/TFMessage and tf/tfMessage, of the ROS wiki
TF_DIGEST = '94810edda583a504dfda3829e70d7eec'


def colours(count: int) -> list[np.ndarray]:
    """Frames (48, 64, 3), each of one grey level of its own."""
    return [np.full((48, 64, 3), 40 + 4 * k, np.uint8) for k in range(count)]


# ROS 1


def as_ros1(message: Any, types: Any, kind: str) -> Any:
    """Return a message of ROS 2 as the one of ROS 1 with the same content."""
    values = {}
    for field in types[kind].__dataclass_fields__:
        if field == '__msgtype__':
            continue
        if field == 'seq':
            values[field] = 7
            continue
        value = getattr(message, field if hasattr(message, field) else field.lower())
        inner = getattr(value, '__msgtype__', '')
        if inner:
            value = as_ros1(value, types, inner)
        elif isinstance(value, list) and value and hasattr(value[0], '__msgtype__'):
            value = [as_ros1(one, types, one.__msgtype__) for one in value]
        values[field] = value
    return types[kind](**values)


def ros1_store(**further: str) -> Any:
    types = get_typestore(Stores.ROS1_NOETIC)
    text = 'geometry_msgs/TransformStamped[] transforms\n'
    for name in ('tf2_msgs/msg/TFMessage', 'tf/msg/tfMessage'):
        types.register(get_types_from_msg(text, name))
    for name, text in further.items():
        types.register(get_types_from_msg(text, name.replace('__', '/msg/')))
    return types


def write_ros1(
    path: Path, *, tf: str = 'tf2_msgs/msg/TFMessage', compression: Any = None,
    more: Any = lambda _: [], plans: bool = True, store: Any = None,
) -> Path:  # fmt: skip
    store = store or ros1_store()
    with Ros1Writer(path) as writer:
        topics: dict[str, Any] = {}
        told = [
            (t, topic, tf if kind == messages.TF_MESSAGE else kind,
             as_ros1(message, store.types, tf if kind == messages.TF_MESSAGE else kind))
            for t, topic, kind, message in events()
            if plans or topic != '/joint_trajectory'
        ]  # fmt: skip
        for t, topic, kind, message in sorted(
            [*told, *more(store.types)], key=lambda each: each[0]
        ):
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(topics[topic], ns(t), bytes(store.serialize_ros1(message, kind)))
    return path


@pytest.mark.parametrize('tf', ['tf2_msgs/msg/TFMessage', 'tf/msg/tfMessage'])
def test_a_bag_of_ros_1_is_imported_like_one_of_ros_2(tmp_path, run, record, tf):
    status, said = run(record())
    assert status == 0, said
    bag = write_ros1(tmp_path / 'old.bag', tf=tf)
    status, said = run(bag)
    assert status == 0, said
    new, old = read_episode(tmp_path / 'out/bag'), read_episode(tmp_path / 'out/old')
    assert new.joint_states is not None and old.joint_states is not None
    np.testing.assert_array_equal(new.joint_states.positions, old.joint_states.positions)
    np.testing.assert_array_equal(new.joint_states.stamps_ns, old.joint_states.stamps_ns)
    assert len(new.trajectories) == len(old.trajectories) == 4
    for (a, one), (b, other) in zip(new.trajectories, old.trajectories, strict=True):
        assert a == b
        np.testing.assert_array_equal(one.positions, other.positions)
    for view in ('front', 'side'):
        np.testing.assert_array_equal(new.cameras[view].K, old.cameras[view].K)
        np.testing.assert_array_equal(
            new.cameras[view].T_mount_camera, old.cameras[view].T_mount_camera
        )
        assert len(new.images[view].frames) == len(old.images[view].frames) == SECONDS * FPS


def test_the_checksum_of_transforms_is_the_one_of_ros_1():
    assert ros1_store().generate_msgdef('tf2_msgs/msg/TFMessage', ros_version=1)[1] == TF_DIGEST


def test_each_bag_of_ros_1_in_a_folder_is_a_recording(tmp_path):
    folder = tmp_path / 'bags'
    folder.mkdir()
    write_ros1(folder / 'first.bag')
    write_ros1(folder / 'second.bag')
    out = tmp_path / 'out'
    status = main(['import', 'bag', str(folder), '--robot', 'franka', '--out', str(out)])
    assert status == 0
    assert (out / 'first').is_dir() and (out / 'second').is_dir()


def test_goals_of_an_action_of_ros_1_are_plans(tmp_path, run):
    goal = 'std_msgs/Header header\nactionlib_msgs/GoalID goal_id\ncontrol_msgs/Goal goal\n'
    plain = (
        'trajectory_msgs/JointTrajectory trajectory\nfloat64[] tolerance\n'
        'duration time_tolerance\n'
    )
    store = ros1_store(
        control_msgs__Goal=plain, control_msgs__FollowJointTrajectoryActionGoal=goal
    )

    def more(types: Any) -> list[tuple[float, str, str, Any]]:
        kind = 'control_msgs/msg/FollowJointTrajectoryActionGoal'
        zero = types['builtin_interfaces/msg/Time'](sec=0, nanosec=0)
        found = []
        for t, _, name, message in events():
            if name != messages.JOINT_TRAJECTORY:
                continue
            trajectory = as_ros1(message, types, name)
            trajectory.header.stamp = zero
            told = types[kind](
                header=trajectory.header,
                goal_id=types['actionlib_msgs/msg/GoalID'](stamp=zero, id='goal 1'),
                goal=types['control_msgs/msg/Goal'](
                    trajectory=trajectory,
                    tolerance=np.zeros(0),
                    time_tolerance=types['builtin_interfaces/msg/Duration'](sec=0, nanosec=0),
                ),
            )
            found.append((t, '/arm/follow_joint_trajectory/goal', kind, told))
        return found

    bag = write_ros1(tmp_path / 'old.bag', more=more, plans=False, store=store)
    status, said = run(bag)
    assert status == 0, said
    assert 'commands are those of /arm/follow_joint_trajectory/goal' in said
    plans = read_episode(tmp_path / 'out/old').trajectories
    assert [stamp for stamp, _ in plans] == [ns(k + 0.004) for k in range(4)]
    np.testing.assert_allclose(plans[1][1].positions[4], positions(1.504), atol=1e-6)


def test_topics_of_ros_1_that_are_not_read_are_named(tmp_path, run):
    store = ros1_store(my_robot__Custom='float64 value\n')
    bag = write_ros1(
        tmp_path / 'old.bag',
        store=store,
        more=lambda types: [
            (0.5, '/own', 'my_robot/msg/Custom', types['my_robot/msg/Custom'](value=1.0))
        ],
    )
    status, said = run(bag)
    assert status == 0
    assert "'/own' was left out: my_robot/msg/Custom of ROS 1 is not read" in said


def test_damaged_and_huge_bags_of_ros_1_are_refused_in_words(tmp_path, run, monkeypatch):
    bag = write_ros1(tmp_path / 'old.bag')
    data = bag.read_bytes()
    bag.write_bytes(data[: len(data) // 2])
    status, said = run(bag)
    assert status == 1 and "old.bag' is cut off or damaged" in said, said
    bag.write_bytes(data)
    monkeypatch.setenv('MTV_WORLD_MAX_CHUNK_BYTES', '1000')
    status, said = run(bag)
    assert status == 1 and 'a chunk has' in said and 'at most 1000' in said, said


@pytest.mark.parametrize('compression', ['BZ2', 'LZ4'])
def test_compressed_bags_of_ros_1_inflate_within_the_limit(tmp_path, monkeypatch, compression):
    store = ros1_store()
    path = tmp_path / 'old.bag'
    writer = Ros1Writer(path)
    writer.set_compression(Ros1Writer.CompressionFormat[compression])
    text = 'x' * 100_000
    kind = messages.STRING
    with writer:
        topic = writer.add_connection('/instruction', kind, typestore=store)
        data = bytes(store.serialize_ros1(store.types[kind](data=text), kind))
        writer.write(topic, ns(0), data)
    (message,) = BagReader(path).messages()
    assert messages.deserialize(kind, message.data).data == text
    monkeypatch.setenv('MTV_WORLD_MAX_CHUNK_BYTES', '50000')
    reader = BagReader(path)
    assert list(reader.messages()) == []
    assert 'more than 50000 bytes' in reader.truncated


def test_recover_does_not_copy_a_bag_of_ros_1(tmp_path, capsys):
    bag = write_ros1(tmp_path / 'old.bag')
    assert main(['recover', str(bag)]) == 1
    assert 'import bag reads it, and rosbag reindex mends it' in capsys.readouterr().err


# Foxglove


def packets(codec: str, count: int) -> list[bytes]:
    """Encoded frames, one packet each, with a key frame every ten."""
    context = av.CodecContext.create(codec, 'w')
    context.width, context.height, context.pix_fmt = 64, 48, 'yuv420p'
    context.time_base, context.framerate = Fraction(1, FPS), Fraction(FPS)
    context.options = {
        'libx264': {'preset': 'ultrafast', 'tune': 'zerolatency', 'g': '10',
                    'x264-params': 'repeat-headers=1:annexb=1:scenecut=0'},
        'libx265': {'preset': 'ultrafast', 'tune': 'zerolatency',
                    'x265-params': 'repeat-headers=1:annexb=1:keyint=10:min-keyint=10:scenecut=0'
                    ':log-level=none'},
    }[codec]  # fmt: skip
    found = []
    for k, pixels in enumerate(colours(count)):
        frame = av.VideoFrame.from_ndarray(pixels, 'rgb24')
        frame.pts = k
        found += [bytes(packet) for packet in context.encode(frame)]
    return [*found, *(bytes(packet) for packet in context.encode(None))]


@pytest.mark.parametrize(('codec', 'encoding'), [('libx264', 'h264'), ('libx265', 'h265')])
def test_key_frames_are_found_in_packets(codec, encoding):
    try:
        made = packets(codec, 30)
    except av.FFmpegError as error:  # pragma: no cover
        pytest.skip(f'{codec}: {error}')
    assert [k for k, data in enumerate(made) if is_key(encoding, data)] == [0, 10, 20]


def test_key_frames_of_vp9_and_av1_are_told_by_their_headers():
    # uncompressed header of VP9: marker 2, profile 0, show_existing 0, frame_type 0 = key
    assert is_key('vp9', bytes([0b10000010])) and not is_key('vp9', bytes([0b10000110]))
    # OBUs of AV1: temporal delimiter (0x12 0x00), then a sequence header (kind 1), or a frame (6)
    assert is_key('av1', b'\x12\x00\x0a\x0b') and not is_key('av1', b'\x12\x00\x32\x0b')


def without_images() -> list[tuple[float, str, str, Any]]:
    return [each for each in events() if 'image_raw' not in each[1]]


def shown(folder: Path, view: str) -> list[float]:
    """Return the mean level of each frame of an imported view."""
    return [float(np.asarray(frame).mean()) for frame in read_episode(folder).images[view].frames]


def test_compressed_video_of_ros_2_is_a_view(tmp_path, run):
    kind = 'foxglove_msgs/msg/CompressedVideo'
    store = get_typestore(Stores.ROS2_JAZZY)
    text = 'builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n'
    store.register(get_types_from_msg(text, kind))
    count = round(SECONDS * FPS)
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics: dict[str, Any] = {}

        def write(t: float, topic: str, name: str, data: bytes) -> None:
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, name, typestore=store)
            writer.write(topics[topic], ns(t), data)

        for t, topic, name, message in without_images():
            write(t, topic, name, messages.serialize(name, message))
        for k, packet in enumerate(packets('libx264', count)):
            stamp = store.types['builtin_interfaces/msg/Time'](
                sec=ns(k / FPS) // 10**9, nanosec=ns(k / FPS) % 10**9
            )
            for view in ('front', 'side'):
                told = store.types[kind](
                    timestamp=stamp, frame_id=f'{view}_optical_frame', format='h264',
                    data=np.frombuffer(packet, np.uint8),
                )  # fmt: skip
                write(k / FPS, f'/{view}/video', kind, bytes(store.serialize_cdr(told, kind)))
    out = tmp_path / 'fox'
    status = main(['import', 'bag', str(tmp_path / 'bag'), '--robot', 'franka', '--out', str(out)])
    assert status == 0
    levels = shown(out / 'bag', 'front')
    np.testing.assert_allclose(levels, [40 + 4 * k for k in range(count)], atol=4)
    found = read_episode(out / 'bag').cameras['front'].T_mount_camera
    np.testing.assert_allclose(found, camera('front').T_mount_camera, atol=1e-9)


# Protobuf


def proto_classes() -> Any:
    """Return message classes of a few schemas, built from their descriptions."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

    F = descriptor_pb2.FieldDescriptorProto
    kinds = {'string': F.TYPE_STRING, 'bytes': F.TYPE_BYTES, 'double': F.TYPE_DOUBLE,
             'fixed32': F.TYPE_FIXED32}  # fmt: skip
    schemas = {
        'foxglove.CompressedImage': ['timestamp', 'frame_id', 'data:bytes', 'format'],
        'foxglove.CameraCalibration': ['timestamp', 'frame_id', 'width:fixed32', 'height:fixed32',
                                       'distortion_model', '*D:double', '*K:double', '*R:double',
                                       '*P:double'],
        'foxglove.Vector3': ['x:double', 'y:double', 'z:double'],
        'foxglove.Quaternion': ['x:double', 'y:double', 'z:double', 'w:double'],
        'foxglove.FrameTransform': ['timestamp', 'parent_frame_id', 'child_frame_id',
                                    'translation@foxglove.Vector3',
                                    'rotation@foxglove.Quaternion'],
        'lab.JointState': ['timestamp', '*name', '*position:double', '*velocity:double'],
        'lab.Secret': ['value:double'],
    }  # fmt: skip
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    found = {}
    for name, fields in schemas.items():
        package, _, short = name.rpartition('.')
        file = descriptor_pb2.FileDescriptorProto(
            name=f'{short}.proto', package=package, syntax='proto3'
        )
        made = file.message_type.add(name=short)
        for number, text in enumerate(fields, start=1):
            plain, _, inner = text.lstrip('*').partition('@')
            title, _, kind = plain.partition(':')
            field = made.field.add(name=title, number=number)
            field.label = F.LABEL_REPEATED if text.startswith('*') else F.LABEL_OPTIONAL
            field.type = kinds[kind or 'string']
            inner = 'google.protobuf.Timestamp' if title == 'timestamp' else inner
            if inner:
                field.type, field.type_name = F.TYPE_MESSAGE, f'.{inner}'
                place = 'google/protobuf/timestamp' if 'google' in inner else inner[9:]
                if f'{place}.proto' not in file.dependency:
                    file.dependency.append(f'{place}.proto')
        pool.Add(file)
        found[name] = message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
    return found


def write_protobuf(path: Path) -> Path:
    """The recording of `robot_recordings` with Foxglove's schemas; plans are not in it."""
    from mcap_protobuf.writer import Writer as ProtobufWriter

    make = proto_classes()

    def stamp(message: Any) -> dict[str, int]:
        return {'seconds': message.header.stamp.sec, 'nanos': message.header.stamp.nanosec}

    with path.open('wb') as file, ProtobufWriter(file) as writer:
        for t, topic, kind, message in sorted(events(), key=lambda each: each[0]):
            if kind == messages.COMPRESSED_IMAGE:
                told = make['foxglove.CompressedImage'](
                    timestamp=stamp(message), frame_id=message.header.frame_id,
                    data=bytes(message.data), format='jpeg',
                )  # fmt: skip
            elif kind == messages.CAMERA_INFO:
                told = make['foxglove.CameraCalibration'](
                    timestamp=stamp(message), frame_id=message.header.frame_id,
                    width=message.width, height=message.height, distortion_model='plumb_bob',
                    D=message.d, K=message.k, R=message.r, P=message.p,
                )  # fmt: skip
            elif kind == messages.JOINT_STATE:
                told = make['lab.JointState'](
                    timestamp=stamp(message), name=message.name, position=message.position
                )
            elif kind == messages.TF_MESSAGE:
                (one,) = message.transforms
                p, q = one.transform.translation, one.transform.rotation
                told = make['foxglove.FrameTransform'](
                    timestamp=stamp(one), parent_frame_id=one.header.frame_id,
                    child_frame_id=one.child_frame_id,
                    translation={'x': p.x, 'y': p.y, 'z': p.z},
                    rotation={'x': q.x, 'y': q.y, 'z': q.z, 'w': q.w},
                )  # fmt: skip
            else:
                continue
            writer.write_message(topic, told, ns(t), ns(t))
        writer.write_message('/secret', make['lab.Secret'](value=1.0), ns(0.5), ns(0.5))
    return path


def test_protobuf_messages_of_foxgloves_schemas_are_imported(tmp_path, run):
    pytest.importorskip('mcap_protobuf', reason='mcap-protobuf-support is not installed')
    file = write_protobuf(tmp_path / 'fox.mcap')
    status, said = run(file, action='state')
    assert status == 0, said
    assert "'/secret' was left out: its Protobuf schema 'lab.Secret' is not read" in said
    assert said.count('/secret') == 1
    episode = read_episode(tmp_path / 'out/fox')
    assert episode.joint_states is not None
    for stamp, row in zip(
        episode.joint_states.stamps_ns, episode.joint_states.positions, strict=True
    ):
        named = dict(zip(episode.joint_states.joint_names, row, strict=True))
        right = positions((int(stamp) - ns(0)) / 1e9)
        np.testing.assert_allclose([named[name] for name in JOINTS], right, atol=1e-9)
    for view in ('front', 'side'):
        found = episode.cameras[view]
        np.testing.assert_allclose(found.K, camera(view).K)
        np.testing.assert_allclose(found.T_mount_camera, camera(view).T_mount_camera, atol=1e-9)


def test_a_folder_without_images_names_what_it_has(tmp_path, capsys):
    pytest.importorskip('mcap_protobuf', reason='mcap-protobuf-support is not installed')
    from mcap_protobuf.writer import Writer as ProtobufWriter

    path = tmp_path / 'fox.mcap'
    make = proto_classes()
    with path.open('wb') as file, ProtobufWriter(file) as writer:
        writer.write_message('/secret', make['lab.Secret'](value=1.0), ns(0), ns(0))
    status = main(['import', 'bag', str(path), '--robot', 'franka', '--out', str(tmp_path / 'o')])
    assert status == 1
    said = capsys.readouterr().err
    assert 'has no images' in said and "'/secret' was left out: its Protobuf schema" in said


def test_a_mapping_of_a_protobuf_recording_reads_it_again(tmp_path, run):
    pytest.importorskip('mcap_protobuf', reason='mcap-protobuf-support is not installed')
    file = write_protobuf(tmp_path / 'fox.mcap')
    assert run(file, action='state')[0] == 0
    saved = yaml.safe_load((tmp_path / 'out/mapping.yaml').read_text())
    assert set(saved['views']) == {'front', 'side'}
