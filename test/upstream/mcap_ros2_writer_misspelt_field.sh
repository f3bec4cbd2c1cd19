#!/usr/bin/env bash
# mcap-ros2-support 0.6.0: a key that the message type does not have is dropped without a word.
#
# Expected of write_message(topic, schema, {...}): an error that names the unknown key.
# What happens: the value is lost, the field that was meant is written empty, and a float that is
# given for an integer field is cut off.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/env"
"$place/env/bin/pip" install -q --disable-pip-version-check mcap==1.6.0 mcap-ros2-support==0.6.0
cd "$place"
"$place/env/bin/python" - <<'PYTHON'
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer

with open('x.mcap', 'wb') as stream:
    writer = Writer(stream)
    schema = writer.register_msgdef('demo/msg/State', 'string[] name\nfloat64[] position\nint32 count')
    message = {'name': ['elbow'], 'positions': [1.5], 'count': 1.9}  # 'positions' is misspelt
    writer.write_message('/state', schema, message, log_time=0)
    writer.finish()
with open('x.mcap', 'rb') as stream:
    reader = make_reader(stream, decoder_factories=[DecoderFactory()])
    (found,) = [item.decoded_message for item in reader.iter_decoded_messages()]
print('written:', message)
print('read:   ', found.name, list(found.position), found.count)
assert (list(found.name), list(found.position), found.count) == (['elbow'], [], 1), 'changed'
PYTHON
