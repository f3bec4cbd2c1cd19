"""Records of what must not change while code moves: plans, bags, results, weights, interfaces.

    python test/golden/record.py [--only plans,help] [--check [--part K/N]]

writes `test/golden/SECTION.json`, or with `--check` prints the differences from what is there and
exits with 1 where there are any. It uses the commands and looks modules up by their last name,
so that a moved module is found. One thread; seeds are fixed.

Texts, counts and stamps are equal on every machine; plans are, to a microradian. Pictures and
what is computed from them are not: processors and packages differ in the last bits of rendering,
JPEG and bfloat16. Of these the record has coarse pictures, means and deviations, and `TOLERANCES`
says how far they may be apart.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Callable, Iterator
import contextlib
import difflib
from functools import cache
from hashlib import sha256
from importlib import import_module
import json
import os
from pathlib import Path
import pkgutil
import re
import subprocess
import sys
import tempfile
import time
from types import ModuleType
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
HERE, PACKAGE = Path(__file__).resolve().parent, 'mtv_world_ros'
os.environ |= {
    'PYTHONPATH': str(ROOT),
    'OMP_NUM_THREADS': '1',
    'COLUMNS': '100',
    'ROS_DOMAIN_ID': str(1 + os.getpid() % 100),
    'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
}
sys.path.insert(0, str(ROOT))

#: seeds of plans; a robot of one arm, which has no faults of two
SEEDS, ONE_ARM = (0, 1), 'franka'
TASKS = 'place_bread_plate,shake_bottle'
#: of plans and kinds: from which policy on, and every which
PART = [1, 1]
#: numbers that are compared with a tolerance, by their keys: absolute, and relative to the record
TOLERANCES = (
    (re.compile(r'(replay|collect): .*joints'), (0.002, 0.0)),  # [rad or m]
    (re.compile(r'(replay|collect): .*images'), (0.02, 0.0)),  # 5 of 255 grey levels
    (re.compile(r'(replay|collect): .*masks'), (0.003, 0.0)),  # fraction of the pixels
    (re.compile(r'(replay|collect): .*success'), (0.03, 0.0)),  # probability
    (re.compile(r'(evaluate|rank): '), (0.03, 0.05)),
    (re.compile(r'train: '), (1e-5, 0.01)),
)
#: sections with such numbers
_APPROXIMATE = ('replay', 'collect', 'evaluate', 'rank', 'train')
#: folders with a file for each episode
_SINGLE = {'episodes', 'rollouts', 'seed_0'}
#: width and height of a coarse picture
_COARSE = (8, 6)
_NUMBER = re.compile(r'[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?')
#: keys of results that differ from run to run, and texts with a path or a time in them
_RUN_KEYS = re.compile(
    r'(^|_)(seconds|s|date|time|times|created|path|version|machine|host|commit)$'
    r'|memory|per_second|^seconds|an hour|^real_time_factor'
)
_RUN_TEXT = re.compile(r'\S*/golden_\S*')


def digest(data: bytes | str) -> str:
    """Return the SHA-256 of bytes or text."""
    return sha256(data.encode() if isinstance(data, str) else data).hexdigest()


@cache
def modules() -> dict[str, str]:
    """Return the full names of the package's modules by their last part."""
    package = import_module(PACKAGE)
    found = pkgutil.walk_packages(package.__path__, f'{PACKAGE}.', onerror=lambda _: None)
    names = [name for _, name, is_package in found if not is_package]
    return {name.rpartition('.')[2]: name for name in names if '__main__' not in name}


def module(*names: str) -> ModuleType:
    """Return the module whose last name is one of these."""
    return import_module(next(modules()[name] for name in names if name in modules()))


def command(*words: object) -> str:
    """Run `mtv-world`; return what it printed, and fail as it does."""
    code = f'import sys; from {PACKAGE}.cli import main; sys.exit(main())'
    line = [sys.executable, '-c', code, *map(str, words)]
    done = subprocess.run(line, capture_output=True, text=True, cwd=ROOT)
    if done.returncode:
        raise SystemExit(f'mtv-world {" ".join(map(str, words))}:\n{done.stderr[-3000:]}')
    return done.stdout


