#!/usr/bin/env bash
# byte and char of a ROS 2 message: rosbags 0.11.9 and mcap-ros2-support 0.6.0 disagree in the sign.
#
# Both are numbers from 0 to 255 in ROS 2: an octet and a uint8, says its design page "Interface
# definition using .msg files", "Mapping to IDL types". Expected of both: 200 is read as 200. What
# happens: each has one of the two signed, and not the same one, so that 200 becomes -56 without a
# word, and each refuses to write the 200 that the other one takes.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/env"
"$place/env/bin/pip" install -q --disable-pip-version-check mcap==1.6.0 \
    mcap-ros2-support==0.6.0 rosbags==0.11.9 numpy==2.4.6
cd "$place"
"$place/env/bin/python" - <<'PYTHON'
import io
import struct

from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

NAME = 'demo/msg/Gripper'
CDR = bytes([0, 1, 0, 0, 200])


def write_with_mcap(kind):
    writer = Writer(io.BytesIO())
    schema = writer.register_msgdef(NAME, f'{kind} opening')
    writer.write_message('/gripper', schema, {'opening': 200}, log_time=0)


for kind, signed in (('byte', 'rosbags'), ('char', 'mcap-ros2-support')):
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(f'{kind} opening', NAME))
    schema = Schema(id=1, name=NAME, encoding='ros2msg', data=f'{kind} opening'.encode())
    found = {
        'rosbags': store.deserialize_cdr(CDR, NAME).opening,
        'mcap-ros2-support': DecoderFactory().decoder_for('cdr', schema)(CDR).opening,
    }
    print(f'{kind} 200 is read as', found)
    expected = {name: -56 if name == signed else 200 for name in found}
    assert found == expected, f'changed: {kind}'
    message = store.types[NAME](opening=200)
    writers = {'rosbags': lambda: store.serialize_cdr(message, NAME)}
    writers['mcap-ros2-support'] = lambda: write_with_mcap(kind)
    for name, write in writers.items():
        try:
            write()
            assert name != signed, f'changed: {name} writes {kind} 200'
        except struct.error as error:
            print(f'   {name} does not write it: {error}')
            assert name == signed, f'changed: {name} refuses {kind} 200'
PYTHON
