"""Several object motion networks that compute beside each other, as one network of a larger batch.

A step has hundreds of small operations: three networks one after the other take three times as
long as one, stacked hardly longer.

Shape letters: M networks, B batch: row b is of network b // (B / M).
"""

from __future__ import annotations

from collections.abc import Sequence
import copy

import torch
from torch import nn, Tensor

from mtv_world_ros.model.object_motion.network import ObjectMotionNetwork, Perceptron


def stacked(networks: Sequence[ObjectMotionNetwork]) -> ObjectMotionNetwork:
    """Returns a network that computes what each of them does on its part of a batch.

    Those that are narrower, or hear less, are widened; they compute the same.

    Args:
        networks: M of them, of as many views.
    """
    if any(network.config != networks[0].config for network in networks):
        width = max(network.width for network in networks)
        hidden = max(network.hidden for network in networks)
        more = {
            'yielding': any(network.yielding for network in networks),
            'touching': any(network.touching for network in networks),
        }
        networks = [network.widened(width, hidden, **more) for network in networks]
    one = copy.deepcopy(networks[0])
    for name, module in networks[0].named_modules():
        parts = [network.get_submodule(name) for network in networks]
        if isinstance(module, nn.Linear):
            one.set_submodule(name, _Linear(parts))
        elif isinstance(module, nn.GRUCell):
            one.set_submodule(name, _Cell(parts))
    for layers in one.modules():
        if isinstance(layers, Perceptron):
            layers.product = multiplied
    if one.yielding:
        one.fingers = nn.Parameter(torch.stack([network.fingers for network in networks]))
    return one.eval()


def multiplied(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """Returns (B, ..., D') of x (B, ..., D), weights (M, D', D) and biases (M, D')."""
    count, width, given = weight.shape
    rows = x.reshape(count, x.shape[:-1].numel() // count, given)  # may be none
    out = rows @ weight.mT if bias is None else torch.baddbmm(bias[:, None], rows, weight.mT)
    return out.view(*x.shape[:-1], width)


class _Linear(nn.Module):
    """Linear layers of M networks."""

    def __init__(self, layers: Sequence[nn.Module]) -> None:
        super().__init__()
        self.weight, self.bias = (_stack(layers, name) for name in ('weight', 'bias'))

    def forward(self, x: Tensor) -> Tensor:
        return multiplied(x, self.weight, self.bias)


class _Cell(nn.Module):
    """Gated recurrent units of M networks, as `torch.nn.GRUCell` computes them."""

    def __init__(self, cells: Sequence[nn.Module]) -> None:
        super().__init__()
        self.weights = nn.ParameterList([_stack(cells, f'weight_{at}h') for at in 'ih'])
        self.biases = nn.ParameterList([_stack(cells, f'bias_{at}h') for at in 'ih'])

    def forward(self, x: Tensor, hidden: Tensor) -> Tensor:
        given, kept = (
            multiplied(value, weight, bias).chunk(3, dim=-1)
            for value, weight, bias in zip((x, hidden), self.weights, self.biases, strict=True)
        )
        reset, update = (torch.sigmoid(given[k] + kept[k]) for k in (0, 1))
        return torch.lerp(torch.tanh(given[2] + reset * kept[2]), hidden, update)


def _stack(layers: Sequence[nn.Module], name: str) -> nn.Parameter:
    return nn.Parameter(torch.stack([layer.get_parameter(name).detach() for layer in layers]))