@cache
def folder() -> Path:
    """Return a folder for what the commands write; gone at the end."""
    kept = tempfile.TemporaryDirectory(prefix='golden_')
    folder.kept = kept  # type: ignore[attr-defined]
    return Path(kept.name)


@cache
def episodes() -> Path:
    """Return a folder of eight episodes, successes and failures, of two tasks."""
    out, policies = folder() / 'episodes', 'expert,expert-high-0.06'
    command('collect', '--task', TASKS, '--episodes', 4, '--policies', policies, '--seed', 3,
            '--workers', 1, '--out', out)  # fmt: skip
    return out


def lasting(value: Any) -> Any:
    """Return a result without seconds, dates and paths; numbers to nine digits."""
    if isinstance(value, dict):
        return {k: lasting(v) for k, v in value.items() if not _RUN_KEYS.search(k)}
    if isinstance(value, list):
        return [lasting(item) for item in value]
    if isinstance(value, float):
        return f'{value:.9g}'
    return _RUN_TEXT.sub('PATH', value) if isinstance(value, str) else value


def results(out: Path) -> dict[str, Any]:
    """Return a summary of the JSON files under a folder, without what differs from run to run.

    Files of single episodes are left out: their numbers are in those of the whole.
    """
    files = {path.relative_to(out): path for path in sorted(out.rglob('*.json'))}
    return {
        str(name): summary(lasting(json.loads(path.read_text())))
        for name, path in files.items()
        if not _SINGLE & {*name.parts}
    }


def summary(value: Any) -> dict[str, Any]:
    """Return the numbers of a result by key, lists as count, mean and deviation; texts by shape.

    Numbers inside of texts are left out: they are those of the results, rounded.
    """
    numbers, texts = defaultdict(list), defaultdict(set)

    def add(key: str, one: Any) -> None:
        if isinstance(one, dict):
            for name, inner in one.items():
                add(f'{key}.{name}' if key else name, inner)
        elif isinstance(one, list):
            for inner in one:
                add(f'{key}[]', inner)
        elif isinstance(one, (int, float)) and not isinstance(one, bool):
            numbers[key].append(float(one))
        else:
            texts[key].add(_NUMBER.sub('#', str(one)))

    add('', value)
    found: dict[str, Any] = {key: spread(values) for key, values in sorted(numbers.items())}
    words = {f'{key} (text)': digest('|'.join(sorted(t)))[:12] for key, t in texts.items()}
    return found | words


def spread(values: Any) -> list[float]:
    """Return count, mean and standard deviation of the finite numbers, to six digits."""
    import numpy as np

    kept = np.asarray(values, np.float64).ravel()
    kept = kept[np.isfinite(kept)]
    mean, deviation = (kept.mean(), kept.std()) if len(kept) else (0.0, 0.0)
    return [len(kept), float(f'{mean:.6g}'), float(f'{deviation:.6g}')]


def weights(out: Path) -> dict[str, Any]:
    """Return count, mean and deviation of the numbers in each tensor file of a checkpoint."""
    import numpy as np

    load = import_module('safetensors.torch').load_file
    found = {}
    for path in sorted(out.rglob('*.safetensors')):
        if 'state' not in str(path):
            tensors = [t.float().numpy().ravel() for t in load(path).values()]
            found[str(path.relative_to(out))] = spread(np.concatenate(tensors))
    return found


