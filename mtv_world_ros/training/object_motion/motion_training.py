"""`mtv-world train-motion`: from recorded episodes to an object motion network.

Shape letters: B batch, T steps, O objects.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import copy
from dataclasses import dataclass, replace
import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
import torch.nn.functional as F
from tqdm import tqdm

from mtv_world_ros.errors import MtvWorldError, TrainingError
from mtv_world_ros.files import check_free, write_whole
from mtv_world_ros.geometry.robot import RobotModel
from mtv_world_ros.model.checkpoint import OBJECT_MOTION_FOLDER
from mtv_world_ros.model.object_motion.arm_response import ArmResponse
from mtv_world_ros.model.object_motion.network import Motion, ObjectMotionNetwork, Scene
from mtv_world_ros.model.object_motion.predictor import num_features, save_network
from mtv_world_ros.training.object_motion.tracks import object_tracks, ObjectTracks

#: steps of a training window
_WINDOW = 48
#: share of the windows that begin where their episode does
_FROM_START = 0.35
#: standard deviation of where objects are thought to be at first [m]; masks of 384x288 pixels tell
#: it to .6 mm in the plane and 2 mm in height
_PLACE_NOISE_M = 0.001
#: relative one of their features
_SHAPE_NOISE = 0.02
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
#: an object has moved if it went further than this, and siblings have parted [m]
_MOVED_M = 0.01
#: of batches, the share drawn as groups of siblings, and the most siblings of a group
_SIBLINGS_SHARE, _GROUP = 0.15, 4


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionTraining:
    """How the network is trained.

    Attributes:
        steps: of the optimizer.
        batch_size: B, windows a step.
        learning_rate: largest; it warms up over 100 steps and falls as a cosine.
        forced_share: share of the training in which fewer and fewer steps start from the truth;
            after it windows run free from their first step.
        seed: of weights and windows.
        compile: with torch.compile, which needs a C++ compiler and is 1.8 times as fast.
        width: D of the network; what it goes on from is widened and computes the same at first;
            None = as it is, or 128.
        hidden: numbers that an object remembers from step to step; likewise, or 48.
    """

    steps: int = 4000
    batch_size: int = 64
    learning_rate: float = 2e-3
    forced_share: float = 0.35
    seed: int = 0
    compile: bool = False
    width: int | None = None
    hidden: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pool:
    """Tracks of one number of objects, and those of them that share a scene, by scene."""

    tracks: list[ObjectTracks]
    siblings: list[list[ObjectTracks]]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Batch:
    scene: Scene
    points: Tensor
    rotations: Tensor
    known: Tensor
    turns_known: Tensor
    parted: Tensor


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
    tracks, skipped = [], {}
    for path in tqdm(paths, desc='reading episodes', unit='ep'):
        try:
            tracks.append(object_tracks(path, robot, views, num_starts, response))
        except MtvWorldError as error:
            skipped[str(path)] = str(error)
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
    network = _network(init, num_features(tracks[0].features.shape[1]), config)
    averaged = torch.optim.swa_utils.AveragedModel(
        network, avg_fn=lambda old, new, n: old.lerp(new, 1 - min(_EMA_DECAY, _warm(int(n))))
    )
    losses: list[float] = []
    bar = tqdm(_losses(network, averaged, tracks, config), 'training', config.steps, unit='step')
    try:
        for loss in bar:
            losses.append(loss)
            bar.set_postfix(loss=f'{np.mean(losses[-50:]):.3f}')
            if len(losses) % _SAVE_EVERY == 0 or len(losses) == config.steps:
                _save(_network_of(averaged), folder, losses, response)
    except KeyboardInterrupt:
        tqdm.write(f'stopped after {len(losses)} of {config.steps} steps')
        _save(_network_of(averaged), folder, losses, response)
    return _network_of(averaged).eval()


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
        return ObjectMotionNetwork(count, width, hidden, fingertips=True)
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
    pools = _pools(tracks)
    shares = np.array([len(pool.tracks) for pool in pools]) / len(tracks)
    if config.compile:
        network.step = torch.compile(network.step)
    for step in range(config.steps):
        for optimizer in optimizers:
            for group in optimizer.param_groups:
                group['lr'] = _rate(step, config)
            optimizer.zero_grad()
        pool = pools[int(rng.choice(len(pools), p=shares))]
        groups = _drawn(pool, config.batch_size, rng)
        batch = _turned(_stacked([part for group in groups for part in _windows(group, rng)]), rng)
        forced = _forced(step / config.steps, config, batch, rng)
        loss = _loss(network(batch.scene, (batch.points, batch.rotations), forced), batch)
        if not math.isfinite(loss.item()):
            raise TrainingError(f'the loss is {loss.item()} at step {step}; lower --learning-rate')
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        if torch.isfinite(norm):
            for optimizer in optimizers:
                optimizer.step()
        averaged.update_parameters(network)
        yield loss.item()


def _optimizers(network: ObjectMotionNetwork, rate: float) -> list[torch.optim.Optimizer]:
    """Muon (Jordan et al. 2024) for matrices; AdamW for biases and what has few outputs."""
    weights: list[Tensor] = []
    others: list[Tensor] = []
    for parameter in network.parameters():
        is_matrix = parameter.ndim == 2 and len(parameter) >= _LEAST_ROWS
        (weights if is_matrix else others).append(parameter)
    return [
        torch.optim.Muon(weights, lr=rate, weight_decay=1e-4, adjust_lr_fn='match_rms_adamw'),
        torch.optim.AdamW(others, lr=rate, betas=(0.9, 0.99), weight_decay=1e-4),
    ]


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
        batch = _whole(track)
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
    progress: float, config: MotionTraining, batch: _Batch, rng: np.random.Generator
) -> Tensor:
    """(B, T) which steps start from the truth: fewer and fewer; the first of a window always."""
    share = max(0.0, 1 - progress / max(config.forced_share, 1e-6))
    size, steps = batch.points.shape[0], batch.points.shape[1] - 1
    often = rng.random((size, 1)) < 0.3 + 0.5 * share
    forced = rng.random((size, steps)) < np.where(often, 0.5 + 0.5 * share, share)
    if share == 0:
        forced[:] = False
    forced[:, 0] = True
    return torch.from_numpy(forced)


def _pools(tracks: Sequence[ObjectTracks]) -> list[_Pool]:
    pools: dict[int, list[ObjectTracks]] = {}
    scenes: dict[str, list[ObjectTracks]] = {}
    for track in tracks:
        pools.setdefault(len(track.features), []).append(track)
        if track.scene:
            scenes.setdefault(track.scene, []).append(track)
    families = [family for family in scenes.values() if len(family) > 1]
    return [
        _Pool(tracks=own, siblings=[one for one in families if len(one[0].features) == count])
        for count, own in pools.items()
    ]


def _drawn(pool: _Pool, size: int, rng: np.random.Generator) -> list[list[ObjectTracks]]:
    """A batch of `size` tracks: some in groups of siblings if there are any, others alone."""
    groups: list[list[ObjectTracks]] = []
    left = size
    while pool.siblings and left > size * (1 - _SIBLINGS_SHARE):
        family = pool.siblings[int(rng.integers(len(pool.siblings)))]
        picked = rng.permutation(len(family))[: min(_GROUP, left)]
        groups.append([family[k] for k in picked])
        left -= len(picked)
    return groups + [[pool.tracks[k]] for k in rng.integers(len(pool.tracks), size=left)]


def _windows(
    group: Sequence[ObjectTracks], rng: np.random.Generator
) -> list[dict[str, np.ndarray]]:
    """Rows of a batch: windows of tracks of one scene that begin at the same time."""
    parts, last = [], min(len(track.points) for track in group) - 1
    start = 0
    if last > _WINDOW and rng.random() >= _FROM_START:
        start = int(rng.integers(0, last - _WINDOW))
    wanted = np.arange(start, start + _WINDOW + 1)
    shown = [np.minimum(wanted, len(track.points) - 1) for track in group]
    points = np.stack([track.points[rows] for track, rows in zip(group, shown, strict=True)])
    for track, rows, own in zip(group, shown, points, strict=True):
        order = rng.permutation(len(track.features))
        noise = rng.normal(0.0, _PLACE_NOISE_M, (len(order), 3))
        scale = rng.normal(1.0, _SHAPE_NOISE, (len(order), 1, track.features.shape[2]))
        parted = (np.linalg.norm(points - own, axis=-1) > _MOVED_M).any(0)
        parts.append(_part(track, rows, order, noise, scale, parted))
    return parts


def _whole(track: ObjectTracks) -> _Batch:
    order = np.arange(len(track.features))
    rows = np.arange(len(track.points))
    parted = np.zeros((len(rows), len(order)), bool)
    return _stacked([_part(track, rows, order, np.zeros((len(order), 3)), 1.0, parted)])


def _part(
    track: ObjectTracks,
    rows: np.ndarray,
    order: np.ndarray,
    noise: np.ndarray,
    scale: np.ndarray | float,
    parted: np.ndarray,
) -> dict[str, np.ndarray]:
    """One row of a batch, its objects in an order."""
    points = (track.points + noise[np.argsort(order)])[:, order]
    return {
        'start': points[0],
        'features': track.features[order] * scale,
        'present': track.known[0][order],
        'tools': track.tools[rows],
        'gaps': track.gaps[rows],
        'points': points[rows],
        'rotations': track.rotations[rows][:, order],
        'known': track.known[rows][:, order],
        'turns_known': np.array(track.turns_known),
        'parted': parted[:, order],
    }


def _stacked(parts: Sequence[dict[str, np.ndarray]]) -> _Batch:
    def of(name: str) -> Tensor:
        values = torch.from_numpy(np.stack([part[name] for part in parts]))
        return values if values.dtype == torch.bool else values.float()

    scene = Scene(
        points=of('start'),
        features=of('features'),
        present=of('present'),
        tools=of('tools'),
        gaps=of('gaps'),
    )
    return _Batch(
        scene=scene,
        points=of('points'),
        rotations=of('rotations'),
        known=of('known'),
        turns_known=of('turns_known'),
        parted=of('parted'),
    )


def _turned(batch: _Batch, rng: np.random.Generator) -> _Batch:
    """The batch turned by a multiple of 45 degrees about the vertical, or mirrored as well.

    Contact does not know where on the table it happens. Mirrored tools have their x axis turned
    back, which two-fingered grippers do not notice.
    """
    turns, mirrored = int(rng.integers(8)), bool(rng.random() < 0.5)
    cos, sin = math.cos(turns * math.pi / 4), math.sin(turns * math.pi / 4)
    mirror = torch.diag(torch.tensor([-1.0 if mirrored else 1.0, 1.0, 1.0]))
    turn = torch.tensor([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    both, scene = turn @ mirror, batch.scene
    widths, heights = scene.features[..., :4], scene.features[..., 4:6]
    if mirrored:
        widths = widths[..., [0, 3, 2, 1]]
    widths = torch.roll(widths, turns % 4, -1)
    tools = scene.tools.clone()
    tools[..., :3, :3] = both @ scene.tools[..., :3, :3] @ mirror
    tools[..., :3, 3] = scene.tools[..., :3, 3] @ both.T
    features = torch.cat([widths, heights, scene.features[..., 6:] @ both.T], -1)
    return replace(
        batch,
        scene=replace(scene, points=scene.points @ both.T, features=features, tools=tools),
        points=batch.points @ both.T,
        rotations=both @ batch.rotations @ both.T,
    )


def _squared_angle(first: Tensor, second: Tensor) -> Tensor:
    """(...) of rotations (..., 3, 3), while it is small [rad^2]."""
    return 3 - (first.mT @ second).diagonal(dim1=-2, dim2=-1).sum(-1)


def _carried(batch: _Batch) -> tuple[Tensor, Tensor]:
    """(B, T, O, A) whether a tool carries an object in a step, and whether that is known."""
    rotations, places = batch.scene.tools[..., :3, :3], batch.scene.tools[..., :3, 3]
    offset = batch.points[:, :, :, None] - places[:, :, None]
    local = torch.einsum('btaji,btoaj->btoai', rotations, offset)
    turn = _squared_angle(rotations[:, 1:], rotations[:, :-1]).clamp(min=0).sqrt()
    way = (places.diff(dim=1).norm(dim=-1) + _LEVER_M * turn)[:, :, None]
    gone = batch.points.diff(dim=1).norm(dim=-1)[..., None]
    asked = (way > _WAY_M) & (local[:, 1:].norm(dim=-1) < _NEAR_M)
    carried = (local.diff(dim=1).norm(dim=-1) < _SLIP * way) & (gone > _GOES_M)
    return carried, asked & (carried | (gone < _STANDS_M))


def _loss(motion: Motion, batch: _Batch) -> Tensor:
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
    # else it would move what is held by pushing it, which does not turn it
    carried, asked = _carried(batch)
    asked &= ((error < _RIGHT_M) & batch.known & batch.scene.present[:, None])[:, 1:, :, None]
    held = motion.held[:, 1:].clamp(1e-4, 1 - 1e-4)
    wrong = F.binary_cross_entropy(held, carried.float(), reduction='none')
    return loss + (wrong * asked).sum() / asked.sum().clamp(min=1)
