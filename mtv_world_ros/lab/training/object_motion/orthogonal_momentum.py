"""Gradient descent with orthogonalised momentum (Muon: Jordan et al. 2024), in float32."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

#: of x, x^3 and x^5 in an iteration, and their number: steepest at zero (Jordan et al. 2024)
_COEFFICIENTS, _ITERATIONS = (3.4445, -4.775, 2.0315), 5
_EPS = 1e-7
#: root mean square of a step by that of AdamW (Liu et al. 2025)
_ADAM_RMS = 0.2


class OrthogonalMomentum(torch.optim.Optimizer):
    """Steps along the orthogonal matrix nearest to the Nesterov momentum of a matrix's gradient.

    `torch.optim.Muon` multiplies in bfloat16, which is slow where a processor lacks it.

    Args:
        parameters: matrices.
        lr: learning rate, on the scale of AdamW's.
        momentum: share of the momentum that is kept from step to step.
        weight_decay: decoupled, times `lr`.
    """

    def __init__(
        self,
        parameters: Iterable[Tensor],
        lr: float,
        *,
        momentum: float = 0.95,
        weight_decay: float = 0.0,
    ) -> None:
        super().__init__(
            parameters, {'lr': lr, 'momentum': momentum, 'weight_decay': weight_decay}
        )

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:
        """Does a step; returns the closure's loss."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for parameter in group['params']:
                if parameter.grad is not None:
                    self._update(parameter, parameter.grad, group)
        return loss

    def _update(self, parameter: Tensor, gradient: Tensor, group: dict[str, Any]) -> None:
        state, lr = self.state[parameter], group['lr']
        if not state:
            state['momentum'] = torch.zeros_like(parameter)
        mean = state['momentum'].lerp_(gradient, 1 - group['momentum'])
        step = orthogonalised(gradient.lerp(mean, group['momentum']))
        parameter.mul_(1 - lr * group['weight_decay'])
        parameter.add_(step, alpha=-lr * _ADAM_RMS * max(parameter.shape) ** 0.5)


def orthogonalised(matrix: Tensor) -> Tensor:
    """Returns about U V^T of an (N, M) matrix U S V^T, by Newton-Schulz iterations."""
    a, b, c = _COEFFICIENTS
    is_tall = matrix.shape[0] > matrix.shape[1]
    x = matrix.T if is_tall else matrix
    x = x / x.norm().clamp(min=_EPS)
    for _ in range(_ITERATIONS):
        square = x @ x.T
        x = torch.addmm(x, torch.addmm(square, square, square, beta=b, alpha=c), x, beta=a)
    return x.T if is_tall else x
