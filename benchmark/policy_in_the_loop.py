"""What does a loop of policy and world model take, and does anything get lost on the way?

    python benchmark/policy_in_the_loop.py --data /path/to/episodes [--repeats 20] [--chunks 5]
        [--steps 4] [--seed 0] [--out benchmark/results]

`--repeats` imagined episodes of `--chunks` chunks by the scripted expert, over real topics between
real processes, recorded in a bag each. From the bags: gaps in the stamps, frames that are missing,
time per loop. Decoding is timed in this process, on one chunk, and taken off the model's time.
The simulator's episodes have the same policy, length and frame rate; one is timed before the
imagined ones and one after, so that a machine that gets slower or faster meets both kinds.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
import tempfile
from threading import Event, Thread
import time
from typing import Any

import numpy as np
from page import parse_arguments, publish, table

from mtv_world_ros.assembly import assemble_policy, load_pipeline
from mtv_world_ros.bench.expert.expert import home_positions
from mtv_world_ros.bench.ranking.worlds import run_policy, SimulatedWorld
from mtv_world_ros.bench.world.simulator import SimEpisode
from mtv_world_ros.data.bag.messages import deserialize, header_stamp
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.episode_reader import read_info
from mtv_world_ros.data.splits import select
from mtv_world_ros.data_types import WorldModelSpec
from mtv_world_ros.launching.imagination import imagine_episodes, ImagineOptions
from mtv_world_ros.model import world_model as model_module
from mtv_world_ros.pipeline import Pipeline
from mtv_world_ros.policies.policy import EpisodeOrigin

#: the expert's plans are shorter than the episodes: it holds still at their end
POLICY = 'kind: scripted\nvariant: expert\nhold_s: 60.0\n'
NODES = ('world_model', 'policy', 'runner', 'recorder')
MODULES = {
    'ros.world_model.node': 'world_model',
    'ros.policy.node': 'policy',
    'ros.episodes.episode_runner': 'runner',
    'ros.episodes.episode_recorder': 'recorder',
}


class MemoryWatch(Thread):
    """Samples the resident memory of the nodes, by name: (time since begin [s], MiB)."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.samples: dict[str, list[tuple[float, float]]] = {name: [] for name in NODES}
        self.ended = Event()
        self._begin_s = time.monotonic()

    def run(self) -> None:
        """Until `ended` is set."""
        while not self.ended.wait(1.0):
            for command in Path('/proc').glob('[0-9]*/cmdline'):
                self._sample(command)

    def _sample(self, command: Path) -> None:
        try:
            words = command.read_bytes().decode(errors='replace').split('\0')
            pages = int((command.parent / 'statm').read_text().split()[1])
        except OSError:
            return
        name = next((n for m, n in MODULES.items() if f'mtv_world_ros.{m}' in words), None)
        if name is not None:
            spent = time.monotonic() - self._begin_s
            self.samples[name].append((spent, pages * 4096 / 2**20))


def main() -> None:
    """Runs the episodes, reads their bags and prints the page."""
    options = parse_arguments(__doc__, repeats=20, more=_add_options)
    episodes = tuple(select(options.data, 'all', options.repeats).paths)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / 'policy.yaml').write_text(POLICY)
        chosen = ImagineOptions(
            policy=str(folder / 'policy.yaml'),
            episodes=episodes,
            count=options.repeats,
            max_chunks=options.chunks,
            num_inference_steps=options.steps,
            num_threads=1,
            seed=options.seed,
        )
        pipeline = load_pipeline(num_threads=1)
        simulated_s = [_simulated_s(pipeline, episodes[0], options)]
        watch = MemoryWatch()
        watch.start()
        begin_s = time.monotonic()
        results = imagine_episodes(chosen, folder / 'out')
        run_s = time.monotonic() - begin_s
        watch.ended.set()
        simulated_s.append(_simulated_s(pipeline, episodes[-1], options))
        bags = [Path(str(result['bag'])) for result in results]
        checked = [_check(bag, options.chunks, pipeline.spec) for bag in bags]
    decode_s, model_s = _decoding(pipeline, episodes[0], options.steps)
    loops = [loop for episode in checked for loop in episode['loops']]
    body = '\n\n'.join(
        [
            _soundness(results, checked, options.chunks),
            _times(loops, decode_s / model_s),
            _memory(watch),
            _speed(results, float(np.mean(simulated_s)), run_s),
        ]
    )
    command = (
        f'python benchmark/policy_in_the_loop.py --repeats {options.repeats} '
        f'--chunks {options.chunks} --steps {options.steps}'
    )
    publish('policy_in_the_loop', 'A policy in the loop', command, body, options, 'cpu, 1 thread')


