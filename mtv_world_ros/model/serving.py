"""Serving of a model: options, their effect, and the check of the device's memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
import os
from pathlib import Path
import shlex
import shutil
from typing import Any, Self, TYPE_CHECKING
import weakref

from diffusers.models.attention_dispatch import _AttentionBackendRegistry
from diffusers.models.autoencoders.autoencoder_kl_wan import WanRMS_norm
from pydantic import model_validator
import torch
from torch import nn, Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from mtv_world_ros.core.config import Schema, validated
from mtv_world_ros.core.errors import CheckpointError, ConfigError, ModelMemoryError
from mtv_world_ros.model.autoencoders import TinyAutoencoder, WanAutoencoder
from mtv_world_ros.model.parts import Autoencoder, build_autoencoder
from mtv_world_ros.model.runtime import place
from mtv_world_ros.model.transformer.block import NUM_TEXT_TOKENS
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer


def prepare(
    transformer: MultiViewWanTransformer, serving: ServingOptions, device: torch.device
) -> None:
    """Change the transformer in place, with its adapter in it.

    Raises:
        ConfigError: an option is not for this machine.
    """
    if serving.attention:
        _set_attention(transformer, serving.attention)
    if serving.offload:
        # each block comes while the one before computes; a CPU has no streams for that
        transformer.enable_group_offload(
            onload_device=device,
            offload_device=torch.device('cpu'),
            offload_type='block_level',
            num_blocks_per_group=1,
            use_stream=device.type == 'cuda',
        )
    if serving.compile:
        compile_blocks(transformer, device)


def _set_attention(transformer: MultiViewWanTransformer, name: str) -> None:
    before, _ = _AttentionBackendRegistry.get_active_backend()
    try:
        transformer.set_attention_backend(name)
    except (ValueError, RuntimeError, ImportError) as error:
        raise ConfigError(f"serving: attention '{name}' cannot be used: {error}") from error
    finally:
        # diffusers sets it for all other models of the process, too
        _AttentionBackendRegistry.set_active_backend(before)


def decoder_of(
    autoencoder: Autoencoder, serving: ServingOptions, dtype: torch.dtype
) -> Autoencoder:
    """Return the decoder: the autoencoder on its device, or the tiny autoencoder.

    Raises:
        CheckpointError: the tiny one's weights cannot be read, or are for other latents.
    """
    if not serving.tiny_decoder:
        return autoencoder
    if not isinstance(autoencoder, WanAutoencoder):
        raise CheckpointError(
            "tiny_decoder decodes Wan's latents, this checkpoint has an autoencoder of its own; "
            "leave it out of 'serving'"
        )
    return place(TinyAutoencoder.load(Path(serving.tiny_decoder)), autoencoder.device, dtype)


#: shapes that may be compiled, by the number of views; torch gives up after 8
_MOST_SHAPES = 64
_COMPILERS = {'cpu': ('CXX', ('g++', 'clang++')), 'cuda': ('CC', ('gcc', 'clang', 'cc'))}


def compile_blocks(transformer: MultiViewWanTransformer, device: torch.device) -> None:
    """Compile the transformer's repeated block; another input shape compiles it again.

    Raises:
        ConfigError: there is no compiler to do it.
    """
    variable, names = _COMPILERS.get(device.type, _COMPILERS['cuda'])
    named = os.environ.get(variable)
    if not any(shutil.which(name) for name in ([named] if named else names)):
        raise ConfigError(
            f'serving: compile=true needs a compiler ({" or ".join(names)}) on the path or named '
            f'by {variable}; install one (apt install g++), or leave it out'
        )
    limits = torch._dynamo.config
    limits.recompile_limit = max(limits.recompile_limit, _MOST_SHAPES)
    transformer.compile_repeated_blocks(fullgraph=True, dynamic=False)


def compile_norms(autoencoder: Autoencoder) -> None:
    """Make each norm of Wan's autoencoder one kernel, channels last: on a GPU it waits for them.

    On a CPU nothing changes: compiling takes longer there than it gains.
    """
    if not isinstance(autoencoder, WanAutoencoder) or autoencoder.device.type != 'cuda':
        return
    for parameter in autoencoder.parameters():
        if parameter.ndim == 5:
            parameter.data = parameter.data.to(memory_format=torch.channels_last_3d)
    for module in autoencoder.modules():
        if isinstance(module, WanRMS_norm):
            module.compile(dynamic=False)


class ServingOptions(Schema):
    """Options of serving a checkpoint; the defaults change nothing.

    Attributes:
        compile: compile the transformer's repeated block, and on a GPU the norms of Wan's
            autoencoder; loading waits for it.
        attention: diffusers' name of the attention's implementation; empty = torch's choice.
        offload: keep the transformer's blocks on the CPU, each on the device for its turn alone.
        tiny_decoder: file of TAEHV's `taew2_1` weights that decode in place of Wan's autoencoder.
        tiny_encoder: the tiny autoencoder encodes, too.
    """

    section = ''

    compile: bool = False
    attention: str = ''
    offload: bool = False
    tiny_decoder: str = ''
    tiny_encoder: bool = False

    @model_validator(mode='after')
    def _go_together(self) -> Self:
        if self.offload and self.compile:
            # an offloaded block is elsewhere each time, which compiled code does not expect
            raise ValueError('offload and compile exclude each other')
        if self.tiny_encoder and not self.tiny_decoder:
            raise ValueError("tiny_encoder=true needs tiny_decoder, the weights' file")
        return self

    @classmethod
    def parse(cls, text: str) -> ServingOptions:
        """Parse options separated by spaces, such as `compile=true tiny_decoder=FILE`.

        A value with spaces stands in quotes.

        Raises:
            ConfigError: an unknown name or a value that is not one.
        """
        values = {}
        for part in _words(text):
            name, _, value = part.partition('=')
            if name not in cls.model_fields:
                known = list(cls.model_fields)
                raise ConfigError.unknown('serving:', name, known)
            is_text = isinstance(cls.model_fields[name].default, str)
            values[name] = value if is_text else _plain(value)
        return validated(cls, values, 'serving')


def _plain(value: str) -> Any:
    return {'true': True, 'false': False}.get(value, value)


def _words(text: str) -> list[str]:
    try:
        return shlex.split(text)
    except ValueError as error:
        raise ConfigError(f"serving: '{text}' cannot be read: {error}") from error


if TYPE_CHECKING:
    from mtv_world_ros.model.trained_model import TrainedModel

_GIB = 2**30
#: models with fewer bytes of weights are not looked at: they fit
_SMALL = _GIB
#: CLIP tokens of an image
_IMAGE_TOKENS = 257


def check_memory(
    checkpoint: TrainedModel, serving: ServingOptions, device: torch.device, dtype: torch.dtype
) -> None:
    """Check that a model fits into the free memory of the device.

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
    """Return the free memory of a device; None = unknown."""
    if device.type == 'cuda':
        return torch.cuda.mem_get_info(device)[0]
    info = Path('/proc/meminfo')
    if device.type != 'cpu' or not info.is_file():
        return None
    lines = dict(line.split(':') for line in info.read_text().splitlines())
    return int(lines['MemAvailable'].split()[0]) * 1024


def weight_bytes(checkpoint: TrainedModel, serving: ServingOptions, dtype: torch.dtype) -> int:
    """Return the size of the weights that stay on the device."""
    blocks = [_weights(block) for block in checkpoint.transformer.blocks]
    numbers = _weights(checkpoint.transformer)
    if serving.offload:  # one computes while the next one comes
        numbers -= sum(blocks) - 2 * max(blocks)
    if checkpoint.image_encoder is not None and not serving.offload:
        numbers += _weights(checkpoint.image_encoder.model)
    return (numbers + _weights(checkpoint.autoencoder)) * dtype.itemsize


def _weights(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def activation_bytes(checkpoint: TrainedModel, serving: ServingOptions, dtype: torch.dtype) -> int:
    """Return the peak memory of a pass of the transformer or of decoding, without weights."""
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


def _class_name(checkpoint: TrainedModel) -> str:
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
    """Return the peak number of bytes of the tensors that `work` makes."""
    with _Held() as held:
        work()
    return held.peak


class _Held(TorchDispatchMode):
    """Counter of the bytes of the tensors that are alive."""

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
