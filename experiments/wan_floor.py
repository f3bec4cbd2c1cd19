"""What is the least time that a Wan preset can take on a GPU, and what do we expect?

    python experiments/wan_floor.py --out experiments/results

No GPU is needed: every operation of a chunk is run on shapes alone, and its floating-point
operations and the bytes that it reads and writes are counted. The floor of a stage is what its
operations take at the card's peak, or what reading its weights and its inputs once and writing its
outputs once takes, whichever is longer. What is expected of plain and of compiled serving is the
sum over its operations: products, convolutions and attention at a share of the peak, and all
others, unfused, at a share of the memory's rate. These shares are guesses, written down before the
first run on a GPU; `experiments/gpu.py` measures the same stages.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field
import shlex
import sys
from typing import Any

from page import parse_arguments, publish, table
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry
from wan_bench import Bench

from mtv_world_ros.cli.train import set_overrides
from mtv_world_ros.model.serving import ServingOptions
from mtv_world_ros.training.dry_run import attention_operations, fill
from mtv_world_ros.training.training_config import load_training_config, TrainingConfig


@dataclass(frozen=True)
class Card:
    """Of a GPU's data sheet: dense bfloat16 operations a second, bytes of memory a second."""

    name: str
    flops: float
    bandwidth: float


#: NVIDIA's data sheets of the SXM modules
CARDS = (Card('H100', 989e12, 3.35e12), Card('H200', 989e12, 4.8e12))
#: guesses: share of the peak by kind of operation, served plainly; of attention by cuDNN
SHARES = {'product': 0.75, 'attention': 0.38, 'convolution': 0.40}
CUDNN_SHARE = 0.56
#: guesses: share of memory's rate; what compiling leaves of the bytes of unfused operations
MEMORY_SHARE, LEFT_BY_COMPILING = 0.8, 0.25
#: what `floor` and `expected` are called on the page, and the stage that is compiled
_TIMES, _STEP = ('floor', 'plain', 'compiled'), 'one step of the transformer'
_KINDS = {'attention': 'attention', 'convolution': 'convolution'}


@dataclass
class Count:
    """Operations by kind, and bytes that operations without any arithmetic of note move."""

    flop: dict[str, int] = field(default_factory=lambda: dict.fromkeys(SHARES, 0))
    other_bytes: int = 0
    least_bytes: int = 0

    @property
    def total(self) -> int:
        """All floating-point operations."""
        return sum(self.flop.values())

    def floor(self, card: Card) -> float:
        """The least time [s]."""
        return max(self.total / card.flops, self.least_bytes / card.bandwidth)

    def plain(self, card: Card) -> float:
        """The time [s] expected of plain serving."""
        return self._expected(card, SHARES, 1.0)

    def compiled(self, card: Card) -> float:
        """The time [s] expected with compiled blocks and cuDNN's attention."""
        return self._expected(card, {**SHARES, 'attention': CUDNN_SHARE}, LEFT_BY_COMPILING)

    def _expected(self, card: Card, shares: dict[str, float], left: float) -> float:
        busy = sum(n / (shares[kind] * card.flops) for kind, n in self.flop.items())
        return busy + left * self.other_bytes / (MEMORY_SHARE * card.bandwidth)

    def time(self, name: str, stage: str, card: Card) -> float:
        """One of these times of a stage; only the transformer is compiled."""
        return getattr(self, 'plain' if name == 'compiled' and stage != _STEP else name)(card)


class Counter(TorchDispatchMode):
    """Counts what operations do."""

    def __init__(self) -> None:
        super().__init__()
        self.count = Count()
        self._flop: dict[Any, Any] = {**flop_registry}
        for name, count in attention_operations().items():
            self._flop[name] = lambda *a, out_val=None, _count=count, **k: _count(
                *[x.shape if isinstance(x, Tensor) else x for x in a]
            )

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        packet = func._overloadpacket
        if packet in self._flop:
            kind = next((k for k in _KINDS if k in str(packet)), 'product')
            self.count.flop[kind] += self._flop[packet](*args, **(kwargs or {}), out_val=out)
        elif not func.is_view:
            self.count.other_bytes += num_bytes([args, kwargs, out])
        return out


def num_bytes(values: Any) -> int:
    """Bytes of the tensors among some values."""
    return sum(x.numel() * x.element_size() for x in tree_leaves(values) if isinstance(x, Tensor))


def counted(work: Callable[[], Any], weights: torch.nn.Module, given: Any) -> Count:
    """What a piece of work does; reads its weights and `given` once at least."""
    with Counter() as counter:
        out = work()
    held = num_bytes(list(weights.parameters()))
    counter.count.least_bytes = held + num_bytes([given, out])
    return counter.count


class Shapes(Bench):
    """The parts and inputs as shapes."""

    def _random(self, module: Any, device: torch.device) -> Any:
        fill(module, self.dtype)
        return module.eval().requires_grad_(False)


