"""Trains LeRobot's ACT on a processor in less than an hour; run by LeRobot's environment.

    ENV/bin/python experiments/act_training.py --out DIR --data FILE.npz... --steps N
        [--views high] [--size 64x48] [--begin DIR] [--asked 0] [--share 1] [--late 0]

The policy, its normalisation and its checkpoints are LeRobot's own classes. Four things differ
from `lerobot_train`. All frames stay in memory. There is no dropout. The ResNet, which starts from
random weights, has live batch normalisation while it learns; a saved checkpoint has the frozen one
that ACT expects, with the statistics found. And half of every batch are first frames of episodes,
since the answer to that frame alone decides whether an object is grasped.

Training ends at the last step of --save-at; --steps is the length of the learning rate's schedule.

FILE.npz has images (N, V, H, W, 3) uint8 by `views`, state (N, J), actions (N, T, J), `start` (N,)
whether an episode begins there, and `scene` (N,), its number. The same command goes on where it
was stopped.
"""

# lerobot is in another environment
# pyright: reportMissingImports=false
from __future__ import annotations

import argparse
import copy
import json
from pathlib import Path
import time
from typing import Any

from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
import numpy as np
import torch
from torch import nn
from torchvision.ops.misc import FrozenBatchNorm2d

BATCH = 64
LEARNING_RATE, WARM_UP = 6e-4, 50
#: columns of the grippers among the joints
GRIPPERS = (6, 13)


def main() -> None:
    """Train, and save a checkpoint at every --save-at."""
    options = _options()
    torch.manual_seed(options.seed)
    data, held = _data(options), _data(options, held=True)
    statistics = _statistics(data, options.views)
    policy = ACTPolicy(_config(options, data))
    before, after = make_pre_post_processors(policy.config, dataset_stats=statistics)
    if options.begin:
        policy = ACTPolicy.from_pretrained(options.begin)
        before, after = make_pre_post_processors(policy.config, pretrained_path=options.begin)
    thaw(policy)
    policy.model.backbone.to(memory_format=torch.channels_last)
    save_at = sorted(int(step) for step in options.save_at.split(',') if step) or [options.steps]
    optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-3, weight_decay=1e-3, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, options.rate, options.steps, pct_start=min(0.3, WARM_UP / options.steps)
    )
    done, spent, state = 0, 0.0, options.out / 'state.pt'
    if state.exists():
        kept = torch.load(state, weights_only=True)
        policy.load_state_dict(kept['policy'])
        optimizer.load_state_dict(kept['optimizer'])
        schedule.load_state_dict(kept['schedule'])
        done, spent = kept['step'], kept['spent']
    rng = np.random.default_rng([options.seed, done])
    policy.train()
    began, losses, shown = time.process_time(), [], time.monotonic()
    for step in range(done + 1, save_at[-1] + 1):
        batch = before(_batch(data, options, rng))
        with torch.autocast('cpu', torch.bfloat16):
            loss, _ = policy.forward(batch)
        loss.backward()
        nn.utils.clip_grad_norm_(policy.parameters(), 5.0)
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
        losses.append(loss.item())
        if step % 25 == 0:
            now = spent + time.process_time() - began
            print(
                f'step {step} loss {np.mean(losses[-25:]):.4f} cpu_s {now:.0f} '
                f'wall_s_a_step {(time.monotonic() - shown) / 25:.2f}', flush=True,
            )  # fmt: skip
            shown = time.monotonic()
        if step in save_at or step % 100 == 0:
            now = spent + time.process_time() - began
            _keep(state, policy, optimizer, schedule, step, now)
            explained = _explained(policy, before, held, options)
            print(f'step {step} explained {explained}', flush=True)
            if step in save_at:
                card = {'step': step, 'cpu_s': now, 'loss': float(np.mean(losses[-25:]))}
                _save(options.out / f'{step:06d}', policy, before, after, card | explained)


def thaw(policy: ACTPolicy) -> None:
    """Replace the ResNet's frozen batch normalisation by one that learns."""
    for name, module in list(policy.model.backbone.named_modules()):
        if isinstance(module, FrozenBatchNorm2d):
            live = nn.BatchNorm2d(len(module.weight), momentum=0.05)
            live.load_state_dict(module.state_dict(), strict=False)
            _put(policy.model.backbone, name, live)


