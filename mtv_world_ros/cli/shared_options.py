"""Options that several commands share; the pipeline; provenance of results."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from importlib import metadata
import os
from pathlib import Path
import platform
import shlex
from typing import Any, TYPE_CHECKING

from mtv_world_ros.cli import bundled_help
from mtv_world_ros.viewing.viewer_process import PageAddress

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import CommandParser
    from mtv_world_ros.core.workers import Workers
    from mtv_world_ros.model.checkpoint import Checkpoint
    from mtv_world_ros.rollout.pipeline import Pipeline

#: options that are arguments of `Pipeline.load`
_CHOICES = (
    'robot',
    'task',
    'device',
    'dtype',
    'segmenter',
    'serving',
    'adapter',
    'foresight',
    'camera_check',
)


def names(text: str) -> tuple[str, ...]:
    """Return the names of a comma-separated list, as an option's type."""
    return tuple(name.strip() for name in text.split(',') if name.strip())


def number_or_0(text: str) -> int:
    """Return a whole number, 0 for the default, as an option's type."""
    number = int(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f'{number}; it must be 1 or more, or 0')
    return number


def _count(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f'{number}; it must be 1 or more')
    return number


#: options by the word that `add_options` knows them by, with the group (`model`, `advanced`) that
#: `--help` shows them in; a help text that names what is bundled is
#: a function, as its folder is read when a parser is made
_OPTIONS: dict[str, dict[str, dict[str, Any]]] = {
    'robot': {
        '--robot': {
            'group': 'model',
            'help': lambda: f'{bundled_help.robots()}; default: that of the checkpoint',
        },
    },
    'device': {
        '--device': {
            'group': 'model',
            'default': 'cpu',
            'help': 'PyTorch device, e.g. cpu (default) or cuda',
        },
    },
    'threads': {
        '--threads': {
            'group': 'advanced',
            'type': number_or_0,
            'default': 0,
            'help': 'CPU threads; 0 = all cores but one (of two cores: both)',
        },
    },
    'foresight': {
        '--no-foresight': {
            'group': 'model',
            'dest': 'foresight',
            'action': 'store_false',
            'help': 'simulate no object motion: the imagined frames alone decide. For the '
            "paper's method use it with --checkpoint bundled-paper",
        },
        '--no-camera-check': {
            'group': 'advanced',
            'dest': 'camera_check',
            'action': 'store_false',
            'help': "skip the comparison of the first frames with the arm's outline, and the "
            'correction of the cameras',
        },
    },
    'steps': {
        '--steps': {
            'group': 'advanced',
            'type': number_or_0,
            'default': 0,
            'help': 'denoising steps; 0 = as many as the checkpoint says',
        },
    },
    'seed': {
        '--seed': {
            'group': 'model',
            'type': int,
            'default': 0,
            'help': 'seed of the noise (default: 0)',
        },
    },
    'serving': {
        '--serving': {
            'group': 'advanced',
            'default': '',
            'metavar': '"NAME=VALUE ..."',
            'help': 'options that make the model faster or smaller, e.g. "compile=true"',
        },
        '--adapter': {
            'group': 'advanced',
            'type': Path,
            'help': "LoRA folder or file, instead of the checkpoint's own",
        },
    },
    'task': {
        '--task': {
            'help': 'task to judge: a name, or a YAML file; default: the one each instruction '
            'matches'
        }
    },
    'source': {
        '--topics': {
            'type': Path,
            'metavar': 'FILE',
            'help': "mapping of a robot's own bags (see config/datasets/bag.yaml); default: the "
            'names of this package',
        },
        '--calibration': {
            'type': Path,
            'metavar': 'FILE',
            'help': 'calibration of the cameras; default: calibration.yaml in the folder of each '
            "bag, or the bag's TF",
        },
    },
    'seeds': {
        '--seeds': {
            'group': 'model',
            'type': _count,
            'default': 1,
            'help': 'rollouts of each episode with different noise, for the success estimate',
        }
    },
    'segmenter': {
        '--segmenter': {
            'group': 'model',
            'default': 'auto',
            'help': lambda: (
                f'finds objects: {bundled_help.segmenters()}, module:Class of your own, or the '
                'objects.safetensors of an import with --objects; auto = sam2 where '
                'MTV_WORLD_WEIGHTS has it, else colour'
            ),
        }
    },
    'describer': {
        '--describer': {
            'group': 'advanced',
            'type': Path,
            'metavar': 'YAML',
            'help': 'file of what names the objects (see config/describer.yaml); default: the '
            'names stored with the episode, else the colour words of its instruction',
        }
    },
    'workers': {
        '--workers': {
            'type': int,
            'default': 1,
            'help': 'number of processes that share the work; with --ray, of workers over all '
            'machines',
        },
        '--ray': {
            'group': 'advanced',
            'nargs': '?',
            'const': '',
            'metavar': 'ADDRESS',
            'help': 'run on a Ray cluster; default address: RAY_ADDRESS, else a new cluster on '
            'this machine. DIR has to be on a file system that all machines share',
        },
        '--gpus-per-worker': {
            'group': 'advanced',
            'type': float,
            'metavar': 'N',
            'help': 'GPUs that Ray reserves for a worker, e.g. 0.5; default: 1 with --device '
            'cuda, else 0',
        },
        '--cpus-per-worker': {
            'group': 'advanced',
            'type': int,
            'metavar': 'N',
            'help': 'CPU cores that Ray reserves for a worker, and its threads; default: 1',
        },
    },
    'checkpoint': {
        '--checkpoint': {
            'group': 'model',
            'default': 'bundled',
            'help': "folder of the model, 'bundled' (default) or 'bundled-paper'",
        }
    },
    'overwrite': {
        '--overwrite': {'action': 'store_true', 'help': 'replace what an earlier run wrote'}
    },
    'dtype': {'--dtype': {'default': 'auto', 'help': 'number format: auto, float32 or bfloat16'}},
}

