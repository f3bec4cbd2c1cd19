"""Is a block of the Wan presets faster than diffusers' own, on this machine?

    python experiments/wan_block.py --out experiments/results

Both blocks have the same weights and inputs, and take turns; the ratio is the median of the pairs'
ratios of CPU time. A noise level is shared by all tokens, or (as in the presets, with a history)
by the tokens of a frame; diffusers' block holds the latter once a token.
"""

from __future__ import annotations

import argparse
import copy
import shlex
import statistics
import sys
import time
from typing import Any

from diffusers.models.transformers.transformer_wan import WanAttnProcessor, WanTransformerBlock
from page import in_turns, parse_arguments, publish, table
import torch

from mtv_world_ros.model.transformer.block import hold_levels_by_run
from mtv_world_ros.training.training_config import load_training_config

#: rows and columns of a view's tokens, views; frames are an option
_HEIGHT, _WIDTH, _VIEWS = 9, 12, 2


def blocks(preset: str, dtype: torch.dtype) -> tuple[Any, Any]:
    """Diffusers' block and ours, with the same random weights."""
    model = load_training_config(preset).transformer
    heads = model['num_attention_heads']
    dim = heads * model['attention_head_dim']
    theirs = WanTransformerBlock(
        dim, model['ffn_dim'], heads, cross_attn_norm=True, added_kv_proj_dim=dim
    )
    theirs = theirs.to(dtype).eval().requires_grad_(False)
    theirs.scale_shift_table.data = theirs.scale_shift_table.float()
    ours = copy.deepcopy(theirs)
    hold_levels_by_run(torch.nn.ModuleList([ours]))
    assert isinstance(theirs.attn1.processor, WanAttnProcessor)
    return theirs, ours


def row(options: argparse.Namespace, dtype: torch.dtype, levels: str) -> list[str]:
    """Times of both blocks."""
    theirs, ours = blocks(options.preset, dtype)
    dim, runs = theirs.scale_shift_table.shape[-1], _VIEWS * options.frames
    num_tokens = runs * _HEIGHT * _WIDTH
    generator = torch.Generator().manual_seed(options.seed)
    x = torch.randn(1, num_tokens, dim, generator=generator).to(dtype)
    context = torch.randn(1, 512 + _VIEWS * 257, dim, generator=generator).to(dtype)
    rotary: Any = [
        torch.randn(1, num_tokens, 1, 64, generator=generator).repeat_interleave(2, -1)
        for _ in range(2)
    ]
    level = torch.randn(1, 1 if levels == 'one' else runs, 6, dim, generator=generator)
    of_tokens = level[:, 0] if levels == 'one' else level.repeat_interleave(num_tokens // runs, 1)
    works = {
        'theirs': lambda: theirs(x, context, of_tokens, rotary),
        'ours': lambda: ours(x, context, level, rotary),
    }
    worst = (works['theirs']().float() - works['ours']().float()).abs().max().item()
    spent = in_turns(works, options.repeats, clock=time.process_time)
    ratios = [a / b for a, b in zip(spent['theirs'], spent['ours'], strict=True)]
    medians = [f'{1e3 * statistics.median(spent[name]):.0f}' for name in works]
    low, high = min(ratios), max(ratios)
    name = str(dtype).removeprefix('torch.')
    ratio = f'{statistics.median(ratios):.2f} [{low:.2f}, {high:.2f}]'
    return [name, levels, str(num_tokens), *medians, ratio, f'{worst:.1e}']


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add what other benchmarks do not have."""
    parser.add_argument('--preset', default='wan-1.3b')
    parser.add_argument('--frames', type=int, default=5, help='token frames of a view')
    parser.add_argument('--threads', type=int, default=1)
    parser.add_argument('--dtypes', nargs='+', default=['float32', 'bfloat16'])


def main() -> None:
    """Measure, and print the page."""
    options = parse_arguments(__doc__, repeats=7, more=add_options)
    torch.set_num_threads(options.threads)
    with torch.inference_mode():
        rows = [
            row(options, getattr(torch, dtype), levels)
            for dtype in options.dtypes
            for levels in ('one', 'by frame')
        ]
    head = ['format', 'noise levels', 'tokens', 'diffusers [ms]', 'ours [ms]']
    head += ['diffusers / ours', 'largest difference']
    body = f'{options.threads} thread(s).\n\n' + table(head, rows)
    command = shlex.join(['python', *sys.argv])
    versions = f'torch {torch.__version__}'
    publish('wan_block', 'A block of the Wan presets', command, body, options, versions)


if __name__ == '__main__':
    main()
