"""How fast is a Wan preset on this machine, and how much of the machine does it use?

    python benchmark/wan_speed.py --preset wan-1.3b --device cuda --compile --out benchmark/results

Random weights: speed does not depend on them. A chunk is all views of the preset; umT5 and CLIP
tokens are at hand, as in serving. The stock pipeline is diffusers' `WanImageToVideoPipeline` on
the same transformer blocks and autoencoder, all views side by side in one image; it has no control
video and no reference tokens, so it has a little less to do. Aims on an H200: 60 % of the matrix
rate, 120 view-frames/s at 4 steps, 3 times the stock pipeline.

On a CPU, to see that it works: --device cpu --steps 1 --repeats 1 --set transformer.num_layers=1
video.num_frames=4 video.width=32 video.height=32 autoencoder.base_dim=16
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
import statistics
import sys
import time
from typing import Any

from diffusers import WanImageToVideoPipeline, WanTransformer3DModel
from page import publish, table
import torch
from torch import nn, Tensor
from torch.utils.flop_counter import FlopCounterMode
import yaml

from mtv_world_ros.model.conditioning import condition, Conditioning, decode_frames
from mtv_world_ros.model.context import NUM_TEXT_TOKENS
from mtv_world_ros.model.parts import build_autoencoder, build_scheduler
from mtv_world_ros.model.runtime import place
from mtv_world_ros.model.sampler import sample_latents
from mtv_world_ros.model.transformer import MultiViewWanTransformer
from mtv_world_ros.training.config import load_training_config, TrainingConfig

_IMAGE_TOKENS = 257
#: of a stock Wan image-to-video transformer: noisy 16, mask 4, image 16
_STOCK_CHANNELS = 36


class Bench:
    """The parts of a preset with random weights, and inputs for a chunk."""

    def __init__(self, config: TrainingConfig, options: argparse.Namespace) -> None:
        self.config, self.options = config, options
        self.device, self.dtype = torch.device(options.device), getattr(torch, options.dtype)
        with torch.device('meta'):
            transformer = MultiViewWanTransformer(**config.transformer)
            autoencoder: Any = build_autoencoder(config.autoencoder)
        self.transformer = self._random(transformer)
        self.autoencoder = self._random(autoencoder)
        self.scheduler = build_scheduler(config.scheduler)
        video = config.video
        shape = (1, len(video.views), 1 + video.num_frames, video.height, video.width, 3)
        self.frames = torch.randint(0, 256, shape, dtype=torch.uint8, device=self.device)

    def _random(self, module: Any) -> Any:
        """Random weights that keep activations finite, made where they are used."""
        rope = getattr(module, 'rope', None)  # computed; `to_empty` would lose it
        module = module.to_empty(device=self.device)
        if rope is not None:
            arguments = self.config.transformer
            module.rope = type(rope)(
                arguments['attention_head_dim'],
                arguments['patch_size'],
                arguments['rope_max_seq_len'],
                arguments['view_offset'],
            )
        place(module, self.device, self.dtype)
        torch.manual_seed(self.options.seed)
        for name, parameter in module.named_parameters():
            if parameter.ndim > 1:
                nn.init.normal_(parameter, std=0.02)
            else:
                nn.init.constant_(parameter, 0.0 if name.endswith('bias') else 1.0)
        return module.eval().requires_grad_(False)

    def encode(self) -> Conditioning:
        """Start images and trajectory videos to latents; text and image tokens at hand."""
        latents = condition(self.autoencoder, self.frames[:, :, 0], self.frames)
        views, arguments = self.frames.shape[1], self.config.transformer
        text = self._tokens(NUM_TEXT_TOKENS, arguments['text_dim'])
        image = self._tokens(views * _IMAGE_TOKENS, arguments['image_dim'])
        return replace(latents, text=text, image=image)

    def _tokens(self, count: int, width: int) -> Tensor:
        return torch.zeros(1, count, width, device=self.device, dtype=self.dtype)

    def step(self, given: Conditioning) -> Tensor:
        """One pass of the transformer."""
        return self.transformer(
            torch.zeros_like(given.control),
            torch.full((1,), 500.0, device=self.device),
            control=given.control,
            start=given.start,
            reference=given.reference,
            encoder_hidden_states=given.text,
            encoder_hidden_states_image=given.image,
        )

    def chunk(self, steps: int) -> Tensor:
        """The whole way from frames to frames."""
        given = self.encode()
        latents = sample_latents(
            self.transformer,
            self.scheduler,
            given,
            seeds=[0],
            num_inference_steps=steps,
            should_stop=lambda: False,
        )
        return decode_frames(self.autoencoder, latents.to(self.dtype))

    def stock(self) -> Callable[[int], object]:
        """The pipeline of diffusers itself on the same blocks and autoencoder; takes the steps."""
        own = ('latent_channels', 'num_views', 'stem', 'context', 'view_offset', 'prediction')
        arguments = {k: v for k, v in self.config.transformer.items() if k not in own}
        with torch.device('meta'):
            stock: Any = WanTransformer3DModel(**{**arguments, 'in_channels': _STOCK_CHANNELS})
        stock = self._stock_like(stock)
        pipe: Any = WanImageToVideoPipeline(
            None,  # type: ignore[arg-type]
            None,  # type: ignore[arg-type]
            self.autoencoder.vae,
            build_scheduler(self.config.scheduler),  # type: ignore[arg-type]
            transformer=stock,
        )
        pipe.set_progress_bar_config(disable=True)
        pipe.encode_image = lambda *_: self._tokens(_IMAGE_TOKENS, arguments['image_dim'])
        video, views = self.config.video, self.frames.shape[1]
        shape = (1, 3, video.height, views * video.width)
        image = torch.rand(shape, device=self.device, dtype=torch.float32)

        def run(steps: int) -> object:
            return pipe(
                image=image,
                height=video.height,
                width=views * video.width,
                num_frames=1 + video.num_frames,
                num_inference_steps=steps,
                guidance_scale=1.0,
                prompt_embeds=self._tokens(NUM_TEXT_TOKENS, arguments['text_dim']),
                output_type='pt',
            )

        return run

    def _stock_like(self, stock: Any) -> Any:
        """The stock class around this transformer's own tensors, but for the way in."""
        shallow: Any = WanTransformer3DModel.from_config({**stock.config, 'num_layers': 0})
        stock.patch_embedding = nn.Conv3d(
            _STOCK_CHANNELS, stock.patch_embedding.out_channels, (1, 2, 2), (1, 2, 2)
        )
        tensors = {
            k.replace('_orig_mod.', ''): v for k, v in self.transformer.state_dict().items()
        }
        tensors = {k: v for k, v in tensors.items() if not k.startswith('patch_embedding.')}
        tensors |= {
            f'patch_embedding.{k}': v.to(self.device, self.dtype)
            for k, v in stock.patch_embedding.state_dict().items()
        }
        for name in ('ref_conv.weight', 'ref_conv.bias', 'view_embedding'):
            tensors.pop(name)
        stock.load_state_dict(tensors, assign=True)
        stock.rope = shallow.rope.to(self.device)
        return stock.eval().requires_grad_(False)


