"""Trained weights: float32 master weights, their moving averages, and the working copy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
import warnings

from diffusers.training_utils import EMAModel
import torch
from torch import nn, Tensor
import torch.distributed.checkpoint.state_dict as full_states
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import fully_shard, MixedPrecisionPolicy
from torch.distributed.tensor import DTensor
from torch.nn.parallel import DistributedDataParallel

from mtv_world_ros.model.runtime import place
from mtv_world_ros.model.transformer.transformer import copy_of, MultiViewWanTransformer
from mtv_world_ros.training.distributed import Processes


class AveragedWeights:
    """A transformer in the number format of forward and backward, with its trained parameters.

    Every process has all of them; `DistributedDataParallel` averages gradients over the processes
    during the backward pass. Parameters without `requires_grad` stay unchanged and take no
    further memory.

    Attributes:
        worker: the transformer, in the number format of forward and backward.
        model: what forward passes of training call: the worker, or the worker wrapped by torch.
        dtype: number format of forward and backward.
        master: trained parameters in float32, by name.
        ema: moving averages of these.
    """

    def __init__(
        self,
        transformer: MultiViewWanTransformer,
        processes: Processes,
        dtype: torch.dtype,
        ema_decay: float,
    ) -> None:
        trained = {n: p for n, p in transformer.named_parameters() if p.requires_grad}
        self.dtype, self._is_main = dtype, processes.is_main
        self.master: dict[str, nn.Parameter] = {
            name: nn.Parameter(parameter.detach().to(processes.device, torch.float32, copy=True))
            for name, parameter in trained.items()
        }
        self.worker = place(transformer, processes.device, dtype)
        parameters = dict(self.worker.named_parameters())
        self._pairs = [(parameters[name], master) for name, master in self.master.items()]
        self.ema = _averages(self.parameters, ema_decay)
        self.share()
        self.model: nn.Module = self.worker
        if processes.count > 1:
            self.model = DistributedDataParallel(self.worker, gradient_as_bucket_view=True)
            self.model.broadcast_buffers = False  # buffers are constants

    @property
    def parameters(self) -> list[nn.Parameter]:
        """The float32 weights."""
        return list(self.master.values())

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
                # zeros if there is no gradient: weights decay in all processes alike
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

    def start_from(self, weights: dict[str, Tensor]) -> None:
        """Begin with whole weights of all parameters, by name, which are their averages, too."""
        self.worker.load_state_dict(weights)
        with torch.no_grad():
            for name, master in self.master.items():
                master.copy_(weights[name])
        self.share()
        self._restart_averages()

    def _restart_averages(self) -> None:
        self.ema.shadow_params = [p.detach().clone() for p in self.parameters]

    def averages(self) -> dict[str, Tensor]:
        """Return the averaged float32 weights by name.

        All processes have to call this; those beside the main one get none.
        """
        if not self._is_main:
            return {}
        return dict(zip(self.master, self.ema.shadow_params, strict=True))

    def averaged(self) -> MultiViewWanTransformer | None:
        """Return a float32 transformer with the averaged weights.

        All processes have to call this; those beside the main one get None.
        """
        if not self._is_main:
            return None
        whole = copy_of(self.worker)
        parameters = dict(whole.named_parameters())
        self.ema.copy_to([parameters[name] for name in self.master])
        return whole


class ShardedWeights(AveragedWeights):
    """Trained parameters of which every process holds a share, by torch's `fully_shard` (FSDP2).

    Gradients, averages and the state of the optimizer are shared out, too. A block's parameters
    are gathered in the number format of forward and backward for the time of its turn; gradients
    are averaged in float32. Times are embedded in float32.

    `master` holds the worker's own parameters. `averaged_worker` is not there: whether a process
    imagines depends on its clips, and all would have to.
    """

    def __init__(
        self,
        transformer: MultiViewWanTransformer,
        processes: Processes,
        dtype: torch.dtype,
        ema_decay: float,
    ) -> None:
        # parameters move to the device block by block: the whole need not fit there
        whole: Any = nn.Module.to(transformer, torch.float32)
        for parameter in whole.parameters():
            parameter.data = parameter.data.contiguous()
        self.dtype, self._is_main = dtype, processes.is_main
        mesh = init_device_mesh(processes.device.type, (processes.count,))
        compute = MixedPrecisionPolicy(dtype, torch.float32, cast_forward_inputs=False)
        times = MixedPrecisionPolicy(torch.float32, torch.float32, cast_forward_inputs=False)
        fully_shard(whole.condition_embedder.time_embedder, mesh=mesh, mp_policy=times)
        for block in whole.blocks:
            fully_shard(block, mesh=mesh, mp_policy=compute)
        fully_shard(whole, mesh=mesh, mp_policy=compute)
        if processes.device.type == 'cpu':  # gloo sums, but does not average
            whole.set_force_sum_reduction_for_comms(True)
        for buffer in whole.buffers():
            buffer.data = buffer.data.to(processes.device)
        # no output of a block is changed in place
        warnings.filterwarnings('ignore', message='FSDP2-wrapped module .* returned a view')
        self.worker = self.model = whole
        self.master = {n: p for n, p in whole.named_parameters() if p.requires_grad}
        self._pairs = []
        self.ema = _averages(self.parameters, ema_decay)

    def start_from(self, weights: dict[str, Tensor]) -> None:
        """Begin with whole weights of all parameters, by name, which are their averages, too."""
        options = full_states.StateDictOptions(full_state_dict=True)
        full_states.set_model_state_dict(self.worker, dict(weights), options=options)
        self._restart_averages()

    @torch.no_grad()
    def collect(self) -> None:
        """Set zeros where a weight got no gradient; the others are in place."""
        for master in self.parameters:
            if master.grad is None:
                master.grad = torch.zeros_like(master)

    def averages(self) -> dict[str, Tensor]:
        """Return the averaged whole float32 weights by name.

        All processes have to call this; those beside the main one get none.
        """
        found = {}
        for name, average in zip(self.master, self.ema.shadow_params, strict=True):
            assert isinstance(average, DTensor)
            whole = average.full_tensor()
            if self._is_main:
                found[name] = whole.cpu()
        return found

    def averaged(self) -> MultiViewWanTransformer | None:
        """Return a float32 transformer with the averaged weights.

        All processes have to call this; those beside the main one get None.
        """
        options = full_states.StateDictOptions(full_state_dict=True, cpu_offload=True)
        held = full_states.get_model_state_dict(self.worker, options=options)
        held |= self.averages()
        if not self._is_main:
            return None
        whole: Any = MultiViewWanTransformer.from_config(self.worker.config)
        whole.load_state_dict(held)
        return whole


def _averages(parameters: list[nn.Parameter], decay: float) -> EMAModel:
    return EMAModel(parameters, decay=decay, use_ema_warmup=True, power=0.75)