def freeze(policy: ACTPolicy) -> ACTPolicy:
    """Return a copy with the frozen batch normalisation of ACT."""
    policy = copy.deepcopy(policy)
    for name, module in list(policy.model.backbone.named_modules()):
        if isinstance(module, nn.BatchNorm2d):
            still = FrozenBatchNorm2d(module.num_features, eps=module.eps)
            state = module.state_dict()
            state.pop('num_batches_tracked')
            still.load_state_dict(state)
            _put(policy.model.backbone, name, still)
    return policy.eval()


def _put(root: nn.Module, name: str, module: nn.Module) -> None:
    *path, last = name.split('.')
    parent = root.get_submodule('.'.join(path))
    setattr(parent, last, module)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--data', nargs='+', required=True)
    parser.add_argument('--out', type=Path, required=True)
    parser.add_argument('--steps', type=int, required=True)
    parser.add_argument('--save-at', default='', help='steps; default: the last one')
    parser.add_argument('--views', default='high')
    parser.add_argument('--size', default='64x48')
    parser.add_argument('--begin', default='', help='checkpoint to go on from')
    parser.add_argument(
        '--asked',
        type=float,
        default=0.0,
        help='share of the later frames that are drawn where an answer ends and the next begins',
    )
    parser.add_argument('--share', type=int, default=1, help='use one of this many scenes')
    parser.add_argument('--late', type=int, default=0, help='actions that grippers are late')
    parser.add_argument('--rate', type=float, default=LEARNING_RATE)
    parser.add_argument('--seed', type=int, default=0)
    options = parser.parse_args()
    options.views = options.views.split(',')
    options.width, options.height = (int(word) for word in options.size.split('x'))
    options.out.mkdir(parents=True, exist_ok=True)
    return options


def is_held(scenes: np.ndarray) -> np.ndarray:
    """Whether scenes are kept from training: one of 16."""
    return scenes % 16 == 15


def _data(options: argparse.Namespace, *, held: bool = False) -> dict[str, torch.Tensor]:
    """Samples of the files, images resized as LeRobot's server resizes them."""
    parts: dict[str, list[torch.Tensor]] = {}
    for path in options.data:
        with np.load(path) as file:
            views = [str(name) for name in file['views']]
            used = is_held(file['scene']) == held
            if not held:
                used &= file['scene'] % options.share == 0
            columns = [views.index(view) for view in options.views]
            images = torch.from_numpy(file['images'][used][:, columns])
            parts.setdefault('images', []).append(_resized(images, options))
            for key in ('state', 'actions', 'start'):
                parts.setdefault(key, []).append(torch.from_numpy(file[key][used]))
    data = {key: torch.cat(values) for key, values in parts.items()}
    every = torch.arange(len(data['start']))
    since = every - torch.cummax(torch.where(data['start'], every, 0), dim=0).values
    after = (since + 1) % data['actions'].shape[1] <= 2
    data |= {'all': every, 'starts': every[since == 0], 'answers': every[(since > 0) & after]}
    if options.late:
        grippers = data['actions'][..., GRIPPERS]
        still = grippers[:, :1].expand(-1, options.late, -1)
        data['actions'][..., GRIPPERS] = torch.cat([still, grippers[:, : -options.late]], dim=1)
    return data


def _resized(images: torch.Tensor, options: argparse.Namespace) -> torch.Tensor:
    """(N, V, 3, h, w) uint8."""
    num, views = images.shape[:2]
    flat = images.flatten(0, 1).permute(0, 3, 1, 2)
    size = (options.height, options.width)
    small = [
        nn.functional.interpolate(part.float(), size=size, mode='bilinear', align_corners=False)
        .round().byte()
        for part in flat.split(512)
    ]  # fmt: skip
    return torch.cat(small).reshape(num, views, 3, *size)