#: the options of a command that runs a model
_MODEL = 'robot device threads foresight steps seed'


def add_options(parser: CommandParser, words: str) -> None:
    """Add options that several commands share, e.g. those of `overwrite model task`.

    Options of the group `model` stand under its heading where the words have `model`.
    """
    adds: dict[str, Callable[..., object]] = {'advanced': parser.add_advanced}
    if 'model' in words.split():
        adds['model'] = parser.model.add_argument
    for word in words.replace('model', _MODEL).split():
        for flag, how in _OPTIONS[word].items():
            text, group = how['help'], how.get('group', '')
            rest = {name: value for name, value in how.items() if name != 'group'}
            rest['help'] = text() if callable(text) else text
            adds.get(group, parser.add_argument)(flag, **rest)


def add_watch(parser: CommandParser, what: str) -> None:
    """Add `--watch`.

    Args:
        parser: parser of the command.
        what: words of the help: what the viewer shows.
    """
    parser.add_argument(
        '--watch',
        type=Watch.parse,
        nargs='?',
        const=Watch(),
        metavar='[ADDRESS:]PORT|FILE.rrd',
        help=f'show {what} in the Rerun viewer while it runs: in a browser on this machine '
        f'(default: port {Watch().address}; the data take the one above it), to others with an '
        'address, e.g. 0.0.0.0:9090, or as a file for mtv-world view',
    )


def watch_arguments(arguments: argparse.Namespace, continued: str = '') -> tuple[str, ...] | None:
    """Return the viewer's arguments for `--watch`; None = nobody watches.

    Args:
        arguments: options of the command.
        continued: name of the recording that the command continues; a file of it is replaced.

    Raises:
        ConfigError: the viewer is not installed, its port is taken, or its file exists.
    """
    watch: Watch | None = arguments.watch
    if watch is None:
        return None
    from mtv_world_ros.core.files import check_free
    from mtv_world_ros.viewing.rerun_log import check_installed, is_recording
    from mtv_world_ros.viewing.viewer_process import check_ports

    check_installed()
    if watch.file is None:
        check_ports(watch.address, '--watch PORT')
        return '--port', str(watch.address)
    is_own = bool(continued) and is_recording(watch.file, continued)
    check_free(watch.file, arguments.overwrite or is_own, '--watch FILE.rrd')
    return '--save', str(watch.file)


@dataclass(frozen=True, slots=True)
class Watch:
    """Target of a live view.

    Attributes:
        address: address of the page for browsers.
        file: path of a recording that is written in place of a page; None = a page is served.
    """

    address: PageAddress = PageAddress()
    file: Path | None = None

    @classmethod
    def parse(cls, text: str) -> Watch:
        """Return the value of `--watch`."""
        if text.endswith('.rrd'):
            return cls(file=Path(text))
        try:
            return cls(address=PageAddress.parse(text))
        except argparse.ArgumentTypeError as error:
            raise argparse.ArgumentTypeError(f'{error}; or a file that ends in .rrd') from error


