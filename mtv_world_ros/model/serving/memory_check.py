"""What serving takes of a device: found on shapes alone, before anything is loaded there."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TYPE_CHECKING
import weakref

import torch
from torch import nn, Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from mtv_world_ros.errors import ModelMemoryError
from mtv_world_ros.model.autoencoders import TinyAutoencoder, WanAutoencoder
from mtv_world_ros.model.parts import build_autoencoder
from mtv_world_ros.model.serving.serving_options import ServingOptions
from mtv_world_ros.model.transformer.cross_attention import NUM_TEXT_TOKENS
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer

if TYPE_CHECKING:
    from mtv_world_ros.model.checkpoint import Checkpoint

_GIB = 2**30
#: models with fewer bytes of weights are not looked at: they fit
_SMALL = _GIB
#: CLIP tokens of an image
_IMAGE_TOKENS = 257


def check_memory(
    checkpoint: Checkpoint, serving: ServingOptions, device: torch.device, dtype: torch.dtype
) -> None:
    """Checks that a model fits into what is free on the device now.

    Raises:
        ModelMemoryError: the model does not fit.
    """
    transformer = checkpoint.transformer
    if dtype.itemsize * sum(p.numel() for p in transformer.parameters()) < _SMALL:
        return
    weights = weight_bytes(checkpoint, serving, dtype)
    work = activation_bytes(checkpoint, serving, dtype)
    free = free_bytes(device)
    if free is not None and weights + work > free:
        raise ModelMemoryError(
            f'this model needs {(weights + work) / _GIB:.1f} GiB on {device} '
            f'({weights / _GIB:.1f} for weights, {work / _GIB:.1f} to work), '
            f'{free / _GIB:.1f} are free; {_advice(serving)}, or use a smaller preset or another '
            'device'
        )


def _advice(serving: ServingOptions) -> str:
    ways = [
        *([] if serving.offload else ['offload=true']),
        *([] if serving.tiny_decoder else ['tiny_decoder=FILE']),
    ]
    if not ways:
        return 'free memory there'
    return f"set {' or '.join(ways)} in 'serving'"


def free_bytes(device: torch.device) -> int | None:
    """Returns what a device has left; None where nobody says."""
    if device.type == 'cuda':
        return torch.cuda.mem_get_info(device)[0]
    info = Path('/proc/meminfo')
    if device.type != 'cpu' or not info.is_file():
        return None
    lines = dict(line.split(':') for line in info.read_text().splitlines())
    return int(lines['MemAvailable'].split()[0]) * 1024


def weight_bytes(checkpoint: Checkpoint, serving: ServingOptions, dtype: torch.dtype) -> int:
    """Returns what the weights take that are on the device all the time."""
    blocks = [_weights(block) for block in checkpoint.transformer.blocks]
    numbers = _weights(checkpoint.transformer)
    if serving.offload:  # one computes while the next one comes
        numbers -= sum(blocks) - 2 * max(blocks)
    if checkpoint.image_encoder is not None and not serving.offload:
        numbers += _weights(checkpoint.image_encoder.model)
    return (numbers + _weights(checkpoint.autoencoder)) * dtype.itemsize


def _weights(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def activation_bytes(checkpoint: Checkpoint, serving: ServingOptions, dtype: torch.dtype) -> int:
    """Returns the most that a pass of the transformer or decoding holds beside the weights."""
    config: Any = checkpoint.transformer.config
    spec = checkpoint.card.spec
    shape = (config['latent_channels'], spec.height // 8, spec.width // 8)
    views = len(spec.views)
    with FakeTensorMode(), _default(dtype), torch.inference_mode():
        # the blocks' peaks do not add up: one is as good as all
        transformer: Any = MultiViewWanTransformer.from_config({**config, 'num_layers': 1})
        if serving.tiny_decoder:
            decoder: Any = TinyAutoencoder()
        else:
            own: Any = checkpoint.autoencoder.config
            decoder = build_autoencoder({'_class_name': _class_name(checkpoint), **own})
        frames = decoder.num_latent_frames(spec.num_frames)
        latents = torch.empty(1, views, shape[0], frames, *shape[1:])
        image = torch.empty(1, views, *shape)
        arguments = {
            'timestep': torch.empty(1),
            'control': latents,
            'start': latents,
            'reference': image,
            'encoder_hidden_states': torch.empty(1, NUM_TEXT_TOKENS, config['text_dim']),
        }
        if before := checkpoint.card.history.num_frames:
            count = decoder.num_latent_frames(before - 1)
            arguments['history'] = torch.empty(1, views, shape[0], count, *shape[1:])
            arguments['history_timestep'] = torch.empty(1)
        if config['image_dim']:
            tokens = views * _IMAGE_TOKENS
            arguments['encoder_hidden_states_image'] = torch.empty(1, tokens, config['image_dim'])
        parts = (
            peak_bytes(lambda: transformer(latents, **arguments)),
            peak_bytes(lambda: decoder.decode(latents.flatten(0, 1))),
        )
    return max(parts)


def _class_name(checkpoint: Checkpoint) -> str:
    own = isinstance(checkpoint.autoencoder, WanAutoencoder)
    return 'AutoencoderKLWan' if own else 'SpaceToDepthAutoencoder'


@contextmanager
def _default(dtype: torch.dtype) -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def peak_bytes(work: Callable[[], object]) -> int:
    """Returns the most bytes that tensors made by `work` hold at a time."""
    with _Held() as held:
        work()
    return held.peak


class _Held(TorchDispatchMode):
    """Counts the bytes of tensors from their making to their end."""

    def __init__(self) -> None:
        super().__init__()
        self.now = self.peak = 0
        self._known: set[int] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        given = self._storages([args, kwargs])
        out = func(*args, **(kwargs or {}))
        before = {storage._cdata for storage in given}
        for storage in self._storages(out):
            if storage._cdata not in self._known and storage._cdata not in before:
                self._add(storage)
        return out

    def _add(self, storage: Any) -> None:
        size, place = storage.nbytes(), storage._cdata
        self._known.add(place)
        self.now += size
        self.peak = max(self.peak, self.now)
        weakref.finalize(storage, self._drop, place, size)

    def _drop(self, place: int, size: int) -> None:
        self._known.discard(place)
        self.now -= size

    @staticmethod
    def _storages(values: Any) -> Iterable[Any]:
        return [x.untyped_storage() for x in tree_leaves(values) if isinstance(x, Tensor)]