def _statistics(data: dict[str, torch.Tensor], views: list[str]) -> dict[str, Any]:
    def found(values: torch.Tensor) -> dict[str, torch.Tensor]:
        return {'mean': values.mean(0), 'std': values.std(0).clamp(min=1e-2)}

    out = {'observation.state': found(data['state'])}
    actions = data['actions'].flatten(0, 1)
    out['action'] = {'mean': actions.mean(0), 'std': actions.std(0).clamp(min=5e-3)}
    for k, view in enumerate(views):
        pixels = data['images'][::7, k].float().div(255)
        out[f'observation.images.{view}'] = {
            'mean': pixels.mean((0, 2, 3)).reshape(3, 1, 1),
            'std': pixels.std((0, 2, 3)).reshape(3, 1, 1),
        }
    return out


def _config(options: argparse.Namespace, data: dict[str, torch.Tensor]) -> ACTConfig:
    num, joints = data['actions'].shape[1:]
    image = PolicyFeature(type=FeatureType.VISUAL, shape=(3, options.height, options.width))
    return ACTConfig(
        device='cpu',
        push_to_hub=False,
        input_features={
            'observation.state': PolicyFeature(type=FeatureType.STATE, shape=(joints,)),
            **{f'observation.images.{view}': image for view in options.views},
        },
        output_features={'action': PolicyFeature(type=FeatureType.ACTION, shape=(joints,))},
        chunk_size=num,
        n_action_steps=num,
        pretrained_backbone_weights=None,
        dim_model=128,
        n_heads=4,
        dim_feedforward=512,
        n_encoder_layers=2,
        use_vae=False,
        dropout=0.0,
    )


def _batch(
    data: dict[str, torch.Tensor], options: argparse.Namespace, rng: np.random.Generator
) -> dict[str, Any]:
    half = BATCH // 2
    asked = round(half * options.asked)
    places = [
        *[data['starts']] * half,
        *[data['answers']] * asked,
        *[data['all']] * (half - asked),
    ]
    rows = torch.stack([rows[rng.integers(len(rows))] for rows in places])
    return _samples(data, rows, options)


def _samples(
    data: dict[str, torch.Tensor], rows: torch.Tensor, options: argparse.Namespace
) -> dict[str, Any]:
    images = data['images'][rows].float().div(255)
    return {
        'observation.state': data['state'][rows],
        'action': data['actions'][rows],
        'action_is_pad': torch.zeros(len(rows), data['actions'].shape[1], dtype=torch.bool),
        **{f'observation.images.{view}': images[:, k] for k, view in enumerate(options.views)},
    }


def _explained(
    policy: ACTPolicy, before: Any, held: dict[str, torch.Tensor], options: argparse.Namespace
) -> dict[str, Any]:
    """Share of the variance of commands that answers explain, in scenes kept from training.

    `grasp` is of the first answer, 1.2 s later, where the grippers close; `later` is of answers
    in mid-episode, 1.6 s later, where an answer ends. Joints count by their variance.
    """
    policy.eval()
    out = {}
    for name, rows, step in (
        ('grasp', held['starts'], 5),
        ('later', held['answers'], 7),
    ):
        if not len(rows):
            continue
        batch = before(_samples(held, rows, options))
        with torch.no_grad(), torch.autocast('cpu', torch.bfloat16):
            answers = policy.predict_action_chunk(batch)[:, step].float()
        wanted = batch['action'][:, step]
        left = (answers - wanted).square().sum() / (wanted - wanted.mean(0)).square().sum()
        out[name] = round(1 - float(left), 4)
    policy.train()
    return out


def _keep(path: Path, policy: Any, optimizer: Any, schedule: Any, step: int, spent: float) -> None:
    values = {
        'policy': policy.state_dict(),
        'optimizer': optimizer.state_dict(),
        'schedule': schedule.state_dict(),
        'step': step,
        'spent': spent,
    }
    new = path.with_suffix('.new')
    torch.save(values, new)
    new.rename(path)


def _save(path: Path, policy: ACTPolicy, before: Any, after: Any, card: dict[str, Any]) -> None:
    freeze(policy).save_pretrained(path)
    before.save_pretrained(path)
    after.save_pretrained(path)
    (path / 'training.json').write_text(json.dumps(card), encoding='utf-8')


if __name__ == '__main__':
    main()
