r"""How fast is a Wan preset on this machine, and how much of the machine does it use?

    python experiments/wan_speed.py --preset wan-1.3b --device cuda --out experiments/results \
        --serving compile=true

Random weights: speed does not depend on them. A chunk is all views of the preset; umT5 and CLIP
tokens are at hand, as in serving. The stock pipeline is diffusers' `WanImageToVideoPipeline` on
the same transformer blocks and autoencoder, all views side by side in one image; it has no control
video, no reference tokens and no history, so it has a little less to do. Aims on an H200: 60 % of
the matrix rate, 120 view-frames/s at 4 steps, 3 times the stock pipeline.

On a CPU, to see that it works: --device cpu --steps 1 --repeats 1 --set transformer.num_layers=1
video.num_frames=4 video.width=32 video.height=32 autoencoder.base_dim=16
--compare offload=true
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
import shlex
import statistics
import sys

from page import in_turns, publish, table
import torch
from torch.utils.flop_counter import FlopCounterMode
from wan_bench import Bench

from mtv_world_ros.cli.train import set_overrides
from mtv_world_ros.model.conditioning import Conditioning
from mtv_world_ros.model.serving import ServingOptions
from mtv_world_ros.training.training_config import load_training_config, TrainingConfig

_COMPARED = (
    'compile=true',
    'attention=_native_cudnn',
    'compile=true tiny_decoder=random',
    'compile=true tiny_decoder=random tiny_encoder=true',
    'offload=true',
)


def main() -> None:
    """Measure, and print the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--preset', default='wan-1.3b')
    parser.add_argument('--set', nargs='*', default=[], metavar='SECTION.KEY=VALUE')
    parser.add_argument('--device', default='cuda')
    parser.add_argument('--dtype', default='bfloat16', choices=('bfloat16', 'float32'))
    parser.add_argument('--steps', type=int, nargs='+', default=[4, 8, 50])
    parser.add_argument(
        '--serving', default='', help="of the first tables, as the node's parameter `serving`"
    )
    parser.add_argument(
        '--compare',
        nargs='*',
        default=_COMPARED,
        metavar='SERVING',
        help='a row for each; tiny_decoder takes any value, its weights are random',
    )
    parser.add_argument('--repeats', type=int, default=3)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--machine', default='')
    parser.add_argument('--out', type=Path, help='folder to write the page into')
    options = parser.parse_args()
    options.machine = options.machine or _device_name(options.device).replace(' ', '_')
    config = load_training_config(options.preset, set_overrides(options.set))
    with torch.inference_mode():
        body = measure(config, options)
    publish(
        options.preset.replace('-', '_').replace('.', '_'),
        f'Speed of {options.preset}',
        f'python experiments/wan_speed.py {shlex.join(sys.argv[1:])}',
        body,
        options,
        f'{_device_name(options.device)}, torch {torch.__version__}',
    )


def measure(config: TrainingConfig, options: argparse.Namespace) -> str:
    """The page's tables."""
    plain = Bench(config, options, ServingOptions())
    given = plain.encode()
    with FlopCounterMode(display=False) as counter:
        plain.step(given)
    products = Products(plain)
    matrix = products.flop / seconds(plain, products)
    work = Work(
        flop=counter.get_total_flops(),
        products=products,
        view_frames=len(config.video.views) * config.video.num_frames,
    )
    parameters = sum(p.numel() for p in plain.transformer.parameters())
    video = config.video
    chunk = _told(
        f'A chunk: {len(video.views)} views of 1 + {video.num_frames} frames, '
        f'{video.width}x{video.height}, {_tokens(given)} tokens; '
        f'{parameters / 1e6:.1f} M parameters, {options.dtype}, no guidance. A step is '
        f'{work.flop / 1e12:.3f} TFLOP; a large {options.dtype} matrix product reaches '
        f'{matrix / 1e12:.2f} TFLOP/s here.'
    )
    tables = [chunk, *_served(config, options, work, plain)]
    if options.compare:
        tables += ['All options, each in turns with plain:', _compared(config, work, plain)]
    plain.close()
    return '\n\n'.join(tables)


def _told(text: str) -> str:
    """The text, said at once: what follows may not end in the time that there is."""
    print(text, file=sys.stderr, flush=True)
    return text


def _reason(error: Exception) -> str:
    told = (str(error).splitlines() or [''])[0].replace('|', '/')
    return f'{type(error).__name__}: {told}'


@dataclass(frozen=True)
class Work:
    """Of a chunk: operations of a step, products to compare them with, frames of all views."""

    flop: int
    products: Products
    view_frames: int

    def share(self, step: float, products: float) -> str:
        """What a step makes of the machine, by its time [s] and that of the products in turn."""
        rate, most = self.flop / step, self.products.flop / products
        return f'{rate / 1e12:.2f} TFLOP/s, {100 * rate / most:.0f} %'