def main() -> None:
    """Measures, and prints the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--preset', default='wan-1.3b')
    parser.add_argument('--set', nargs='*', default=[], metavar='SECTION.KEY=VALUE')
    parser.add_argument('--device', default='cuda')
    parser.add_argument('--dtype', default='bfloat16', choices=('bfloat16', 'float32'))
    parser.add_argument('--steps', type=int, nargs='+', default=[4, 8, 50])
    parser.add_argument('--compile', action='store_true', help='compile the repeated blocks')
    parser.add_argument('--repeats', type=int, default=3)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--machine', default='')
    parser.add_argument('--out', type=Path, help='folder to write the page into')
    options = parser.parse_args()
    options.machine = options.machine or _device_name(options.device).replace(' ', '_')
    overrides = {
        key: yaml.safe_load(value) for key, _, value in (s.partition('=') for s in options.set)
    }
    config = load_training_config(options.preset, overrides)
    bench = Bench(config, options)
    with torch.inference_mode():
        body = measure(bench)
    publish(
        options.preset.replace('-', '_').replace('.', '_'),
        f'Speed of {options.preset}',
        f'python benchmark/wan_speed.py {" ".join(sys.argv[1:])}',
        body,
        options,
        f'{_device_name(options.device)}, torch {torch.__version__}',
    )


def measure(bench: Bench) -> str:
    """The page's tables."""
    options, config = bench.options, bench.config
    given = bench.encode()
    with FlopCounterMode(display=False) as counter:
        bench.step(given)
    flop = counter.get_total_flops()
    if options.compile:
        bench.transformer.compile_repeated_blocks(fullgraph=True, dynamic=False)
    matrix = matrix_rate(bench)
    step = seconds(bench, lambda: bench.step(given))
    rows = [
        ['encode (start images, trajectory videos)', _ms(seconds(bench, bench.encode))],
        ['one step of the transformer', _ms(step)],
        ['decode', _ms(seconds(bench, lambda: decode_frames(bench.autoencoder, given.control)))],
    ]
    stock = bench.stock()
    view_frames = len(config.video.views) * config.video.num_frames
    totals = []
    for steps in options.steps:
        ours = seconds(bench, lambda n=steps: bench.chunk(n))
        theirs = seconds(bench, lambda n=steps: stock(n))
        rate = f'{view_frames / ours:.1f}'
        totals.append([str(steps), _ms(ours), rate, _ms(theirs), f'{theirs / ours:.2f}'])
    tokens = _tokens(given)
    video = config.video
    parameters = sum(p.numel() for p in bench.transformer.parameters())
    chunk = (
        f'A chunk: {len(video.views)} views of 1 + {video.num_frames} frames, '
        f'{video.width}x{video.height}, {tokens} tokens; {parameters / 1e6:.1f} M parameters, '
        f'{options.dtype}, blocks {"" if options.compile else "not "}compiled, no guidance.'
    )
    share = (
        f'The transformer: {flop / 1e12:.3f} TFLOP a step, {flop / step / 1e12:.2f} TFLOP/s, '
        f'{100 * flop / step / matrix:.0f} % of the {matrix / 1e12:.2f} TFLOP/s that a large '
        f'{options.dtype} matrix product reaches here.'
    )
    stages = table(['stage', 'median [ms]'], rows)
    header = ['steps', 'chunk [ms]', 'view-frames/s', 'stock pipeline [ms]', 'ratio']
    return '\n\n'.join([chunk, stages, share, table(header, totals), *_memory(bench.device)])