def _add_options(parser: Any) -> None:
    parser.add_argument('--data', type=Path, required=True, help='folder of recorded episodes')
    parser.add_argument('--chunks', type=int, default=5)
    parser.add_argument('--steps', type=int, default=4, help='denoising steps')


def _check(bag: Path, num_chunks: int, spec: WorldModelSpec) -> dict[str, Any]:
    """What a bag says: missing frames, gaps, and the times of every loop."""
    reader = BagReader(bag)
    stamps: dict[str, list[int]] = {}
    loops: list[dict[str, float]] = []
    for message in reader.messages():
        decoded = deserialize(message.msgtype, message.data)
        if message.topic == '/policy/report':
            values = {p.key: p.value for status in decoded.status for p in status.values}
            if values['state'] == 'chunk':
                loops.append(
                    {k: float(v) for k, v in values.items() if k.endswith('_s') or '_s.' in k}
                )
        elif '/predicted/' in message.topic or message.topic == '/start/joint_states':
            stamps.setdefault(message.topic, []).append(header_stamp(decoded))
    start = stamps.pop('/start/joint_states')[-1]
    expected = start + np.arange(1, num_chunks * spec.num_frames + 1) * round(1e9 / spec.fps)
    return {
        'whole': not reader.truncated and not reader.problems,
        'streams': len(stamps),
        'frames': sum(len(found) for found in stamps.values()),
        'missing': sum(len(set(expected.tolist()) - set(found)) for found in stamps.values()),
        'off': sum(len(set(found) - set(expected.tolist())) for found in stamps.values()),
        'doubled': sum(len(found) - len(set(found)) for found in stamps.values()),
        'loops': loops,
    }


def _soundness(results: Any, checked: Any, num_chunks: int) -> str:
    ends = Counter(
        ': '.join(filter(None, (str(result['how']), str(result.get('text', '')))))
        for result in results
    )
    wanted = len(results) * num_chunks
    total = {key: sum(c[key] for c in checked) for key in ('frames', 'missing', 'off', 'doubled')}
    rows = [
        ('episodes, how they ended', '; '.join(f'{count} {how}' for how, count in ends.items())),
        ('chunks done of those wanted', f'{sum(len(c["loops"]) for c in checked)} of {wanted}'),
        ('messages recorded over the predicted streams', str(total['frames'])),
        ('stamps missing / not on the clock / twice',
         f'{total["missing"]} / {total["off"]} / {total["doubled"]}'),
        ('bags that open whole', f'{sum(c["whole"] for c in checked)} of {len(checked)}'),
    ]  # fmt: skip
    return table(('what', 'found'), rows)


def _times(loops: list[dict[str, float]], decode_share: float) -> str:
    """Median and 95th percentile of what a loop is made of [s]."""

    def stage(loop: dict[str, float], *names: str) -> float:
        return sum(loop.get(f'stage_s.{name}', 0.0) for name in names)

    parts: dict[str, list[float]] = {}
    for loop in loops:
        model = stage(loop, 'model')
        known = {
            'policy': loop['policy_s'],
            'model without decoding': model * (1 - decode_share),
            'decoding': model * decode_share,
            'segmentation': stage(loop, 'start_masks', 'masks'),
            'trajectory video': stage(loop, 'trajectory_video'),
            'success estimate': stage(loop, 'success'),
        }
        known['transport'] = loop['loop_s'] - sum(known.values())
        for name, value in {**known, 'loop': loop['loop_s']}.items():
            parts.setdefault(name, []).append(value)
    whole = sum(parts['loop'])
    rows = [
        (name, f'{np.median(v):.4f}', f'{np.percentile(v, 95):.4f}', f'{100 * sum(v) / whole:.1f}')
        for name, v in parts.items()
    ]
    note = 'Transport: publishing, middleware, callbacks and waiting, both ways.'
    return table(('part of a loop', 'median [s]', 'p95 [s]', 'share [%]'), rows) + '\n\n' + note


