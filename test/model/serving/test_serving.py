"""What makes serving faster or smaller: its settings, and that it predicts the same."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

from diffusers.models.attention_dispatch import _AttentionBackendRegistry
import numpy as np
import pytest
import torch
from torch import Tensor

from mtv_world_ros.core.errors import CheckpointError, ConfigError, ModelMemoryError
from mtv_world_ros.model import serving
from mtv_world_ros.model.autoencoders import TinyAutoencoder
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.model.conditioning import decode_frames
from mtv_world_ros.model.parts import build_autoencoder
from mtv_world_ros.model.serving import ServingOptions
from mtv_world_ros.model.trained_model import load_trained_model
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from mtv_world_ros.model.world_model import DiffusionWorldModel
from mtv_world_ros.training.training_config import HistoryConfig, load_training_config
from test.support.small_transformer import build
from test.support.wan_files import TRANSFORMER
from test.support.wan_predictions import imported, predict


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return imported(tmp_path_factory.mktemp('wan'))


def load(folder: Path, serving: str = '', device: str = 'cpu') -> DiffusionWorldModel:
    dtype = torch.float32 if device == 'cpu' else torch.bfloat16
    options = ServingOptions.parse(serving)
    return DiffusionWorldModel(
        load_trained_model(Checkpoint.open(folder)), device=device, dtype=dtype, serving=options
    )


def difference(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.abs(one.astype(int) - other)


def test_settings_are_read_from_a_text() -> None:
    assert ServingOptions.parse('') == ServingOptions()
    options = ServingOptions.parse(' offload=false  compile=true ')
    assert options == ServingOptions(compile=True)
    options = ServingOptions.parse("offload=true compile=false tiny_decoder='my weights/tae'")
    assert options == ServingOptions(offload=True, tiny_decoder='my weights/tae')


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('compiled=true', r"'compiled' is not one of .*did you mean 'compile'"),
        ('compile=yes', r"compile is 'yes'; it must be true or false"),
        ('offload=true compile=true', 'offload and compile exclude each other'),
        ('tiny_encoder=true', 'tiny_encoder=true needs tiny_decoder'),
        ("tiny_decoder='a b", 'cannot be read: No closing quotation'),
    ],
)
def test_wrong_settings_are_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ServingOptions.parse(text)


@pytest.mark.parametrize('serving', ['offload=true', 'attention=native'])
def test_an_option_predicts_the_same(folder: Path, serving: str) -> None:
    assert difference(predict(load(folder, serving)), predict(load(folder))).max() <= 1


def test_offloaded_blocks_come_and_go_one_by_one(folder: Path) -> None:
    from diffusers.hooks.group_offloading import GroupOffloadingHook

    transformer: Any = load(folder, 'offload=true').transformer
    groups = [
        hook.group
        for block in transformer.blocks
        for hook in block._diffusers_hook.hooks.values()
        if isinstance(hook, GroupOffloadingHook)
    ]
    assert [group.modules for group in groups] == [[block] for block in transformer.blocks]


def test_an_unknown_attention_is_refused(folder: Path) -> None:
    with pytest.raises(ConfigError, match="attention 'fast' cannot be used: .*native"):
        load(folder, 'attention=fast')


def test_attention_is_set_for_that_model_alone(folder: Path) -> None:
    others, _ = _AttentionBackendRegistry.get_active_backend()
    blocks: Any = load(folder, 'attention=_native_math').transformer.blocks
    assert {block.attn1.processor._attention_backend for block in blocks} == {'_native_math'}
    assert _AttentionBackendRegistry.get_active_backend()[0] == others != '_native_math'


def values(model: MultiViewWanTransformer, views: int = 2, batch: int = 1) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(1)

    def random(*shape: int) -> Tensor:
        return torch.randn(batch, *shape, generator=generator)

    return {
        'hidden_states': random(views, 16, 2, 4, 4),
        'timestep': torch.full((batch,), 500.0),
        'control': random(views, 16, 2, 4, 4),
        'start': random(views, 16, 2, 4, 4),
        'reference': random(views, 16, 4, 4),
        'encoder_hidden_states': random(512, 32),
        'encoder_hidden_states_image': random(views * 17, 32),
    }


def test_compiling_without_a_compiler_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    model = build(TRANSFORMER).eval()
    monkeypatch.setenv('CXX', 'no-such-compiler')
    with pytest.raises(ConfigError, match=r'needs a compiler \(.*\) on the path or named by CXX'):
        serving.compile_blocks(model, torch.device('cpu'))


@torch.inference_mode()
def test_blocks_are_compiled_once_for_all_without_a_break(monkeypatch: pytest.MonkeyPatch) -> None:
    """`eager` traces as inductor does, and leaves the minute that g++ takes to the benchmark."""
    model = build(TRANSFORMER).eval().requires_grad_(False)
    given = [values(model, batch=batch) for batch in (1, 2)]
    plain = [model(**value) for value in given]
    compiles = model.compile_repeated_blocks
    monkeypatch.setenv('CXX', sys.executable)
    monkeypatch.setattr(
        model, 'compile_repeated_blocks', lambda **how: compiles(**how, backend='eager')
    )
    torch._dynamo.utils.counters.clear()
    with torch._dynamo.config.patch(recompile_limit=1):
        serving.compile_blocks(model, torch.device('cpu'))
        for count, (value, expected) in enumerate(zip(given, plain, strict=True), 1):
            # another shape is compiled anew, beyond torch's own limit
            torch.testing.assert_close(model(**value), expected, rtol=0, atol=1e-5)
            assert torch._dynamo.utils.counters['stats']['unique_graphs'] == count


@pytest.fixture(scope='module')
def tiny_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from safetensors.torch import save_file

    torch.manual_seed(0)
    path = tmp_path_factory.mktemp('tiny') / 'taew2_1.safetensors'
    weights = TinyAutoencoder().state_dict()
    for name, tensor in weights.items():
        if tensor.ndim > 1:  # as large as keeps the spread of what passes: something to see
            weights[name] = torch.randn(tensor.shape) / tensor[0].numel() ** 0.5
    save_file(weights, path)
    return path


def test_the_tiny_decoder_decodes_what_was_denoised(
    folder: Path, tiny_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    latents: list[Tensor] = []
    plain = load(folder)
    monkeypatch.setattr(
        'mtv_world_ros.model.world_model.decode_frames',
        lambda decoder, x: latents.append(x) or decode_frames(decoder, x),
    )
    before = predict(plain)
    with torch.inference_mode():
        expected = decode_frames(TinyAutoencoder.load(tiny_file), latents[0])
    assert difference(expected.numpy(), before).max() > 1
    decoded = predict(load(folder, f'tiny_decoder={tiny_file}'))
    assert difference(decoded, expected.numpy()).max() <= 1
    both = predict(load(folder, f'tiny_decoder={tiny_file} tiny_encoder=true'))
    assert both.shape == decoded.shape and difference(both, decoded).max() > 1


def test_the_tiny_decoder_is_for_wans_latents(folder: Path, tiny_file: Path) -> None:
    checkpoint = load_trained_model(Checkpoint.open(folder))
    other = replace(checkpoint, autoencoder=build_autoencoder({'block_size': 2}))
    with pytest.raises(CheckpointError, match="tiny_decoder decodes Wan's latents"):
        DiffusionWorldModel(other, serving=ServingOptions(tiny_decoder=str(tiny_file)))


def test_memory_held_at_most_is_counted() -> None:
    def work() -> Tensor:
        a = torch.zeros(1000)
        b = a + 1
        del a
        c = b.view(10, 100) * 2
        d = c + 1
        del b
        return d + torch.zeros(100)

    # at d: b, c and d; a is gone. Before the last sum b is gone: c, d, zeros and the sum
    assert serving.peak_bytes(work) == 4 * (3000 + 100)


def preset(name: str) -> SimpleNamespace:
    """A checkpoint of a preset without weights."""
    config = load_training_config(name)
    with torch.device('meta'):
        transformer = MultiViewWanTransformer(**config.transformer)
        autoencoder = build_autoencoder(config.autoencoder)
    card = config.replace(history=HistoryConfig(num_frames=5)).card({})
    return SimpleNamespace(
        transformer=transformer, autoencoder=autoencoder, image_encoder=None, card=card
    )


def test_what_does_not_fit_says_what_it_needs_before_it_starts(
    monkeypatch: pytest.MonkeyPatch, tiny_file: Path
) -> None:
    checkpoint = preset('wan-14b')
    monkeypatch.setattr(serving, 'free_bytes', lambda device: 24 * 2**30)
    tiny = f'tiny_decoder={tiny_file}'
    device = torch.device('cuda')
    with pytest.raises(ModelMemoryError) as told:
        serving.check_memory(checkpoint, ServingOptions.parse(tiny), device, torch.bfloat16)
    # 16.40 G numbers of the transformer and 0.13 G of the autoencoder, 2 bytes each
    assert '(30.8 for weights, ' in str(told.value)
    assert "24.0 are free; set offload=true in 'serving'" in str(told.value)
    offloaded = ServingOptions.parse(f'{tiny} offload=true')
    serving.check_memory(checkpoint, offloaded, device, torch.bfloat16)
    block = sum(p.numel() for p in checkpoint.transformer.blocks[0].parameters())
    rest = sum(p.numel() for p in checkpoint.transformer.parameters()) - 40 * block
    vae = sum(p.numel() for p in checkpoint.autoencoder.parameters())
    held = serving.weight_bytes(checkpoint, offloaded, torch.bfloat16)
    assert held == 2 * (rest + 2 * block + vae)


@pytest.mark.parametrize(
    'text',
    [
        'CUDA error: out of memory',
        'CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`',
        'cuDNN error: CUDNN_STATUS_INTERNAL_ERROR_DEVICE_ALLOCATION_FAILED',
    ],
)
def test_a_lack_of_memory_outside_torchs_own_is_named(
    folder: Path, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise RuntimeError(text)

    model = load(folder)
    monkeypatch.setattr('mtv_world_ros.model.world_model.sample_latents', fail)
    with pytest.raises(ModelMemoryError, match='out of memory on cpu with 2 views'):
        predict(model)


_STARVED = """
import resource
import numpy as np
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.model.trained_model import load_trained_model
from mtv_world_ros.control.control import ControlInputs
from mtv_world_ros.core.errors import ModelMemoryError
model = Pipeline.load(num_threads=1, dtype='float32').world_model
spec = model.spec
shape = (len(spec.views), 1 + spec.num_frames, spec.height, spec.width, 3)
def predict(scale):
    views, frames, height, width, _ = shape
    video = np.zeros((views, frames, scale * height, scale * width, 3), np.uint8)
    return model.predict(
        video[:, 0], ControlInputs.drawn(video), positions=np.zeros((frames, 14)), seed=0,
        num_inference_steps=1, should_stop=lambda: False)
used = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()
hard = resource.getrlimit(resource.RLIMIT_AS)[1]
resource.setrlimit(resource.RLIMIT_AS, (used + 300 * 2**20, hard))
try:
    predict(12)
    print('no error')
except ModelMemoryError as error:
    print(error)
resource.setrlimit(resource.RLIMIT_AS, (hard, hard))
print(predict(1).shape == (shape[0], shape[1] - 1, *shape[2:]))
"""


@pytest.mark.slow
def test_a_real_lack_of_memory_drops_the_rollout_and_the_process_goes_on() -> None:
    run = subprocess.run(
        [sys.executable, '-c', _STARVED], capture_output=True, text=True, check=False
    )
    told, goes_on = run.stdout.splitlines() or [run.stderr, '']
    assert told.startswith('out of memory on cpu with 2 views of ')
    assert "set offload=true in 'serving'" in told
    assert goes_on == 'True'


@pytest.mark.gpu
@pytest.mark.parametrize(
    ('serving', 'tolerance'),
    [
        ('compile=true', 3.0),
        ('offload=true', 0.1),
    ],
)
def test_an_option_predicts_nearly_the_same_on_a_gpu(
    folder: Path, serving: str, tolerance: float
) -> None:
    """Mean difference in bytes; kernels differ in the last bits of bfloat16."""
    plain = load(folder, device='cuda')
    quick = load(folder, serving, device='cuda')
    for seed in (0, 1):
        assert difference(predict(quick, seed=seed), predict(plain, seed=seed)).mean() < tolerance


@pytest.mark.gpu
def test_encoders_leave_the_gpu_when_blocks_are_offloaded(folder: Path) -> None:
    model = load(folder, 'offload=true', device='cuda')
    predict(model)
    assert {p.device.type for p in model.image_encoder.model.parameters()} == {'cpu'}
    assert {p.device.type for b in model.transformer.blocks for p in b.parameters()} == {'cpu'}
