#!/usr/bin/env bash
# rosbags 0.11.9: the end of a bag is later than its last message.
#
# Messages at 5 and 9 ns. Expected of AnyReader: end_time 9 and duration 4, as in the bag's own
# metadata.yaml. What happens: end_time is 10 and duration 5, so that a time which is taken from
# end_time lies after the last message, and clocks of two readers of one bag differ.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/env"
"$place/env/bin/pip" install -q --disable-pip-version-check rosbags==0.11.9
cd "$place"
"$place/env/bin/python" - <<'PYTHON'
from pathlib import Path

from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

store = get_typestore(Stores.ROS2_JAZZY)
kind = 'std_msgs/msg/String'
bag = Path('bag')
with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
    connection = writer.add_connection('/s', kind, typestore=store)
    for stamp in (5, 9):
        writer.write(connection, stamp, store.serialize_cdr(store.types[kind](data='x'), kind))
with AnyReader([bag]) as reader:
    last = max(stamp for _, stamp, _ in reader.messages())
    found = (reader.start_time, reader.end_time, reader.duration)
text = (bag / 'metadata.yaml').read_text()
print('last message', last, '| start, end, duration', found)
print([line.strip() for line in text.splitlines() if 'nanoseconds' in line][:2])
assert last == 9 and found == (5, 10, 5), 'changed'
PYTHON