def _memory(watch: MemoryWatch) -> str:
    """Resident memory in the second and in the last fifth of the time with episodes."""
    rows = []
    begin_s = watch.samples['recorder'][0][0]  # it is started last
    length_s = watch.samples['recorder'][-1][0] - begin_s
    for name, samples in watch.samples.items():
        spans = [
            (begin_s + a * length_s, begin_s + b * length_s) for a, b in ((0.2, 0.4), (0.8, 1))
        ]
        means = [[m for t, m in samples if low <= t <= high] for low, high in spans]
        if all(means):
            early, late = (float(np.median(m)) for m in means)
            rows.append((name, f'{early:.1f}', f'{late:.1f}', f'{late - early:+.1f}'))
    return table(('process', 'MiB at 20-40 % of the episodes', 'at 80-100 %', 'growth'), rows)


def _decoding(pipeline: Pipeline, episode: Path, steps: int) -> tuple[float, float]:
    """Seconds of decoding, and of the model altogether, for one chunk; medians of three."""
    from mtv_world_ros.data.recording import load_recording

    recording = load_recording(episode, pipeline.spec, pipeline.robot)
    spec, spent = pipeline.spec, []
    decode = model_module.decode_frames

    def timed(*arguments: Any) -> Any:
        begun = time.perf_counter()
        try:
            return decode(*arguments)
        finally:
            spent.append(time.perf_counter() - begun)

    model_module.decode_frames = timed
    positions = np.repeat(recording.positions[:1], spec.num_frames + 1, axis=0)
    control = np.repeat(recording.frames[:, :1], spec.num_frames + 1, axis=1)
    whole = []
    for _ in range(3):
        begun = time.perf_counter()
        pipeline.world_model.predict(
            recording.frames[:, 0], control, positions=positions, seed=0,
            num_inference_steps=steps, should_stop=lambda: False,
        )  # fmt: skip
        whole.append(time.perf_counter() - begun)
    model_module.decode_frames = decode
    return float(np.median(spent)), float(np.median(whole))


def _simulated_s(pipeline: Pipeline, path: Path, options: Any) -> float:
    """Seconds of an episode of the same policy and length in the simulator."""
    spec, robot = pipeline.spec, pipeline.robot
    sim = SimEpisode(robot, home_positions(robot))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / 'policy.yaml'
        file.write_text(POLICY)
        make = assemble_policy(file, robot)
    info = read_info(path)
    policy = make(EpisodeOrigin(task=info.task, scene_seed=int(info.seed or 0)))
    policy.reset(seed=options.seed)
    begun = time.perf_counter()
    world = SimulatedWorld(sim, spec.fps, int(info.seed or 0), info.task)
    chunk_s = spec.num_frames / spec.fps
    run_policy(policy, world, world.instruction, chunk_s=chunk_s, max_chunks=options.chunks)
    seconds = time.perf_counter() - begun
    sim.close()
    return seconds


def _speed(results: Any, simulated_s: float, run_s: float) -> str:
    episode_s = float(np.median([float(result['total_s']) for result in results]))
    rows = [
        ('imagined, with record, reset and start', f'{episode_s:.1f}', f'{3600 / episode_s:.0f}'),
        ('simulated, this process', f'{simulated_s:.1f}', f'{3600 / simulated_s:.0f}'),
    ]
    note = f'The whole run took {run_s:.0f} s, with starting and ending the processes.'
    return table(('episodes', 'seconds each', 'an hour'), rows) + '\n\n' + note


if __name__ == '__main__':
    main()
