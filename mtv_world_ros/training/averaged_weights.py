"""Trained weights: float32 master weights, their moving averages, and the working copy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from diffusers.training_utils import EMAModel
import torch
from torch import nn, Tensor

from mtv_world_ros.model.runtime import place
from mtv_world_ros.model.transformer.transformer import copy_of, MultiViewWanTransformer


class AveragedWeights:
    """A transformer in the number format of forward and backward, with its trained parameters.

    Parameters without `requires_grad` stay unchanged and take no further memory.

    Attributes:
        worker: the transformer, in the number format of forward and backward.
        master: trained parameters in float32, by name.
        ema: moving averages of these.
    """

    def __init__(
        self,
        transformer: MultiViewWanTransformer,
        device: torch.device,
        dtype: torch.dtype,
        ema_decay: float,
    ) -> None:
        trained = {n: p for n, p in transformer.named_parameters() if p.requires_grad}
        self.master: dict[str, nn.Parameter] = {
            name: nn.Parameter(parameter.detach().to(device, torch.float32, copy=True))
            for name, parameter in trained.items()
        }
        self.worker = place(transformer, device, dtype)
        parameters = dict(self.worker.named_parameters())
        self._pairs = [(parameters[name], master) for name, master in self.master.items()]
        self.ema = EMAModel(self.parameters, decay=ema_decay, use_ema_warmup=True, power=0.75)
        self.share()

    @property
    def parameters(self) -> list[nn.Parameter]:
        """The float32 weights."""
        return list(self.master.values())

    @torch.no_grad()
    def load(self, weights: dict[str, Tensor]) -> None:
        """Load float32 weights by name, also into the working copy."""
        for name, master in self.master.items():
            master.copy_(weights[name])
        self.share()

    @torch.no_grad()
    def share(self) -> None:
        """Copy the float32 weights into the working copy."""
        for worker, master in self._pairs:
            worker.copy_(master)

    @torch.no_grad()
    def collect(self) -> None:
        """Add the working copy's gradients to those in float32, and clear them."""
        for worker, master in self._pairs:
            if master.grad is None:
                # zeros if there is no gradient: all processes must sum the same tensors
                master.grad = torch.zeros_like(master)
            if worker.grad is not None:
                master.grad += worker.grad
            worker.grad = None

    @contextmanager
    def averaged_worker(self) -> Iterator[MultiViewWanTransformer]:
        """Yield the working copy with the averaged weights, which are those that will serve."""
        with torch.no_grad():
            for (worker, _), average in zip(self._pairs, self.ema.shadow_params, strict=True):
                worker.copy_(average)
        try:
            yield self.worker
        finally:
            self.share()

    def averages(self) -> dict[str, Tensor]:
        """Return the averaged float32 weights by name."""
        return dict(zip(self.master, self.ema.shadow_params, strict=True))

    def averaged(self) -> MultiViewWanTransformer:
        """Return a float32 transformer with the averaged weights."""
        whole = copy_of(self.worker)
        parameters = dict(whole.named_parameters())
        self.ema.copy_to([parameters[name] for name in self.master])
        return whole
