r"""Are objects that a gripper hides in part found where they are?

    mtv-world collect --zero-shot view --episodes 30 --seed 9600 --out data/zero_view
    python benchmark/found_again.py data/zero_view [--every 1]

At the start of each chunk but the first, every object of a recorded episode is found in the real
frames: as large as it was in the episode's first frame (`again`), and from what is seen of it by
now alone (`anew`). `hidden`: some view shows less than 90 % of the pixels that it showed at first.
`moved`: by more than 4 mm, in truth. Errors are of the centre's way since the first frame.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from page import publish, table

from mtv_world_ros.assembly import load_pipeline
from mtv_world_ros.data.episode_reader import list_episodes
from mtv_world_ros.data.recording import load_recording, Recording
from mtv_world_ros.data_types import BoolArray, CameraModel, FloatArray
from mtv_world_ros.geometry.camera import camera_poses
from mtv_world_ros.geometry.mask_geometry import centroids, locate_all
from mtv_world_ros.geometry.solids import find_solid, fit_solid, is_vessel, Solid
from mtv_world_ros.lab.evaluation.imagined_stretches import stretches
from mtv_world_ros.pipeline import Pipeline

_MOVED_M, _WHOLE = 0.004, 0.9
HEAD = (
    'objects',
    'n',
    'not found again',
    'over 1 cm',
    'again [mm]',
    '90 %',
    'anew: over 1 cm',
    'anew [mm]',
    '90 %',
)


class Seen(NamedTuple):
    """What a frame shows of O objects: masks (V, O, H, W), seen at (4, 4), centres (O, 3) [m]."""

    masks: BoolArray
    cameras: tuple[CameraModel, ...]
    poses: list[FloatArray]
    points: FloatArray


def main() -> None:
    """Prints errors of places by what moved and what is hidden."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('data', type=Path)
    parser.add_argument('--every', type=int, default=1, help='take every n-th episode')
    parser.add_argument('--machine', default='unknown')
    parser.add_argument('--out', type=Path, help='page to write')
    options = parser.parse_args()
    pipeline = load_pipeline('bundled', num_threads=1)
    errors: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for path in list_episodes(options.data)[:: options.every]:
        recording = load_recording(path, pipeline.spec, pipeline.robot)
        for kind, again, anew in _errors(pipeline, recording):
            errors[kind].append((again, anew))
    rows = []
    for kind, found in sorted(errors.items()):
        row = [kind, str(len(found)), str(int(np.isnan(found).sum(0)[0]))]
        for each in 1e3 * np.array(found).T:
            middle, most = np.nanquantile(each, (0.5, 0.9))
            row += [str(int((each > 10).sum())), f'{middle:.1f}', f'{most:.1f}']
        rows.append(row)
    options.seed, options.repeats = 0, sum(map(len, errors.values()))
    publish(
        'found_again',
        'Objects that something hides in part, found as large as they were',
        f'python benchmark/found_again.py {options.data}',
        f'{(__doc__ or "").split(chr(10) * 2)[-1]}\n{table(HEAD, rows)}',
        options,
        '1 process',
    )


def _errors(pipeline: Pipeline, recording: Recording) -> Iterator[tuple[str, float, float]]:
    """What an object is, and the errors of its place [m]; NaN = not found."""
    names, motion = recording.names, pipeline.object_motion
    if recording.object_poses is None or motion is None or motion.contact is None:  # type: ignore[attr-defined]
        raise SystemExit(f"'{recording.path}' has no true object poses, or no contact is computed")
    floor = motion.contact.table_m  # type: ignore[attr-defined]
    poses = recording.object_poses[:, [recording.objects.index(name) for name in names]]
    first = _seen(pipeline, recording, 0)
    whole = [_anew(first, item, name, floor) for item, name in enumerate(names)]
    for stretch in stretches(recording, pipeline.spec, 'observe')[1:]:
        now = _seen(pipeline, recording, stretch.start)
        for item, name in enumerate(names):
            was = whole[item]
            if was is None:
                continue
            turn = poses[stretch.start, item] @ np.linalg.inv(poses[0, item])
            true = turn[:3, :3] @ was.centre + turn[:3, 3]
            areas = now.masks[:, item].sum((-2, -1)) / first.masks[:, item].sum((-2, -1)).clip(1)
            moved = 'moved' if np.linalg.norm(true - was.centre) > _MOVED_M else 'still'
            hidden = 'hidden' if areas.min() < _WHOLE else 'whole'
            at = now.masks[:, item], now.points[item], now.cameras, now.poses, floor
            again = find_solid(was, *at)
            found, anew = (
                np.nan if solid is None else float(np.linalg.norm(solid.centre - true))
                for solid in (again, _anew(now, item, name, floor))
            )
            yield f'{moved}, {hidden}', found, anew


def _anew(seen: Seen, item: int, name: str, floor: float) -> Solid | None:
    at = seen.masks[:, item], seen.points[item], seen.cameras, seen.poses, floor
    return fit_solid(*at, is_open=is_vessel(name))


def _seen(pipeline: Pipeline, recording: Recording, frame: int) -> Seen:
    frames, cameras = recording.seen_at(frame)
    masks = pipeline.segmenter.segment(frames[:, None], recording.names).masks[:, :, 0]
    at = recording.positions[frame][None]
    poses = [camera_poses(camera, pipeline.robot, at)[0] for camera in cameras]
    return Seen(masks, cameras, poses, locate_all(cameras, poses, centroids(masks)))


if __name__ == '__main__':
    main()