def plans() -> dict[str, Any]:
    """Every fault kind in its typical size, in all tasks; what is refused, by text."""
    robots, make = module('file'), module('scripted_policy').scripted_policy
    expert, load = module('expert').Expert, robots.load_robot
    tasks = sorted(path.stem for path in (ROOT / 'config' / 'tasks').glob('*.yaml'))
    two, one = (expert(load(robots.robot_path(name))) for name in ('yam_bimanual', ONE_ARM))
    found: dict[str, Any] = {}
    for name in _policies():
        whole = sha256()
        for task in tasks:
            for seed in SEEDS:
                whole.update(_plan(make, name, task, seed, two))
        alone = _plan(make, name, 'place_bread_plate', SEEDS[0], one)
        found[name] = {
            'two_arms': whole.hexdigest(),
            'one_arm': alone.decode() if alone.startswith(b'refused') else digest(alone),
        }
    return found


def kinds() -> dict[str, Any]:
    """Fault kinds in one scene, 23 drawn ones among them.

    Of each: seed, commands, mean and deviation of each joint, and a row.
    """
    import numpy as np

    robots, make = module('file'), module('scripted_policy').scripted_policy
    load = robots.load_robot
    expert = module('expert').Expert(load(robots.robot_path('yam_bimanual')))
    found: dict[str, Any] = {}
    recorded = json.loads((HERE / 'kinds.json').read_text())
    for name in [*_policies(), *(name for name in recorded if 'drawn' in name)]:
        for seed in range(4 if 'drawn' in name else 0, 12):
            plan = _plan(make, name, 'stack_blocks_two', seed, expert)
            if not plan.startswith(b'refused'):
                break
        at = np.frombuffer(plan, '<i8').reshape(-1, len(expert.home)) / 1e6
        rows = (at.mean(axis=0), at.std(axis=0), at[len(at) // 2])
        found[name] = [seed, len(at), *(row.round(5).tolist() for row in rows)]
    return found


def _plan(make: Callable[..., Any], name: str, task: str, seed: int, expert: Any) -> bytes:
    import numpy as np

    try:
        policy = make(name, task, seed, expert)
        policy.reset(seed=seed)
    except import_module(f'{PACKAGE}.core.errors').MtvWorldError as error:
        return f'refused: {error}'.encode()
    return np.rint(policy.plan.positions * 1e6).astype('<i8').tobytes()


def _policies() -> list[str]:
    """The policies of the recorded plans; where there are none, of every kind."""
    recorded = HERE / 'plans.json'
    if recorded.exists():
        return list(json.loads(recorded.read_text()))[PART[0] - 1 :: PART[1]]
    faults = module('faults', 'catalogue').FAULTS
    return ['expert', *(f'expert-{kind}-{fault.size.typical:g}' for kind, fault in faults.items())]


def helps() -> dict[str, list[str]]:
    """The help of every command."""
    whole = command('--help')
    names = import_module(f'{PACKAGE}.cli.commands').COMMANDS
    shown = {'': whole} | {name: command(*name.split(), '--help') for name in names}
    shown |= {n: command(*n.split(), '--help-all') for n in names if '--help-all' in shown[n]}
    return {name: text.split('\n') for name, text in shown.items()}


def schemas() -> dict[str, Any]:
    """The JSON schema of every schema, by its class's name."""
    for name in modules().values():
        with contextlib.suppress(Exception):  # an optional package is not installed
            import_module(name)
    found, todo = {}, [import_module(f'{PACKAGE}.core.config').Schema]
    while todo:
        kind = todo.pop()
        todo += kind.__subclasses__()
        with contextlib.suppress(Exception):  # types that JSON does not know
            found[f'{kind.__name__}'] = digest(json.dumps(kind.model_json_schema()))
    return dict(sorted(found.items()))


def node() -> dict[str, Any]:
    """Parameters, topics with their QoS, and services of the node."""
    from rcl_interfaces.srv import GetParameters, ListParameters
    import rclpy
    from rclpy.parameter import parameter_value_to_python

    line = [sys.executable, '-c', f'from {PACKAGE}.ros import run_world_model as r; r()']
    running = subprocess.Popen(line, cwd=ROOT)
    rclpy.init()
    asking = rclpy.create_node('asking')

    def answer(kind: Any, name: str, request: Any) -> Any:
        client = asking.create_client(kind, name)
        assert client.wait_for_service(300.0), f'the node does not offer {name}'
        future = client.call_async(request)
        rclpy.spin_until_future_complete(asking, future, timeout_sec=300.0)
        return future.result()

    try:
        listed = ListParameters.Request()
        names = answer(ListParameters, '/world_model/list_parameters', listed).result.names
        asked = GetParameters.Request(names=names)
        values = answer(GetParameters, '/world_model/get_parameters', asked).values
        time.sleep(20.0)  # it configures and activates itself
        by_node, qos = {}, {}
        for what in ('publisher', 'subscriber', 'service'):
            get = getattr(asking, f'get_{what}_names_and_types_by_node')
            by_node[what] = dict(sorted(get('world_model', '/')))
        for topic in by_node['publisher']:
            infos = asking.get_publishers_info_by_topic(topic)
            profiles = [i.qos_profile for i in infos if i.node_name == 'world_model']
            qos[topic] = [[p.reliability.name, p.durability.name] for p in profiles]
        parameters = dict(zip(names, map(parameter_value_to_python, values), strict=True))
        return {'parameters': parameters, **by_node, 'qos': qos}
    finally:
        asking.destroy_node()
        rclpy.shutdown()
        running.terminate()
        running.wait(30)


def replay() -> dict[str, Any]:
    """Contents of the demo episode's offline replay by topic: stamps, pictures, numbers, texts."""
    out, demo = folder() / 'replay', ROOT / 'resource' / 'demo_episode'
    command('replay', '--offline', demo, '--out', out, '--threads', 1)
    return contents(out)


def contents(bag: Path) -> dict[str, Any]:
    """Return what a bag shows: stamps exactly, levels of pictures [0..1] and numbers as spread."""
    shown = module('streams').read_streams([bag])
    found: dict[str, Any] = {}
    for name, streams in (('images', shown.images), ('masks', shown.masks)):
        for (kind, view), frames in sorted(streams.items()):
            found[f'{name} {kind} {view}'] = {
                'stamps': digest(str([stamp for stamp, _ in frames])),
                'shape': str(frames[0][1].shape),
                **{at: _levels(frames[k][1]) for at, k in (('first', 0), ('last', -1))},
            }
    for kind in sorted({one[0] for one in shown.joints}):
        rows = [positions for of, _, _, positions in shown.joints if of == kind]
        columns = zip(*rows, strict=True)
        found[f'joints {kind}'] = [spread(column) for column in columns]
    found['success'] = [float(f'{value:.4g}') for _, value in shown.success]
    words = [_NUMBER.sub('#', text) for _, text in shown.words if 'stage_s' not in text]
    return found | {'words': sorted(set(words))}


def _levels(frame: Any) -> list[float]:
    """Return the grey levels [0..1] of a coarse picture, or the area of each object in a mask."""
    import numpy as np

    if frame.ndim == 2:
        return [round(count / frame.size, 5) for count in np.bincount(frame.ravel())]
    small = module('images').resize_frames(frame[None], *_COARSE)
    return (small.mean(axis=-1).ravel() / 255).round(3).tolist()


def collect() -> dict[str, Any]:
    """Recordings of simulated episodes."""
    bags = sorted(path.parent for path in episodes().rglob('*.mcap'))
    return {bag.name: contents(bag) for bag in bags}


def evaluate() -> dict[str, Any]:
    """Scores of the bundled model on two episodes, and its calibration on all."""
    fixed = ('--workers', 1, '--threads', 1, '--steps', 1, '--split', 'all', '--out')
    more = {'evaluate': ('--no-report', '--episodes', 2), 'calibrate': ('--no-store',)}
    for name, options in more.items():
        out = folder() / 'results' / name
        command(name, 'bundled', episodes(), *options, *fixed, out)
    return results(folder() / 'results')


def rank() -> dict[str, Any]:
    """A ranking of three policies in two tasks."""
    out, policies = folder() / 'ranking', 'expert,expert-high-0.06,expert-stop-0.3'
    command('rank', '--policies', policies, '--tasks', TASKS, '--episodes', 2, '--out', out,
            '--workers', 1, '--threads', 1, '--steps', 1, '--no-clips')  # fmt: skip
    return results(out)


def train() -> dict[str, Any]:
    """Weights after twenty steps of `train`."""
    out = folder() / 'trained'
    command('train', episodes(), '--out', out / 'world', '--preset', 'small', '--threads', 1,
            '--split', 'all', '--set', 'optimizer.steps=20')  # fmt: skip
    return weights(out)


SECTIONS: dict[str, Callable[[], dict[str, Any]]] = {
    'help': helps, 'schemas': schemas, 'node': node, 'replay': replay, 'collect': collect,
    'evaluate': evaluate, 'rank': rank, 'train': train, 'plans': plans, 'kinds': kinds,
}  # fmt: skip


def _text(name: str, found: dict[str, Any]) -> str:
    if name == 'kinds':  # a line each
        return json.dumps(found).replace('], "', '],\n "') + '\n'
    text = json.dumps(found, indent=1, ensure_ascii=False) + '\n'
    if name not in _APPROXIMATE:
        return text
    return re.sub(r'\[[^\[\]{}"]*\]', lambda found: ' '.join(found[0].split()), text)


def differences(name: str, recorded: Any, now: Any) -> list[str]:
    """Return how a section differs from its record; some numbers may be off by a tolerance."""
    if name in _APPROXIMATE:
        return list(_apart(f'{name}: ', recorded, now))
    before, after = (_text(name, one).split('\n') for one in (recorded, now))
    return list(difflib.unified_diff(before, after, 'recorded', 'now', n=1))


def _apart(key: str, one: Any, other: Any) -> Iterator[str]:
    """Yield the keys at which two records differ by more than the tolerance."""
    if isinstance(one, dict) and isinstance(other, dict):
        for name in sorted({*one, *other}):
            if name in one and name in other:
                yield from _apart(f'{key}{name}. ', one[name], other[name])
            else:
                yield f'{key}{name}: {"recorded" if name in one else "now"} alone'
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for number, pair in enumerate(zip(one, other, strict=True)):
            yield from _apart(f'{key}{number}. ', *pair)
    elif not _is_close(key, one, other):
        yield f'{key}{one} recorded, {other} now'


def _is_close(key: str, one: Any, other: Any) -> bool:
    """Return whether two values are equal, or two numbers within the tolerance of their key."""
    if not (isinstance(one, int | float) and isinstance(other, int | float)):
        return one == other
    least, share = next((t for keys, t in TOLERANCES if keys.match(key)), (0.0, 0.0))
    are_none = one != one and other != other
    return are_none or one == other or abs(one - other) <= least + share * abs(one)


def main() -> int:
    """Record the sections, or prints how they differ from what is recorded."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--only', default=','.join(SECTIONS), metavar='SECTIONS')
    parser.add_argument('--check', action='store_true', help='print differences; write nothing')
    parser.add_argument(
        '--part',
        default='1/1',
        metavar='K/N',
        help='of plans and kinds: each Nth from the Kth on',
    )
    arguments, differs = parser.parse_args(), False
    PART[:] = map(int, arguments.part.split('/'))
    if PART != [1, 1] and not arguments.check:
        parser.error('--part is for --check')
    for name in arguments.only.split(','):
        path, found = HERE / f'{name}.json', SECTIONS[name]()
        if not arguments.check:
            path.write_text(_text(name, found))
            continue
        before = json.loads(path.read_text())
        if PART != [1, 1]:
            before = {key: value for key, value in before.items() if key in found}
        lines = differences(name, before, json.loads(_text(name, found)))
        differs |= bool(lines)
        print(f'{name}: {"differs" if lines else "equal"}', *lines, sep='\n')
    return int(differs)


if __name__ == '__main__':
    sys.exit(main())
