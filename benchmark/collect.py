"""How many episodes does a core collect in a minute, and where does the time go?

    python benchmark/collect.py [--repeats 2] [--seed 0] [--out benchmark/results]

CPU seconds of one process, `--repeats` episodes of each of the 15 tasks, dropped attempts
included. Physics: planning, simulation, relations. Rendering: scene building, images and masks of
both views. Writing: JPEG, PNG, MCAP.
"""

from __future__ import annotations

from functools import partial
import os
from pathlib import Path
import tempfile
import time

from page import measure, parse_arguments, publish, table

from mtv_world_ros.bench.collect.episode_jobs import jobs_of
from mtv_world_ros.bench.collect.episode_maker import CollectConfig, EpisodeMaker, Spent
from mtv_world_ros.bench.tasks.tasks import task_named, tasks_named
from mtv_world_ros.bench.world.opengl import load_mujoco
from mtv_world_ros.bench.world.randomize import draw_scene
from mtv_world_ros.bench.world.scene import scene_xml
from mtv_world_ros.bench.world.simulator import scene_generator
from mtv_world_ros.bench.world.workcell import workcell_of
from mtv_world_ros.files import bundled
from mtv_world_ros.geometry.robot.file import load_robot

PARTS = {'planning and physics': 'physics_s', 'rendering': 'rendering_s', 'writing': 'writing_s'}


def main() -> None:
    """Collects into a folder that is removed afterwards, and prints the split."""
    options = parse_arguments(__doc__, repeats=2)
    config = CollectConfig()
    maker = EpisodeMaker(config)
    with tempfile.TemporaryDirectory() as folder:
        jobs = jobs_of(tasks_named('all'), options.repeats, options.seed, Path(folder))
        begun = time.process_time()
        spent = [maker.make(job) for job in jobs]
        total = time.process_time() - begun
    publish(
        'collect',
        'Collecting episodes',
        'python benchmark/collect.py',
        _body(spent, total, config, options.seed),
        options,
        f'MuJoCo {load_mujoco().__version__}, MUJOCO_GL {os.environ["MUJOCO_GL"]}',
    )


def _image_parts(config: CollectConfig, seed: int) -> str:
    """What an image is made of: the same one with nothing, the table alone, and everything."""
    mujoco = load_mujoco()
    robot = load_robot(bundled('robots', CollectConfig().robot, '--robot'))
    scene = draw_scene(
        task_named('collect_food'), scene_generator(seed), workcell_of(robot), config.randomization
    )
    model = mujoco.MjModel.from_xml_string(scene_xml(scene, robot))
    data, size = mujoco.MjData(model), config.randomization
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, size.height, size.width) as renderer:
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        renderer.update_scene(data, 'low')
        count = renderer.scene.ngeom
        # the table is the first geom of the world
        shown = {'nothing': 0, 'the table alone': 1, f'all {count} geoms': count}

        def render(number: int) -> None:
            renderer.scene.ngeom = number
            renderer.render()

        works = {name: partial(render, number) for name, number in shown.items()}
        found = measure(works, 50)
    rows = [(name, f'{median:.2f}') for name, (median, *_) in found.items()]
    return table(('an image of', 'CPU-ms'), rows)


def _body(spent: list[Spent], total: float, config: CollectConfig, seed: int) -> str:
    num, frames = len(spent), sum(item.num_frames for item in spent)
    size = config.randomization
    seconds = {
        name: float(sum(getattr(item, part) for item in spent)) for name, part in PARTS.items()
    }
    seconds['other'] = total - sum(seconds.values())
    rows = [
        (name, f'{value / num:.2f}', f'{100 * value / total:.0f} %')
        for name, value in {**seconds, 'all': total}.items()
    ]
    images = 4 * frames  # two views, RGB and masks, of the episodes that were kept
    return (
        f'{(__doc__ or "").strip().split(chr(10) * 2)[-1]}\n\n'
        f'{num} episodes of {frames / num:.0f} frames x 2 views at {size.width} x {size.height} '
        f'px, CPU seconds an episode:\n\n'
        f'{table(("part", "CPU-s an episode", "share"), rows)}\n\n'
        f'**{60 * num / total:.0f} episodes a minute a core** '
        f'({1e3 * seconds["rendering"] / images:.1f} ms of rendering an image or mask). Bound by '
        f'drawing: with no GPU an image costs by its triangles, less by its pixels (a scene of '
        f'collect_food, medians of 50).\n\n{_image_parts(config, seed)}'
    )


if __name__ == '__main__':
    main()
