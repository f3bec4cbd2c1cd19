"""A graph network that carries, pushes and drops objects: one step of 0.1 s after the other.

Nodes are objects and tools. Every step an object hears of every tool (where it is in the tool's
own frame, how far the fingers are apart, by how much they overlap it) and of every other object,
and decides how far it goes along with which tool. It is translation-invariant in the plane by
construction. Overlaps are computed from the widths and heights of the masks, not learned: so a
grasp that fails for a reason that training never showed is still a matter of the same few numbers.
Contact works both ways: a hand that comes down on an object is stopped by it, and what it holds is
pressed on what lies below. So tools have a state as well: how far they are off the way on which
nothing would touch them.

Interaction networks: Battaglia et al. 2016; their use as simulators: Sanchez-Gonzalez et al. 2020.

Shape letters: B batch, O objects, A tools, T steps, D width.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import torch
from torch import nn, Tensor
import torch.nn.functional as F

from mtv_world_ros.model.object_motion.arm_response import PERIOD_S

#: between two steps [s]
STEP_S = 0.1
#: commands in a step: what is quick counts as well
COMMANDS_A_STEP = round(STEP_S / PERIOD_S)
_SCALE = 20.0  # 1 / 5 cm: lengths enter in this unit
_NEAR = 100.0  # 1 / 1 cm: clearances enter in this unit, cut off at 3
#: further than anything [m]
_FAR = 1e3
#: clearances of a tool and an object, and of two objects
_NUM_TOOL_CLEARANCES, _NUM_OBJECT_CLEARANCES = 7, 3
#: heights of two fingertips over bottom and top, now and next
_NUM_FINGERTIP_HEIGHTS = 2 * 4
#: standard deviation along x and y of an error in the plane whose mean length is 1; the largest of
#: a step [m]. A yaw errs by as much of a turn as the place of 5 cm
_EXPECTED, _LARGEST_ERROR_M = 0.8, 0.05
#: ways of an object out of a finger; the longest [m]; thickness and half the breadth of a finger
#: before they are learned [m]
_NUM_WAYS_OUT, _FARTHEST_OUT_M, _FINGER_M = 3, 0.05, 0.01
#: how much faster than the rest of the network it learns how much of a way is gone, or is not
_YIELDS_GAIN = 8.0
#: numbers that describe an object's shape, as learned
_SHAPE = 32
#: numbers that say how far a tool is off its way
_NUM_OFF = 7
#: the most of each, in 5 cm and rad
_MOST_OFF = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """What the network is given of B episodes.

    Attributes:
        points: (B, O, 3) where the objects are at first [m].
        features: (B, O, V, F) of `object_shapes`.
        present: (B, O) bool, False where the batch is padded.
        tools: (B, T + 1, A, 4, 4) T_base_tool where nothing is touched.
        gaps: (B, T + 1, A) from a tool to each of its fingers, as commanded [m].
    """

    points: Tensor
    features: Tensor
    present: Tensor
    tools: Tensor
    gaps: Tensor

    def to(self, device: torch.device | str) -> Scene:
        """Returns it on a device."""
        return Scene(**{name: getattr(self, name).to(device) for name in self.__slots__})


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """Where the objects go; row 0 is the start.

    Attributes:
        points: (B, T + 1, O, 3) [m].
        rotations: (B, T + 1, O, 3, 3) from the start.
        held: (B, T + 1, O, A) share of the motion that each tool gives.
        spread: (B, T + 1, O) expected error of `points` [m], as learned.
        off: (B, T + 1, A, 7) of the tools, see `off_way`.
    """

    points: Tensor
    rotations: Tensor
    held: Tensor
    spread: Tensor
    off: Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """Where the objects are between two steps, and what the network remembers of them.

    Attributes:
        points: (B, O, 3) [m].
        rotations: (B, O, 3, 3) from the start.
        velocity: (B, O, 6) way [m] and turn [rad] of the last step.
        hidden: (B, O, H).
        held: (B, O, A), see `Motion`.
        spread: (B, O), see `Motion`.
        off: (B, A, 7), see `Motion`; and one step before.
        off_before: see `off`.
    """

    points: Tensor
    rotations: Tensor
    velocity: Tensor
    hidden: Tensor
    held: Tensor
    spread: Tensor
    off: Tensor
    off_before: Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """Where the objects really go, and when a motion in training goes on from there.

    Attributes:
        points: (B, T + 1, O, 3) [m].
        rotations: (B, T + 1, O, 3, 3) from the start.
        known: (B, T + 1, O) bool; what is hidden is left where the motion has it.
        forced: (B, T) bool, steps that start from the truth.
        lost_m: (B,) an object further than this from the truth is lost: it goes on from the truth,
            as fast as it really is [m]; so do tools, and all tools where an object is lost.
        off: (B, T + 1, A, 7) of the tools, see `off_way`.
    """

    points: Tensor
    rotations: Tensor
    known: Tensor
    forced: Tensor
    lost_m: Tensor
    off: Tensor

    def put_right(self, now: Memory, step: int) -> Memory:
        """Returns the objects as a step starts, put where they really are if they must be."""
        points, rotations, before = self.points[:, step], self.rotations[:, step], max(step - 1, 0)
        seen = (self.known[:, step] & self.known[:, before])[..., None]  # (B, O, 1)
        away = (now.points - points).norm(dim=-1, keepdim=True)
        lost = seen & (away > self.lost_m[:, None, None])
        known = lost | (seen & self.forced[:, step][:, None, None])
        way = points - self.points[:, before]
        turn = _vector(rotations @ self.rotations[:, before].mT)
        off = (now.off - self.off[:, step])[..., :3].norm(dim=-1, keepdim=True)  # (B, A, 1)
        told = (self.forced[:, step] | lost.any(1)[:, 0])[:, None, None]
        told = told | (off > self.lost_m[:, None, None])
        return replace(
            now,
            points=torch.where(known, points, now.points),
            rotations=torch.where(known[..., None], rotations, now.rotations),
            velocity=torch.where(lost, torch.cat([way, turn], dim=-1), now.velocity),
            off=torch.where(told, self.off[:, step], now.off),
            off_before=torch.where(told, self.off[:, before], now.off_before),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Extents:
    """Sizes of objects as their masks show them, at the start.

    Attributes:
        shape: (B, O, S) as learned.
        widths: (B, O, 4) in the plane along x, the diagonal, y and the other diagonal [m]: of the
            views the least, since a mask in the plane is too long away from its camera.
        low: (B, O) lowest point, from the centre [m].
        high: (B, O) highest point, from the centre [m].
        yaw: (B, O, 2) cosine and sine of how far they have turned since.
    """

    shape: Tensor
    widths: Tensor
    low: Tensor
    high: Tensor
    yaw: Tensor

    def turned(self, rotations: Tensor) -> _Extents:
        """Returns them with the yaw of rotations (B, O, 3, 3) from the start."""
        cos = rotations[..., 0, 0] + rotations[..., 1, 1]
        sin = rotations[..., 1, 0] - rotations[..., 0, 1]
        norm = (cos**2 + sin**2 + 1e-8).sqrt()
        return replace(self, yaw=torch.stack([cos / norm, sin / norm], -1))

    def half_width(self, direction: Tensor) -> Tensor:
        """Returns (B, O, K) half the width along unit vectors (B, O, K, 2), or zeros [m]."""
        cos, sin = self.yaw[..., None, :].unbind(-1)
        x, y = direction.unbind(-1)
        x, y = cos * x + sin * y, cos * y - sin * x
        two_cos, two_sin = x * x - y * y, 2 * x * y
        a, b, c, d = (width[..., None] for width in self.widths.unbind(-1))
        # through four samples, half a turn apart from where they repeat
        mean, four = (a + b + c + d) / 4, (2 * two_cos * two_cos - 1) * (a - b + c - d) / 4
        return (mean + (two_cos * (a - c) + two_sin * (b - d)) / 2 + four).clamp(min=0.0) / 2


class Perceptron(nn.Sequential):
    """Layers whose input comes in parts that broadcast: each is multiplied before it is spread.

    Args:
        widths: of the input, the layers, the output.
    """

    def __init__(self, *widths: int) -> None:
        layers: list[nn.Module] = []
        for number, (a, b) in enumerate(zip(widths, widths[1:], strict=False)):
            layers += [nn.Linear(a, b)] + ([nn.SiLU()] if number < len(widths) - 2 else [])
        super().__init__(*layers)
        self.product: Callable[..., Tensor] = F.linear

    def forward(self, *parts: Tensor) -> Tensor:
        """Returns (..., D) of parts (..., D') whose columns lie side by side."""
        first, *rest = self
        columns = [part.shape[-1] for part in parts]
        weights = torch.split(first.get_parameter('weight'), columns, dim=-1)
        x = self.product(parts[0], weights[0], first.bias)
        for part, weight in zip(parts[1:], weights[1:], strict=True):
            x = x + self.product(part, weight)
        for layer in rest:
            x = (
                layer(x)
                if isinstance(layer, nn.SiLU)
                else self.product(x, layer.weight, layer.bias)
            )
        return x


class ObjectMotionNetwork(nn.Module):
    """See the module.

    Args:
        num_features: F times V, numbers that describe an object.
        width: D.
        hidden: numbers that an object remembers from step to step.
        fingertips: it is told how high either fingertip is over an object's bottom and top;
            differs where a tool leans.
        yielding: it may move an object just as far as a finger, or another object, would reach
            into it.
        touching: tools are pushed off their way by what they touch.
    """

    def __init__(
        self,
        num_features: int = 18,
        width: int = 128,
        hidden: int = 48,
        *,
        fingertips: bool = False,
        yielding: bool = False,
        touching: bool = False,
    ) -> None:
        super().__init__()
        self.config = {
            'num_features': num_features,
            'width': width,
            'hidden': hidden,
            'fingertips': fingertips,
            'yielding': yielding,
            'touching': touching,
        }
        self.width, self.hidden, self.fingertips = width, hidden, fingertips
        self.yielding, self.touching = yielding, touching
        self.shape = Perceptron(num_features + 1, width, _SHAPE)
        # r now, next, before (9) | rotation in the tool (6) | gaps (3) | tool: height, way (4) |
        # clearances now and next
        given = 22 + 2 * _NUM_TOOL_CLEARANCES
        tips = _NUM_FINGERTIP_HEIGHTS * fingertips + _NUM_OFF * touching
        self.tool_edge = Perceptron(given + _SHAPE + hidden + tips, width, width, width)
        # offset (3) | velocities (6) | rotation of the other (6) | clearances
        given = 15 + _NUM_OBJECT_CLEARANCES
        self.object_edge = Perceptron(given + 2 * _SHAPE + hidden, width, width)
        self.gate = nn.Linear(width, 1)
        self.push = nn.Linear(width, 6)
        # height, clearance over the table, velocity, spin, rotation
        self.node = Perceptron(2 + 3 + 3 + 6 + _SHAPE + hidden + 2 * width, width, width)
        self.free = nn.Linear(width, 6)
        self.stay = nn.Linear(width, 1)
        self.memory = nn.GRUCell(width, hidden)
        self.scale = nn.Linear(width, 1)
        still = [self.push, self.free]
        if yielding:
            self.yields = nn.Linear(width, _NUM_WAYS_OUT)
            self.fingers = nn.Parameter(torch.full((2,), _FINGER_M * _SCALE))
            self.gives_way = nn.Linear(width, 1)
            still += [self.yields, self.gives_way]
        if touching:
            # messages, what is held | tool: gaps, height, way | off
            self.tool_node = Perceptron(2 * width + 7 + _NUM_OFF, width, width)
            self.off = nn.Linear(width, 3 * _NUM_OFF)
            still.append(self.off)
        for layer in still:
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        nn.init.constant_(self.stay.bias, 2.0)
        nn.init.constant_(self.scale.bias, -6.0)

    def widened(
        self, width: int, hidden: int, *, yielding: bool = True, touching: bool = False
    ) -> ObjectMotionNetwork:
        """Returns a wider one that computes the same at first, with fingertips and what is asked.

        What is new hears everything and is not listened to at first (Net2Net: Chen et al. 2016).

        Raises:
            ValueError: it would be narrower.
        """
        if width < self.width or hidden < self.hidden:
            raise ValueError(
                f'the network is {self.width} wide and remembers {self.hidden} numbers; it cannot '
                f'shrink to {width} and {hidden}'
            )
        wider = ObjectMotionNetwork(
            self.config['num_features'],
            width,
            hidden,
            fingertips=True,
            yielding=yielding or self.yielding,
            touching=touching or self.touching,
        )
        w, h = (self.width, width), (self.hidden, hidden)
        tips = (_NUM_FINGERTIP_HEIGHTS * self.fingertips, _NUM_FINGERTIP_HEIGHTS)
        off = (_NUM_OFF * self.touching, _NUM_OFF * wider.touching)
        old, new = self.state_dict(), wider.state_dict()
        known = old['tool_edge.0.weight'].shape[1] - h[0] - tips[0] - off[0]
        blocks = {  # of the columns, (old, new), in the order in which `step` gives them
            'tool_edge.0.weight': [(known, known), h, tips, off],
            'tool_node.0.weight': [w, w, (7 + _NUM_OFF, 7 + _NUM_OFF)],
            'node.0.weight': [(14 + _SHAPE, 14 + _SHAPE), h, w, w],
        }
        for name, value in new.items():
            if name not in old:  # does nothing at first
                continue
            same = [(n, m) for n, m in zip(old[name].shape, value.shape, strict=True)]
            rows = [h] * 3 if name.startswith('memory') else same[:1]
            columns = blocks.get(name, same[-1:])
            kept = torch.tensor(_kept(rows))
            if value.ndim == 1:
                value[kept] = old[name]
            else:
                value[kept] = 0.0
                value[kept[:, None], torch.tensor(_kept(columns))] = old[name]
        return wider

    def forward(self, scene: Scene, truth: Truth | None = None) -> Motion:
        """Returns the motion over T steps.

        Args:
            scene: what is given.
            truth: for training.
        """
        return self.roll(scene, truth=truth)[0]

    def roll(
        self,
        scene: Scene,
        memory: Memory | None = None,
        *,
        skip: int = 0,
        truth: Truth | None = None,
        errors: Tensor | None = None,
    ) -> tuple[Motion, Memory]:
        """Returns the motion and what the next call is given.

        Args:
            scene: what is given.
            memory: of the call before, of which this one goes on; None = it begins.
            skip: rows of the tools that only show what was before: 1 where `memory` is given.
            truth: see `forward`.
            errors: (B, T, O, 3) standard normal numbers: by how many of the errors that the
                network expects of each step it errs along x, along y and in the yaw; None = a
                motion without them. What falls or is pushed may then end anywhere that it might.
        """
        extents = self._extents(scene)
        now = memory or self._begin(scene)
        track = [now]
        tools, gaps = (torch.cat([rows[:, :1], rows], 1) for rows in (scene.tools, scene.gaps))
        for step in range(skip, scene.tools.shape[1] - 1):
            if truth is not None:
                now = truth.put_right(now, step)
            rows = slice(step, step + 3)  # the step before, this one, the next
            moved, turned, held, hidden, more, off = self.step(
                tools[:, rows],
                gaps[:, rows],
                scene.present,
                extents.turned(now.rotations),
                now,
            )
            if errors is not None:
                moved, turned = _erring(moved, turned, more, errors[:, step - skip])
            now = Memory(
                points=moved,
                rotations=turned,
                velocity=torch.cat(
                    [moved - now.points, _vector(turned @ now.rotations.mT)], dim=-1
                ),
                hidden=hidden,
                held=held,
                spread=now.spread + more,
                off=off,
                off_before=now.off,
            )
            track.append(now)
        names = ('points', 'rotations', 'held', 'spread', 'off')
        rows_of = {name: torch.stack([getattr(m, name) for m in track], 1) for name in names}
        return Motion(**rows_of), now

    def _extents(self, scene: Scene) -> _Extents:
        features = scene.features
        described = torch.cat([features.flatten(2) * _SCALE, scene.points[..., 2:] * _SCALE], -1)
        seen = (features[..., :4] > 0).any(-1, keepdim=True)
        widths = torch.where(seen, features[..., :4], _FAR).amin(2)
        low = torch.where(seen[..., 0], features[..., 4], -_FAR).amax(2)
        high = torch.where(seen[..., 0], features[..., 5], _FAR).amin(2)
        known = seen.any(2)
        return _Extents(
            shape=self.shape(described),
            widths=torch.where(known, widths, 0.0),
            low=torch.where(known[..., 0], low, 0.0),
            high=torch.where(known[..., 0], high, 0.0),
            yaw=torch.eye(2, device=features.device)[0].expand(*scene.present.shape, 2),
        )

    def _begin(self, scene: Scene) -> Memory:
        points = scene.points
        batch, objects = scene.present.shape
        return Memory(
            points=points,
            rotations=torch.eye(3, device=points.device).expand(batch, objects, 3, 3),
            velocity=points.new_zeros(batch, objects, 6),
            hidden=points.new_zeros(batch, objects, self.hidden),
            held=points.new_zeros(batch, objects, scene.tools.shape[2]),
            spread=points.new_zeros(batch, objects),
            off=(off := points.new_zeros(batch, scene.tools.shape[2], _NUM_OFF)),
            off_before=off,
        )

    def step(
        self, tools: Tensor, gaps: Tensor, present: Tensor, extents: _Extents, now: Memory
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """One step, from the tools (B, 3, A, 4, 4) and gaps (B, 3, A) before, now and after.

        `extents` are turned as the objects are now.

        Returns points, rotations, shares of the tools, memory, what is added to the spread, and
        how far the tools are off their way.
        """
        aimed = tools[:, 2]
        if self.touching:  # as if nothing changed
            tools = tools @ _pose(torch.stack([now.off_before, now.off, now.off], 1))
        before, here, after = tools.unbind(1)
        edge, tool, seen = self._from_tools(gaps, extents, now, (before, here, after))
        told, shares = self._from_objects(present, extents, now)
        height = now.points[..., 2]
        node = self.node(
            torch.cat(
                [
                    height[..., None] * _SCALE,
                    _near(height + extents.low)[..., None],
                    now.velocity[..., :3] * _SCALE,
                    now.velocity[..., 3:],
                    now.rotations[..., :2].flatten(-2),
                    extents.shape,
                    now.hidden,
                    edge.sum(2),
                    told,
                ],
                dim=-1,
            )
        )
        hidden = self.memory(node.flatten(0, 1), now.hidden.flatten(0, 1)).unflatten(
            0, now.hidden.shape[:2]
        )
        weights = torch.cat([self.gate(edge)[..., 0], self.stay(node)], dim=-1).softmax(dim=-1)
        held = weights[..., :-1]
        off = now.off
        if self.touching:
            is_there = present[..., None, None]
            held_node = held[..., None] * node[:, :, None]
            heard = [(value * is_there).sum(1) for value in (edge, held_node)]
            apart = now.off[..., 6] + gaps[:, 1]
            stopped = off_way(here, apart, aimed, gaps[:, 2])
            off = self._next_off(self.tool_node(*heard, tool, _scaled(now.off)), stopped, now.off)
            after = aimed @ _pose(off)
            seen = _seen_from(after, _local(after, now.points), extents)
        pushed = self._pushed(edge, here, after, gaps[:, 2], seen)
        carry = after @ _inverse(here)  # (B, A, 4, 4)
        there = torch.einsum('baij,boj->boai', carry[..., :3, :3], now.points)
        there = there + carry[:, None, :, :3, 3]
        free = self.free(node)
        moved = (
            now.points
            + (held[..., None] * (there - now.points[:, :, None])).sum(2)
            + pushed[..., :3]
            + free[..., :3] / _SCALE
        )
        if shares is not None:
            moved = moved - (shares[..., None] * _ways_apart(moved, extents, now)).sum(2)
        spin = _vector(carry[..., :3, :3])  # (B, A, 3)
        turn = (held[..., None] * spin[:, None]).sum(2) + pushed[..., 3:] + free[..., 3:]
        turned = _rotation(turn) @ now.rotations
        more = F.softplus(self.scale(node.detach())[..., 0]) / _SCALE
        return moved, turned, held, hidden, more, off

    def _from_tools(
        self,
        gaps: Tensor,
        extents: _Extents,
        now: Memory,
        tools: tuple[Tensor, Tensor, Tensor],
    ) -> tuple[Tensor, Tensor, Sequence[Tensor]]:
        """Messages (B, O, A, D), tools (B, A, 7), and how the next ones see the objects."""
        before, here, after = tools
        count = here.shape[1]
        both, opened = torch.cat([here, after], 1), gaps[:, 1:].flatten(1)
        places = _local(torch.cat([both, before], 1), now.points)
        seen = _seen_from(both, places[:, :, : 2 * count], extents)
        near = [_tool_clearances(both, opened, seen, extents, now)]
        if self.fingertips:
            near.append(_fingertip_heights(both, opened, extents, now))
        turned = here[:, None, :, :3, :3].mT @ now.rotations[:, :, None]
        way = torch.einsum('baji,baj->bai', here[..., :3, :3], (after - here)[..., :3, 3])
        apart = gaps.transpose(1, 2)  # (B, A, 3)
        tool = torch.cat([apart, here[:, :, 2:3, 3], way], dim=-1) * _SCALE
        own = torch.cat([extents.shape, now.hidden], dim=-1)
        # far away is far away
        pairs = [_beside((places * _SCALE).clamp(-4, 4), count), turned[..., :2].flatten(-2)]
        clearances, *heights = (_beside(value, count) for value in near)
        off = [_scaled(now.off)[:, None]] if self.touching else []
        edge = self.tool_edge(
            torch.cat(pairs, -1), tool[:, None], clearances, own[:, :, None], *heights, *off
        )
        return edge, tool, [value[..., count:] for value in seen]

    def _next_off(self, node: Tensor, stopped: Tensor, now: Tensor) -> Tensor:
        """(B, A, 7) of tools: a share of that if they stop, or of that now, and what is added."""
        more, share, stops = self.off(node).chunk(3, dim=-1)
        # never more than either, else it would grow from step to step; and arms give way at last
        kept = now.lerp(stopped, (_YIELDS_GAIN * stops).sigmoid())
        off = more + (_YIELDS_GAIN * share).tanh() * _scaled(kept)
        return _unscaled(off.clamp(-_MOST_OFF, _MOST_OFF))

    def _pushed(
        self, edge: Tensor, here: Tensor, after: Tensor, gaps: Tensor, seen: Sequence[Tensor]
    ) -> Tensor:
        """(B, O, 6) way [m] and turn [rad] that tools give objects beside what they carry."""
        push = self.push(edge)
        frame = here[:, None, :, :3, :3]
        linear = (frame @ push[..., :3, None])[..., 0] / _SCALE
        if self.yielding:
            fingers = self.fingers.view(-1, 2) / _SCALE  # of stacked networks each has its own
            fingers = fingers.repeat_interleave(len(gaps) // len(fingers), 0)
            shares = (_YIELDS_GAIN * self.yields(edge)).tanh()
            linear = linear + (shares[..., None] * _ways_out(after, gaps, fingers, seen)).sum(-2)
        angular = (frame @ push[..., 3:, None])[..., 0]
        return torch.cat([linear, angular], -1).sum(2)

    def _from_objects(
        self, present: Tensor, extents: _Extents, now: Memory
    ) -> tuple[Tensor, Tensor | None]:
        """Messages (B, O, D) of the others, and shares (B, O, O) of how far each is given way."""
        count = now.points.shape[1]
        offset = now.points[:, None] - now.points[:, :, None]  # of the second from the first
        own = torch.cat([extents.shape, now.hidden], dim=-1)
        other = torch.cat(
            [
                now.velocity[..., :3] * _SCALE,
                now.velocity[..., 3:],
                now.rotations[..., :2].flatten(-2),
                extents.shape,
            ],
            dim=-1,
        )
        edge = self.object_edge(
            (offset * _SCALE).clamp(-6, 6),
            other[:, None],
            _object_clearances(offset, extents, now),
            own[:, :, None],
        )
        pairs = present[:, None] & ~torch.eye(count, dtype=torch.bool, device=offset.device)
        heard = (edge * pairs[..., None]).sum(2)
        if not self.yielding:
            return heard, None
        return heard, (_YIELDS_GAIN * self.gives_way(edge)[..., 0]).tanh() * pairs


def _erring(moved: Tensor, turned: Tensor, more: Tensor, errors: Tensor) -> tuple[Tensor, Tensor]:
    """Points (B, O, 3) and rotations (B, O, 3, 3) with errors (B, O, 3), see `roll`."""
    size = (_EXPECTED * more).clamp(max=_LARGEST_ERROR_M)[..., None]
    plane = F.pad(size * errors[..., :2], (0, 1))
    yaw = F.pad(size * errors[..., 2:] * _SCALE, (2, 0))
    return moved + plane, _rotation(yaw) @ turned


def off_way(tools: Tensor, gaps: Tensor, free_tools: Tensor, free_gaps: Tensor) -> Tensor:
    """Returns (..., A, 7) how far tools are off where they would be if they touched nothing.

    In the frame of the latter: offset [m], rotation vector [rad], and how much further each finger
    is from the tool [m].

    Args:
        tools: (..., A, 4, 4) T_base_tool as they are.
        gaps: (..., A) to their fingers [m].
        free_tools: (..., A, 4, 4) where nothing is touched.
        free_gaps: (..., A) as commanded [m].
    """
    pose = _inverse(free_tools) @ tools
    sine = _vector(pose[..., :3, :3])  # times the axis
    norm = sine.norm(dim=-1, keepdim=True)
    cosine = (pose[..., :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True) - 1) / 2
    turn = sine * torch.where(norm > 1e-6, torch.atan2(norm, cosine) / norm.clamp(min=1e-6), 1.0)
    return torch.cat([pose[..., :3, 3], turn, (gaps - free_gaps)[..., None]], -1)


def _pose(off: Tensor) -> Tensor:
    """(..., 4, 4) of (..., 7), see `off_way`."""
    rows = torch.cat([_rotation(off[..., 3:6]), off[..., :3, None]], -1)
    last = torch.zeros_like(rows[..., :1, :])
    last[..., 3] = 1
    return torch.cat([rows, last], -2)


def _scaled(off: Tensor) -> Tensor:
    return torch.cat([off[..., :3] * _SCALE, off[..., 3:6], off[..., 6:] * _SCALE], -1)


def _unscaled(off: Tensor) -> Tensor:
    return torch.cat([off[..., :3] / _SCALE, off[..., 3:6], off[..., 6:] / _SCALE], -1)


def _kept(blocks: Sequence[tuple[int, int]]) -> list[int]:
    """Where old entries go when each of the blocks (old size, new size) grows at its end."""
    starts = accumulate((new for _, new in blocks), initial=0)
    return [start + k for start, (old, _) in zip(starts, blocks, strict=False) for k in range(old)]


def _near(clearance: Tensor) -> Tensor:
    return (clearance * _NEAR).clamp(-3, 3)


def _beside(values: Tensor, count: int) -> Tensor:
    """(B, O, A, K * F) of values (B, O, K * A, F) of `count` A tools at K times."""
    return values.unflatten(2, (-1, count)).transpose(2, 3).flatten(3)


def _seen_from(
    tools: Tensor, places: Tensor, extents: _Extents
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(B, O, A) where objects are along x and y of tools (B, A, 4, 4), and half as wide [m].

    `places` (B, O, A, 3) are those of the objects in the tools' frames.
    """
    x, y, _ = places.unbind(-1)
    frame = tools[:, None, :, :2, :2].expand(-1, places.shape[1], -1, -1, -1)
    directions = F.normalize(frame, dim=-2, eps=1e-4)  # of the tool's x and y in the plane
    widths = extents.half_width(directions.mT.flatten(2, 3))
    across, along = widths.unflatten(2, (-1, 2)).unbind(-1)
    return x, y, across, along


def _tool_clearances(
    tools: Tensor, gaps: Tensor, seen: Sequence[Tensor], extents: _Extents, now: Memory
) -> Tensor:
    """(B, O, A, 7) of tools (B, A, 4, 4) with fingers `gaps` (B, A) away.

    By how much the object reaches past the inside of either finger, and how far it is from the
    fingers' outside; how far it is from them across their travel; how much wider it is than the
    fingers are apart; how far tips are above its top and above its bottom.
    """
    x, y, across, along = seen
    gap = gaps[:, None]
    above = tools[:, None, :, 2, 3] - now.points[..., None, 2]
    rows = [
        y + along - gap,
        -y + along - gap,
        y.abs() - along - gap,
        x.abs() - across,
        along - gap,
        above - extents.high[..., None],
        above - extents.low[..., None],
    ]
    return _near(torch.stack(rows, -1))


def _ways_out(tools: Tensor, gaps: Tensor, fingers: Tensor, seen: Sequence[Tensor]) -> Tensor:
    """(B, O, A, 3, 3) how far an object would have to go so that no finger is in its place [m].

    Out of the nearer finger: away from the tool, across the fingers' travel, towards the tool.
    `fingers` (B, 2) are thickness and half the breadth of a finger [m].
    """
    x, y, across, along = seen
    gap = gaps[:, None]
    to_x, to_y = tools[:, None, :, :3, :2].unbind(-1)
    thickness, breadth = fingers[:, None, None].unbind(-1)
    depths = [
        (gap + thickness + along - y.abs(), y.sign(), to_y),
        (breadth + across - x.abs(), x.sign(), to_x),
        (y.abs() + along - gap, -y.sign(), to_y),
    ]
    rows = [(d.clamp(0.0, _FARTHEST_OUT_M) * sign)[..., None] * way for d, sign, way in depths]
    return torch.stack(rows, -2)


def _fingertip_heights(tools: Tensor, gaps: Tensor, extents: _Extents, now: Memory) -> Tensor:
    """(B, O, A, 4) how far either tip is above an object's bottom, and above its top."""
    rise = tools[..., 2, 1] * gaps
    tips = tools[..., 2, 3][..., None] + torch.stack([rise, -rise], -1)  # (B, A, 2)
    bottom, top = (now.points[..., 2] + e for e in (extents.low, extents.high))
    over = [tips[:, None] - level[..., None, None] for level in (bottom, top)]
    return _near(torch.cat(over, -1))


def _object_clearances(offset: Tensor, extents: _Extents, now: Memory) -> Tensor:
    """(B, O, O, 3) of the second object from the first: in the plane, above it, below it."""
    plane = offset[..., :2]
    distance = plane.norm(dim=-1)
    direction = plane / distance.clamp(min=1e-4)[..., None]
    half = extents.half_width(direction)
    half = half + half.transpose(1, 2)  # the width is the same to either side
    bottom, top = now.points[..., 2] + extents.low, now.points[..., 2] + extents.high
    rows = [
        distance - half,
        bottom[:, None] - top[:, :, None],
        bottom[:, :, None] - top[:, None],
    ]
    return _near(torch.stack(rows, -1))


def _ways_apart(moved: Tensor, extents: _Extents, now: Memory) -> Tensor:
    """(B, O, O, 3) how far the second object would reach into the first, more than now [m]."""
    offset = now.points[:, None, :, :2] - now.points[:, :, None, :2]
    direction = F.normalize(offset, dim=-1, eps=1e-4)
    half = extents.half_width(direction)
    apart = half + half.transpose(1, 2)
    after = moved[:, None, :, :2] - moved[:, :, None, :2]
    free = (offset.norm(dim=-1) - apart).clamp(min=0.0)
    depth = ((offset - after) * direction).sum(-1) - free
    return F.pad(depth.clamp(0.0, _FARTHEST_OUT_M)[..., None] * direction, (0, 1))


def _local(tools: Tensor, points: Tensor) -> Tensor:
    """(B, O, A, 3) points in the frames of tools (B, A, 4, 4)."""
    offset = points[:, :, None] - tools[:, None, :, :3, 3]
    return torch.einsum('baji,boaj->boai', tools[..., :3, :3], offset)


def _inverse(poses: Tensor) -> Tensor:
    R = poses[..., :3, :3].mT
    out = torch.zeros_like(poses)
    out[..., :3, :3] = R
    out[..., :3, 3] = -(R @ poses[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1
    return out


def _rotation(vector: Tensor) -> Tensor:
    """(..., 3, 3) of rotation vectors (..., 3) [rad]."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    square = (vector * vector).sum(-1)[..., None, None]
    angle = (square + 1e-12).sqrt()
    a, b = torch.sinc(angle / torch.pi), 0.5 * torch.sinc(angle / (2 * torch.pi)) ** 2
    return torch.eye(3, device=vector.device) + a * skew + b * (skew @ skew)


def _vector(rotations: Tensor) -> Tensor:
    """(..., 3) rotation vectors [rad] of small rotations, to first order."""
    R = rotations
    return 0.5 * torch.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1
    )
