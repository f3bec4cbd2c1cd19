"""`mtv-world train-motion`: from recorded episodes to an object motion network.

Shape letters: B batch, T steps, O objects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import copy
from dataclasses import dataclass, fields, replace
from functools import partial
import math
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch import Tensor
import torch.nn.functional as F
from torch.optim import _muon
from tqdm import tqdm

from mtv_world_ros.errors import TrainingError
from mtv_world_ros.files import check_free, write_whole
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.lab.training.object_motion.tracks import object_tracks, ObjectTracks, read_each
from mtv_world_ros.lab.training.object_motion.windows import Batch, pools_of, TrackPool
from mtv_world_ros.model.checkpoint import OBJECT_MOTION_FOLDER
from mtv_world_ros.model.object_motion.arm_response import ArmResponse
from mtv_world_ros.model.object_motion.network import (
    Memory,
    Motion,
    ObjectMotionNetwork,
    off_way,
    Truth,
)
from mtv_world_ros.model.object_motion.predictor import num_features, save_network

_EMA_DECAY = 0.999
#: outputs of a layer that Muon trains
_LEAST_ROWS = 8
#: of a network that begins anew
_WIDTH, _HIDDEN = 128, 48
#: steps between two savings, and of a row of the curve
_SAVE_EVERY, _CURVE_EVERY = 500, 100
#: weight of a wrong turn [1 / rad^2], as of 5 mm for .15 rad; how far something tumbles nobody can
#: know, so that squares of angles above this count little more [rad^2]
_TURN, _TUMBLE = 20.0, 0.1
#: where a tool that goes further than this in a step [m] is near an object [m], and that stays
#: where it is in its frame, but for a share of its way, it carries the object
_WAY_M, _NEAR_M, _SLIP = 0.005, 0.15, 0.35
#: an object that goes less stands still, and goes along if it goes further [m]; the network is
#: told while it has the object nearly where it is [m]
_STANDS_M, _GOES_M, _RIGHT_M = 0.001, 0.004, 0.015
#: what a turn of a tool counts as a way [m / rad]
_LEVER_M = 0.05
#: gradients keep this share of their size from one step to the step before: through tens of steps
#: of contact they grow at random, and drown what can be learned
_KEPT = 0.9
#: weight of how far tools are off their way, as that of objects
_STOPPED = 3.0
#: an object has moved if it went further than this [m]
_MOVED_M = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionTraining:
    """How the network is trained.

    Attributes:
        steps: of the optimizer; 0 = what it goes on from is written as it is.
        batch_size: B, windows a step.
        learning_rate: largest; it warms up over 100 steps and falls as a cosine.
        forced_share: share of the training in which fewer and fewer steps start from the truth;
            after it objects run free from the first step of their window.
        lost_m: but one that is further than this from the truth is lost, and goes on from there
            [m]: what comes after a wrong contact teaches little else; in the first `lost_share` of
            the training, since a network that never bears the consequences takes too much for a
            success.
        lost_share: see `lost_m`.
        seed: of weights and windows.
        compile: with torch.compile, which needs a C++ compiler and is 1.8 times as fast.
        device: to train on; on a GPU a step's passes are captured and replayed.
        dtype: of the products of matrices over pairs and nodes; weights, geometry and sums stay
            float32.
        width: D of the network; what it goes on from is widened and computes the same at first;
            None = as it is, or 128.
        hidden: numbers that an object remembers from step to step; likewise, or 48.
    """

    steps: int = 4000
    batch_size: int = 64
    learning_rate: float = 2e-3
    forced_share: float = 0.35
    lost_m: float = 0.02
    lost_share: float = 0.55
    seed: int = 0
    compile: bool = False
    device: str = 'cpu'
    dtype: torch.dtype = torch.float32
    width: int | None = None
    hidden: int | None = None


def read_tracks(
    paths: Sequence[Path],
    robot: RobotModel,
    views: Sequence[str],
    num_starts: int = 1,
    response: ArmResponse | None = None,
) -> tuple[list[list[ObjectTracks]], dict[str, str]]:
    """Returns the tracks of each episode that can be trained on, and why others cannot, by path.

    Raises:
        TrainingError: none can.
    """
    tracks, skipped = read_each(
        paths, lambda path: object_tracks(path, robot, views, num_starts, response)
    )
    if not tracks:
        raise TrainingError(
            f'no episode can be trained on; the first: {next(iter(skipped.items()))}'
        )
    return tracks, skipped


def train_motion(
    tracks: Sequence[ObjectTracks],
    out: Path,
    config: MotionTraining,
    *,
    init: ObjectMotionNetwork | None = None,
    response: ArmResponse | None = None,
    overwrite: bool = False,
) -> ObjectMotionNetwork:
    """Trains, writes the averaged weights into `out/object_motion`, and returns the network.

    The weights so far and the curve (`out/motion.csv`) are written every 500 steps; Ctrl-C ends
    the training with what there is.

    Args:
        tracks: of the episodes.
        out: folder.
        config: how.
        init: network to go on from.
        response: that the tracks were read with.
        overwrite: `out/object_motion` may be there already, and is replaced.

    Raises:
        ConfigError: the folder is there already.
        TrainingError: no tracks, `init` is wider than wanted, or the loss is not finite.
    """
    folder = Path(out) / OBJECT_MOTION_FOLDER
    check_free(folder, overwrite)
    if not tracks:
        raise TrainingError('no episode is left to train on beside those held out; give more')
    torch.manual_seed(config.seed)
    network = _network(init, num_features(tracks[0].features.shape[1]), config).to(config.device)
    averaged = torch.optim.swa_utils.AveragedModel(
        network, avg_fn=lambda old, new, n: old.lerp(new, 1 - min(_EMA_DECAY, _warm(int(n))))
    )
    losses: list[float] = []
    bar = tqdm(_losses(network, averaged, tracks, config), 'training', config.steps, unit='step')
    try:
        for loss in bar:
            losses.append(loss)
            bar.set_postfix(loss=f'{np.mean(losses[-50:]):.3f}')
            if len(losses) % _SAVE_EVERY == 0:
                _save(_network_of(averaged), folder, losses, response)
    except KeyboardInterrupt:
        tqdm.write(f'stopped after {len(losses)} of {config.steps} steps')
    _save(_network_of(averaged), folder, losses, response)
    return _network_of(averaged).cpu().eval()


def mean_network(networks: Sequence[ObjectMotionNetwork]) -> ObjectMotionNetwork:
    """Returns the network of mean weights (of one origin, else useless: Wortsman et al. 2022).

    Raises:
        TrainingError: they differ in size.
    """
    mean = copy.deepcopy(networks[0])
    sizes = [network.config for network in networks]
    if any(size != sizes[0] for size in sizes):
        raise TrainingError(f'networks of several sizes have no mean: {sizes}; give those of one')
    states = [network.state_dict() for network in networks]
    mean.load_state_dict({k: torch.stack([s[k] for s in states]).mean(0) for k in states[0]})
    return mean


def _network(
    init: ObjectMotionNetwork | None, count: int, config: MotionTraining
) -> ObjectMotionNetwork:
    if init is None:
        width, hidden = config.width or _WIDTH, config.hidden or _HIDDEN
        return ObjectMotionNetwork(count, width, hidden, fingertips=True, yielding=True)
    try:
        return init.widened(config.width or init.width, config.hidden or init.hidden)
    except ValueError as error:
        raise TrainingError(f'--init: {error}; set --width and --hidden') from error


def _network_of(averaged: torch.optim.swa_utils.AveragedModel) -> ObjectMotionNetwork:
    assert isinstance(averaged.module, ObjectMotionNetwork)
    return averaged.module


def _losses(
    network: ObjectMotionNetwork,
    averaged: torch.optim.swa_utils.AveragedModel,
    tracks: Sequence[ObjectTracks],
    config: MotionTraining,
) -> Iterator[float]:
    """Trains, and yields the loss of each step."""
    rng = np.random.default_rng(config.seed)
    optimizers = _optimizers(network, config.learning_rate)
    pools = pools_of(tracks, config.device)
    shares = np.array([len(pool) for pool in pools]) / len(tracks)
    _multiply_in(network, config.dtype)
    if config.compile:
        # once for each number of objects: what is compiled for any is slow
        network.step = torch.compile(network.step, dynamic=False)
    passes = _Passes(network)
    for step in range(config.steps):
        for optimizer in optimizers:
            for group in optimizer.param_groups:
                group['lr'] = _rate(step, config)
        batch = pools[int(rng.choice(len(pools), p=shares))].draw(config.batch_size, rng)
        progress = step / config.steps
        loss = passes(
            batch, _forced(progress, config, batch, rng), _lost_m(progress, config, batch)
        )
        if not math.isfinite(loss.item()):
            raise TrainingError(f'the loss is {loss.item()} at step {step}; lower --learning-rate')
        norm = torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        if torch.isfinite(norm):
            for optimizer in optimizers:
                optimizer.step()
        averaged.update_parameters(network)
        yield loss.item()


def _damped(step: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a network's step through which gradients shrink on their way back."""

    def kept(value: Tensor) -> Tensor:
        return value.detach().lerp(value, _KEPT)

    def run(tools: Tensor, gaps: Tensor, present: Tensor, extents: Any, now: Memory) -> Any:
        names = ('points', 'rotations', 'velocity', 'hidden', 'off', 'off_before')
        now = replace(now, **{name: kept(getattr(now, name)) for name in names})
        return step(tools, gaps, present, extents, now)

    return run