def matrix_rate(bench: Bench) -> float:
    """FLOP/s of a large matrix product on this device, in the transformer's number format."""
    size = 8192 if bench.device.type == 'cuda' else 512
    a, b = (torch.randn(size, size, device=bench.device, dtype=bench.dtype) for _ in range(2))

    def products() -> None:
        for _ in range(20):
            torch.mm(a, b)

    return 20 * 2 * size**3 / seconds(bench, products)


def seconds(bench: Bench, work: Callable[[], object]) -> float:
    """Median time of a piece of work, after one run to warm up."""
    spent = []
    for _ in range(1 + bench.options.repeats):
        _wait(bench.device)
        begun = time.perf_counter()
        work()
        _wait(bench.device)
        spent.append(time.perf_counter() - begun)
    return statistics.median(spent[1:])


def _wait(device: torch.device) -> None:
    if device.type == 'cuda':
        torch.cuda.synchronize(device)


def _memory(device: torch.device) -> list[str]:
    if device.type != 'cuda':
        return []
    return [f'Most memory held: {torch.cuda.max_memory_allocated(device) / 2**30:.1f} GiB.']


def _tokens(given: Conditioning) -> int:
    _, views, _, frames, height, width = given.control.shape
    return views * (1 + frames) * (height // 2) * (width // 2)


def _ms(value: float) -> str:
    return f'{1e3 * value:.1f}'


def _device_name(device: str) -> str:
    return torch.cuda.get_device_name(device) if device.startswith('cuda') else device


if __name__ == '__main__':
    main()