def workers_of(
    arguments: argparse.Namespace, *reads: Path | str | None, writes: Path | None = None
) -> Workers:
    """Return the workers that `--workers`, `--ray` and the resources of each ask for.

    Args:
        arguments: options of the command.
        reads: files and folders that jobs read; names that are no path here are left out.
        writes: folder that jobs write to; None = results come back to this process.

    Raises:
        ConfigError: resources of Ray without Ray, or less than none.
    """
    from mtv_world_ros.core.errors import ConfigError
    from mtv_world_ros.core.workers import Workers

    for name in ('gpus', 'cpus'):
        value = getattr(arguments, f'{name}_per_worker')
        if value is not None and arguments.ray is None:
            raise ConfigError(f'--{name}-per-worker {value:g} is for --ray; leave it out')
        if value is not None and value < 0:
            raise ConfigError(f'--{name}-per-worker is {value:g}; it must be 0 or more')
    gpus, cpus = arguments.gpus_per_worker, arguments.cpus_per_worker
    is_on_gpu = getattr(arguments, 'device', 'cpu') != 'cpu'
    return Workers(
        count=arguments.workers,
        threads=getattr(arguments, 'threads', 0),
        ray=arguments.ray,
        cpus=1 if cpus is None else cpus,
        gpus=float(is_on_gpu) if gpus is None else gpus,
        reads=tuple(Path(one) for one in reads if one is not None and Path(one).exists()),
        writes=writes,
    )


def device_here(arguments: argparse.Namespace) -> str:
    """Return the device of this process: with `--ray` others use the GPU."""
    return 'cpu' if arguments.ray is not None else arguments.device


def pipeline_of(arguments: argparse.Namespace) -> Pipeline:
    """Return the pipeline of a command's checkpoint, which was opened, and model options."""
    from mtv_world_ros.rollout.pipeline import Pipeline

    return Pipeline.load(
        arguments.checkpoint, num_threads=arguments.threads, **pipeline_choices(arguments)
    )


def open_checkpoints(device: str, *names: str) -> list[Checkpoint]:
    """Open the checkpoints that a command names, and check the device, before the slow imports.

    Raises:
        CheckpointError: a folder is no checkpoint.
        ConfigError: this machine has no such device.
    """
    from mtv_world_ros.model.checkpoint import Checkpoint

    opened = [Checkpoint.open(name) for name in names]
    if device != 'cpu':
        from mtv_world_ros.model.runtime import check_device

        check_device(device)
    return opened


def refuse_for(
    checkpoint: Checkpoint, episodes: Sequence[Path], arguments: argparse.Namespace
) -> None:
    """Refuse episodes none of which has the views and the robot of a checkpoint.

    Args:
        checkpoint: checkpoint that is to imagine them.
        episodes: folders of the episodes.
        arguments: options of the command, such as `robot` and `topics`.

    Raises:
        CheckpointError: `--robot` names another robot than the checkpoint's.
        EpisodeError: none can be used.
    """
    from mtv_world_ros.data.bag_mapping import load_source
    from mtv_world_ros.data.unusable import refuse_unusable

    mapping = load_source(getattr(arguments, 'topics', None), None).mapping
    robot = checkpoint.load_robot(arguments.robot)
    refuse_unusable(
        episodes,
        checkpoint.spec.views,
        robot,
        mapping=mapping,
        remedy=f"a checkpoint of that robot ('{checkpoint}' is of '{robot.name}')",
    )


def pipeline_choices(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the options of a pipeline except checkpoint and threads."""
    given = vars(arguments)
    return {name: given[name] for name in _CHOICES if name in given}


def provenance(arguments: argparse.Namespace) -> dict[str, str]:
    """Return the provenance of a result (command, date, machine, versions), by heading."""
    return {
        'command': shlex.join(['mtv-world', *arguments.command_line]),
        'date': datetime.now().astimezone().isoformat(timespec='seconds'),
        'machine': machine(),
        'versions': ', '.join(
            f'{name} {metadata.version(name)}' for name in ('mtv_world_ros', 'torch', 'numpy')
        ),
    }


def machine() -> str:
    """Return processor, number of cores, operating system."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path('/proc/cpuinfo')
    if cpuinfo.is_file():
        names = [row for row in cpuinfo.read_text().splitlines() if row.startswith('model name')]
        model = names[0].split(':', 1)[1].strip() if names else model
    return f'{model}, {os.cpu_count()} cores, {platform.system()} {platform.machine()}'