def _multiply_in(network: ObjectMotionNetwork, dtype: torch.dtype) -> None:
    """Lets layers over pairs and nodes multiply in a number format; what comes out is float32."""
    if dtype == torch.float32:
        return
    for layers in (network.tool_edge, network.object_edge, network.node):
        layers.product = partial(_product, dtype)


def _product(dtype: torch.dtype, x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    bias = None if bias is None else bias.to(dtype)
    return F.linear(x.to(dtype), weight.to(dtype), bias).float()


class _Passes:
    """Forward and backward: the loss of a batch, its gradients left at the network's parameters.

    On a GPU they are captured once for each size of a batch, as a CUDA graph: thousands of small
    kernels, one launch.

    Args:
        network: where it is trained.
    """

    def __init__(self, network: ObjectMotionNetwork) -> None:
        self._network = network
        self._parameters = list(network.parameters())
        self._captured: dict[torch.Size, _Captured] = {}

    def __call__(self, batch: Batch, forced: Tensor, lost_m: Tensor) -> Tensor:
        if not batch.points.is_cuda:
            return self._run(batch, forced, lost_m)
        size = batch.points.shape
        if size not in self._captured:
            self._captured[size] = self._capture(batch, forced, lost_m)
        captured = self._captured[size]
        for own, new in zip(captured.given, _tensors(batch, forced, lost_m), strict=True):
            own.copy_(new)
        with torch.cuda.device(batch.points.device):
            captured.graph.replay()
        for parameter, gradient in zip(self._parameters, captured.gradients, strict=True):
            parameter.grad = gradient
        return captured.loss

    def _run(self, batch: Batch, forced: Tensor, lost_m: Tensor) -> Tensor:
        truth = Truth(
            points=batch.points,
            rotations=batch.rotations,
            known=batch.known,
            forced=forced,
            lost_m=lost_m,
            off=_off_way(batch),
        )
        loss = _loss(self._network(batch.scene, truth), batch)
        gradients = torch.autograd.grad(loss, self._parameters)
        for parameter, gradient in zip(self._parameters, gradients, strict=True):
            parameter.grad = gradient
        return loss.detach()

    def _capture(self, batch: Batch, forced: Tensor, lost_m: Tensor) -> _Captured:
        with torch.cuda.device(batch.points.device):
            return self._capture_here(batch, forced, lost_m)

    def _capture_here(self, batch: Batch, forced: Tensor, lost_m: Tensor) -> _Captured:
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(3):  # compiles, and lets libraries set up
                self._run(batch, forced, lost_m)
        torch.cuda.current_stream().wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            loss = self._run(batch, forced, lost_m)
        gradients = [parameter.grad for parameter in self._parameters]
        given = _tensors(batch, forced, lost_m)
        return _Captured(graph=graph, given=given, loss=loss, gradients=gradients)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Captured:
    """A CUDA graph, and where it reads and writes."""

    graph: torch.cuda.CUDAGraph
    given: list[Tensor]
    loss: Tensor
    gradients: list[Tensor | None]


def _tensors(batch: Batch, forced: Tensor, lost_m: Tensor) -> list[Tensor]:
    scene = [getattr(batch.scene, field.name) for field in fields(batch.scene)]
    rest = [getattr(batch, field.name) for field in fields(batch) if field.name != 'scene']
    return [*scene, *rest, forced, lost_m]


def _optimizers(network: ObjectMotionNetwork, rate: float) -> list[torch.optim.Optimizer]:
    """Muon (Jordan et al. 2024) for matrices; AdamW for biases and what has few outputs."""
    weights: list[Tensor] = []
    others: list[Tensor] = []
    for parameter in network.parameters():
        is_matrix = parameter.ndim == 2 and len(parameter) >= _LEAST_ROWS
        (weights if is_matrix else others).append(parameter)
    return [
        _Muon(weights, lr=rate, weight_decay=1e-4, adjust_lr_fn='match_rms_adamw'),
        torch.optim.AdamW(others, lr=rate, betas=(0.9, 0.99), weight_decay=1e-4),
    ]


class _Muon(torch.optim.Muon):
    """Multiplies in float32: torch's multiplies in bfloat16, slowly where a processor lacks it."""

    def step(self, closure: Callable[[], float] | None = None) -> float | None:
        """Does a step."""
        with mock.patch.object(_muon, '_zeropower_via_newtonschulz', orthogonalized):
            return super().step(closure)


def orthogonalized(
    gradient: Tensor, coefficients: tuple[float, float, float], steps: int, eps: float
) -> Tensor:
    """Returns about U V^T of a matrix U S V^T, by Newton-Schulz iterations (Jordan et al. 2024).

    Args:
        gradient: (N, M).
        coefficients: of x, x^3 and x^5.
        steps: iterations.
        eps: least norm to divide by.
    """
    a, b, c = coefficients
    x = gradient.T if gradient.shape[0] > gradient.shape[1] else gradient
    x = x / x.norm().clamp(min=eps)
    for _ in range(steps):
        square = x @ x.T
        x = torch.addmm(x, torch.addmm(square, square, square, beta=b, alpha=c), x, beta=a)
    return x.T if gradient.shape[0] > gradient.shape[1] else x


def _save(
    network: ObjectMotionNetwork,
    folder: Path,
    losses: Sequence[float],
    response: ArmResponse | None,
) -> None:
    save_network(network, folder, response)
    rows = [
        f'{first + _CURVE_EVERY},{np.mean(losses[first : first + _CURVE_EVERY]):.4f}'
        for first in range(0, len(losses), _CURVE_EVERY)
    ]
    write_whole(folder.parent / 'motion.csv', '\n'.join(['step,loss', *rows, '']))


def end_errors(
    network: ObjectMotionNetwork, tracks: Sequence[ObjectTracks]
) -> tuple[np.ndarray, np.ndarray]:
    """Returns (N,) errors at the end of whole episodes [m], and how far objects really went [m].

    One of each tracked object of each episode.
    """
    errors, ways = [], []
    for track in tracks:
        batch = TrackPool([track]).whole(0)
        with torch.inference_mode():
            motion = network(batch.scene)
        ok = batch.scene.present[0]
        errors += (motion.points[0, -1] - batch.points[0, -1]).norm(dim=-1)[ok].tolist()
        ways += (batch.points[0, -1] - batch.points[0, 0]).norm(dim=-1)[ok].tolist()
    return np.array(errors), np.array(ways)


def _warm(count: int) -> float:
    return count / (count + 20)


def _rate(step: int, config: MotionTraining) -> float:
    warm = min(1.0, (step + 1) / 100)
    return config.learning_rate * warm * (0.505 + 0.495 * math.cos(math.pi * step / config.steps))


def _forced(
    progress: float, config: MotionTraining, batch: Batch, rng: np.random.Generator
) -> Tensor:
    """(B, T) which steps start from the truth: fewer and fewer; the first of a window always."""
    share = max(0.0, 1 - progress / max(config.forced_share, 1e-6))
    size, steps = batch.points.shape[0], batch.points.shape[1] - 1
    often = rng.random((size, 1)) < 0.3 + 0.5 * share
    forced = rng.random((size, steps)) < np.where(often, 0.5 + 0.5 * share, share)
    if share == 0:
        forced[:] = False
    forced[:, 0] = True
    return torch.from_numpy(forced).to(batch.points.device)


def _lost_m(progress: float, config: MotionTraining, batch: Batch) -> Tensor:
    """(B,) from where on an object is lost [m]: at last nowhere."""
    lost_m = config.lost_m if progress < config.lost_share else math.inf
    return batch.points.new_full((len(batch.points),), lost_m)


def _off_way(batch: Batch) -> Tensor:
    """(B, T + 1, A, 7) of the tools as they really are."""
    return off_way(batch.tools, batch.gaps, batch.scene.tools, batch.scene.gaps)


def _squared_angle(first: Tensor, second: Tensor) -> Tensor:
    """(...) of rotations (..., 3, 3), while it is small [rad^2]."""
    return 3 - (first.mT @ second).diagonal(dim1=-2, dim2=-1).sum(-1)


def _carried(batch: Batch) -> tuple[Tensor, Tensor]:
    """(B, T, O, A) whether a tool carries an object in a step, and whether that is known."""
    rotations, places = batch.tools[..., :3, :3], batch.tools[..., :3, 3]
    offset = batch.points[:, :, :, None] - places[:, :, None]
    local = torch.einsum('btaji,btoaj->btoai', rotations, offset)
    turn = _squared_angle(rotations[:, 1:], rotations[:, :-1]).clamp(min=0).sqrt()
    way = (places.diff(dim=1).norm(dim=-1) + _LEVER_M * turn)[:, :, None]
    gone = batch.points.diff(dim=1).norm(dim=-1)[..., None]
    asked = (way > _WAY_M) & (local[:, 1:].norm(dim=-1) < _NEAR_M)
    carried = (local.diff(dim=1).norm(dim=-1) < _SLIP * way) & (gone > _GOES_M)
    return carried, asked & (carried | (gone < _STANDS_M))


def _loss(motion: Motion, batch: Batch) -> Tensor:
    error = (motion.points - batch.points).norm(dim=-1)
    place = F.huber_loss(motion.points, batch.points, reduction='none', delta=0.01).sum(-1) * 1e4
    square = _squared_angle(motion.rotations, batch.rotations) * batch.turns_known[:, None, None]
    turn = _TURN * square / (1 + square / _TUMBLE)
    spread = motion.spread + 2e-3
    doubt = torch.log(spread) + error.detach() / spread
    # what moves in truth or in imagination: else grasps that hold would count for more than those
    # that do not, and the network would be an optimist
    start = batch.points[:, :1]
    ways = torch.stack([batch.points - start, motion.points.detach() - start])
    moved = (ways.norm(dim=-1) > _MOVED_M).any(0)
    # and where the commands of siblings made the difference
    weights = (batch.known & batch.scene.present[:, None]) * (
        1.0 + 3.0 * moved + 4.0 * batch.parted
    )
    loss = ((place + turn + 0.02 * doubt) * weights).sum() / weights.sum()
    # what stops a tool, and what it holds, show in how far it is off its way
    off, really_off = (torch.split(x, [3, 3, 1], -1) for x in (motion.off, _off_way(batch)))
    kinds = ((1e4, 0.01), (_TURN, 0.3), (1e4, 0.01))  # offset, turn, fingers: weight, most squared
    for mine, real, (weight, most) in zip(off, really_off, kinds, strict=True):
        tool = F.huber_loss(mine, real, reduction='none', delta=most)
        loss = loss + _STOPPED * weight * tool.sum(-1).mean()
    # else it would move what is held by pushing it, which does not turn it
    carried, asked = _carried(batch)
    asked &= ((error < _RIGHT_M) & batch.known & batch.scene.present[:, None])[:, 1:, :, None]
    held = motion.held[:, 1:].clamp(1e-4, 1 - 1e-4)
    wrong = F.binary_cross_entropy(held, carried.float(), reduction='none')
    return loss + (wrong * asked).sum() / asked.sum().clamp(min=1)
