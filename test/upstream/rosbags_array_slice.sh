#!/usr/bin/env bash
# rosbags 0.11.9: a message whose float64 array is a column of a table cannot be serialised.
#
# Joint positions are often a column of an (N, J) array. Expected of serialize_cdr: the values are
# written, as those of any float64 array. What happens: ValueError about a last axis that must be
# contiguous; a copy of the same values is written.
#
# Guards mtv_world_ros/data/bag/messages.py, which copies arrays before they are serialised.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/env"
"$place/env/bin/pip" install -q --disable-pip-version-check rosbags==0.11.9 numpy==2.4.6
cd "$place"
"$place/env/bin/python" - <<'PYTHON'
import numpy as np
from rosbags.typesys import get_typestore, Stores

store = get_typestore(Stores.ROS2_JAZZY)
types = store.types
header = types['std_msgs/msg/Header'](
    stamp=types['builtin_interfaces/msg/Time'](sec=1, nanosec=0), frame_id=''
)
table = np.arange(6.0).reshape(3, 2)


def write(values):
    none = np.zeros(0)
    message = types['sensor_msgs/msg/JointState'](
        header=header, name=['a', 'b', 'c'], position=values, velocity=none, effort=none
    )
    data = store.serialize_cdr(message, message.__msgtype__)
    return store.deserialize_cdr(data, message.__msgtype__).position.tolist()


try:
    print('a column:', write(table[:, 1]))
except ValueError as error:
    print('a column: ValueError:', error)
    print('its copy:', write(table[:, 1].copy()))
    assert write(table[:, 1].copy()) == [1.0, 3.0, 5.0], 'changed'
else:
    raise SystemExit('changed: a column is written')
PYTHON