def stages(config: TrainingConfig, options: argparse.Namespace) -> tuple[dict[str, Count], int]:
    """Counts by stage, and tokens of a step."""
    tiny = ServingOptions(tiny_decoder='random', tiny_encoder=True)
    with FakeTensorMode(), torch.no_grad():
        bench = Shapes(config, options, ServingOptions())
        given = bench.encode()
        vae = bench.autoencoder
        found = {
            'encode': counted(bench.encode, vae, bench.frames),
            _STEP: counted(lambda: bench.step(given), bench.transformer, vars_of(given)),
            'decode': counted(lambda: bench.decode(given.control), vae, given.control),
        }
        if options.tiny:
            small = Shapes(config, options, tiny)
            found['encode, tiny'] = counted(small.encode, small.decoder, small.frames)
            found['decode, tiny'] = counted(
                lambda: small.decode(given.control), small.decoder, given.control
            )
    _, views, _, frames, height, width = given.control.shape
    before = 0 if given.history is None else given.history.shape[3]
    return found, views * (1 + before + frames) * (height // 2) * (width // 2)


def vars_of(given: Any) -> list[Any]:
    """The values of a dataclass with slots."""
    return [getattr(given, name) for name in given.__dataclass_fields__]


def page_of(preset: str, options: argparse.Namespace) -> str:
    """A preset's tables."""
    config = load_training_config(preset, set_overrides(options.set))
    found, tokens = stages(config, options)
    rows = []
    for stage, count in found.items():
        shares = [f'{100 * n / max(count.total, 1):.0f}' for n in count.flop.values()]
        moved = [f'{count.least_bytes / 1e9:.1f}', f'{count.other_bytes / 1e9:.1f}']
        times = [f'{1e3 * count.time(name, stage, card):.0f}' for card in CARDS for name in _TIMES]
        rows.append([stage, f'{count.total / 1e12:.1f}', ' / '.join(shares), *moved, *times])
    head = ['stage', 'TFLOP', '% ' + ' / '.join(SHARES), 'least GB', 'GB of the rest']
    head += [f'{card.name} {what} [ms]' for card in CARDS for what in _TIMES]
    video = config.video
    return (
        f'`{preset}`: {len(video.views)} views of 1 + {video.num_frames} frames, '
        f'{video.width}x{video.height}, {tokens} tokens, no guidance.\n\n'
        + table(head, rows)
        + '\n\n'
        + chunks(found, len(video.views) * video.num_frames, options)
    )


def chunks(found: dict[str, Count], view_frames: int, options: argparse.Namespace) -> str:
    """Whole chunks: encoding, steps, decoding, in turn."""
    rows = []
    for around in ('', ', tiny') if options.tiny else ('',):
        for steps in options.steps:
            cells = [f'{steps}, {"tiny" if around else "Wan"} autoencoder']
            for card in CARDS:
                for name in _TIMES:
                    parts = {k: count.time(name, k, card) for k, count in found.items()}
                    spent = parts['encode' + around] + parts['decode' + around]
                    spent += steps * parts[_STEP]
                    cells.append(f'{1e3 * spent:.0f} ({view_frames / spent:.0f})')
            rows.append(cells)
    head = ['steps']
    head += [f'{card.name} {what} [ms]' for card in CARDS for what in _TIMES]
    return 'A chunk (view-frames/s):\n\n' + table(head, rows)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add what other benchmarks do not have."""
    parser.add_argument('--preset', nargs='+', default=['wan-1.3b', 'wan-14b'])
    parser.add_argument('--set', nargs='*', default=[], metavar='SECTION.KEY=VALUE')
    parser.add_argument('--steps', type=int, nargs='+', default=[4, 16])
    parser.add_argument('--no-tiny', dest='tiny', action='store_false')
    parser.set_defaults(device='cpu', dtype='bfloat16')


def main() -> None:
    """Counts, and prints the page."""
    options = parse_arguments(__doc__, repeats=1, more=add_options)
    shares = ', '.join(f'{name} {share:.2f}' for name, share in SHARES.items())
    cards = '; '.join(
        f'{c.name} {c.flops / 1e12:.0f} TFLOP/s, {c.bandwidth / 1e12:.2f} TB/s' for c in CARDS
    )
    told = (
        f'Cards: {cards}. Guessed: shares of the peak {shares}, attention by cuDNN '
        f'{CUDNN_SHARE:.2f}; of memory {MEMORY_SHARE:.2f}; compiling leaves '
        f'{LEFT_BY_COMPILING:.2f} of the bytes of unfused operations. "compiled" is '
        '`compile=true attention=_native_cudnn`.'
    )
    body = '\n\n'.join([told, *(page_of(preset, options) for preset in options.preset)])
    command = shlex.join(['python', *sys.argv])
    publish('wan_floor', 'Floor of the Wan presets', command, body, options, torch.__version__)


if __name__ == '__main__':
    main()
