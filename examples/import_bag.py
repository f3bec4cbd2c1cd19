"""Makes an episode of a robot's own rosbag2 recording.

    python examples/import_bag.py [BAG] [--out out/examples/imported]

The mapping says which topic is what; here the topics have their usual names, so that the views
are guessed. The same as `mtv-world import bag`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from mtv_world_ros import (
    BagMapping,
    import_bags,
    read_episode,
    robot_path,
    share_path,
    with_guessed_views,
)

parser = argparse.ArgumentParser()
parser.add_argument('bag', type=Path, nargs='?', default=share_path('resource', 'demo_episode'))
parser.add_argument('--robot', default='yam_bimanual')
parser.add_argument('--out', type=Path, default=Path('out/examples/imported'))
options = parser.parse_args()

mapping = with_guessed_views(BagMapping(), options.bag)
for view, topics in mapping.views.items():
    print(f'view {view}: {mapping.topic(topics.image)}')
summary = import_bags([options.bag], options.out, mapping, robot_path(options.robot))
for part, reason in summary.failed.items():
    print(f'{part}: {reason}')
for part in (*summary.made, *summary.kept):
    episode = read_episode(options.out / part.name)
    frames = {view: len(track.stamps_ns) for view, track in episode.images.items()}
    print(f'{options.out / part.name}: {frames} frames, instruction "{episode.info.instruction}"')