def _served(
    config: TrainingConfig, options: argparse.Namespace, work: Work, plain: Bench
) -> list[str]:
    """Stages and totals under `--serving`, in turns with the stock pipeline."""
    head = f'Served with `{options.serving}`:' if options.serving else 'Served plainly:'
    try:
        bench = Bench(config, options, ServingOptions.parse(options.serving))
        try:
            return [_told(text) for text in (head, *_whole(bench, work, plain))]
        finally:
            bench.close()
    except Exception as error:  # the other options are measured nevertheless
        return [_told(f'{head} {_reason(error)}')]


def _whole(bench: Bench, work: Work, plain: Bench) -> list[str]:
    given = bench.encode()
    step, products = medians(bench, lambda: bench.step(given), work.products)
    rows = [
        ['encode (start images, trajectory videos, history)', _ms(seconds(bench, bench.encode))],
        ['one step of the transformer', _ms(step)],
        ['decode', _ms(seconds(bench, lambda: bench.decode(given.control)))],
    ]
    memory = _memory(bench.device)
    stock, totals = plain.stock(), []
    for steps in bench.options.steps:
        ours, theirs = medians(bench, lambda n=steps: bench.chunk(n), lambda n=steps: stock(n))
        rate = f'{work.view_frames / ours:.1f}'
        totals.append([str(steps), _ms(ours), rate, _ms(theirs), f'{theirs / ours:.2f}'])
    header = ['steps', 'chunk [ms]', 'view-frames/s', 'stock pipeline [ms]', 'ratio']
    told = (
        f'The transformer: {work.share(step, products)} of the matrix product in turns with it. '
        f'Most memory held: {memory}.'
    )
    return [table(['stage', 'median [ms]'], rows), told, table(header, totals)]


def _compared(config: TrainingConfig, work: Work, plain: Bench) -> str:
    options, rows = plain.options, []
    for text in ['', *options.compare]:
        try:
            rows.append([text or 'plain', *_row(config, work, plain, text)])
        except Exception as error:  # one that does not run must not cost the others' numbers
            rows.append([text or 'plain', *['-'] * 6, _reason(error)])
        _told(' | '.join(rows[-1]))
    header = ['serving', 'step [ms]', 'plain / this', 'of the matrix rate', 'decode [ms]']
    header += [f'chunk, {options.steps[0]} steps [ms]', 'view-frames/s', 'memory held']
    return table(header, rows)


def _row(config: TrainingConfig, work: Work, plain: Bench, serving: str) -> list[str]:
    options, theirs = plain.options, plain.encode()
    bench = Bench(config, options, ServingOptions.parse(serving))
    try:
        given = bench.encode()
        step, usual, products = medians(
            bench, lambda: bench.step(given), lambda: plain.step(theirs), work.products
        )
        decode = seconds(bench, lambda: bench.decode(given.control))
        chunk = seconds(bench, lambda: bench.chunk(options.steps[0]))
        rate = f'{work.view_frames / chunk:.1f}'
        times = [
            _ms(step),
            f'{usual / step:.2f}',
            work.share(step, products),
            _ms(decode),
            _ms(chunk),
            rate,
        ]
        return [*times, _memory(bench.device)]
    finally:
        bench.close()


class Products:
    """Products of large matrices in the transformer's number format, to measure steps by."""

    def __init__(self, bench: Bench) -> None:
        size = 8192 if bench.device.type == 'cuda' else 512
        self.flop = 20 * 2 * size**3
        self._factors = tuple(
            torch.randn(size, size, device=bench.device, dtype=bench.dtype) for _ in range(2)
        )

    def __call__(self) -> None:
        """Compute them."""
        for _ in range(20):
            torch.mm(*self._factors)


def seconds(bench: Bench, work: Callable[[], object]) -> float:
    """Median time of a piece of work, after one run to warm up."""
    return medians(bench, work)[0]


def medians(bench: Bench, *works: Callable[[], object]) -> list[float]:
    """Median times of pieces of work that take turns, after one run of each to warm up."""

    def finished(work: Callable[[], object]) -> Callable[[], None]:
        def run() -> None:
            work()
            _wait(bench.device)

        return run

    _wait(bench.device)
    named = {str(number): finished(work) for number, work in enumerate(works)}
    return [statistics.median(t) for t in in_turns(named, bench.options.repeats).values()]


def _wait(device: torch.device) -> None:
    if device.type == 'cuda':
        torch.cuda.synchronize(device)


def _memory(device: torch.device) -> str:
    if device.type != 'cuda':
        return 'not counted'
    return f'{torch.cuda.max_memory_allocated(device) / 2**30:.1f} GiB'


def _tokens(given: Conditioning) -> int:
    _, views, _, frames, height, width = given.control.shape
    before = 0 if given.history is None else given.history.shape[3]
    return views * (1 + before + frames) * (height // 2) * (width // 2)


def _ms(value: float) -> str:
    return f'{1e3 * value:.1f}'


def _device_name(device: str) -> str:
    return torch.cuda.get_device_name(device) if device.startswith('cuda') else device


if __name__ == '__main__':
    main()
