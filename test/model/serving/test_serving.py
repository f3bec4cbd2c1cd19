"""What makes serving faster or smaller: its settings, and that it predicts the same."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

from diffusers.models.attention_dispatch import _AttentionBackendRegistry
import numpy as np
import pytest
from small_transformer import build
import torch
from torch import nn, Tensor
import torch.nn.functional as F
from wan_files import TRANSFORMER
from wan_predictions import imported, predict

from mtv_world_ros.errors import CheckpointError, ConfigError, ModelMemoryError
from mtv_world_ros.model.autoencoders import TinyAutoencoder
from mtv_world_ros.model.checkpoint import load_checkpoint
from mtv_world_ros.model.conditioning import decode_frames
from mtv_world_ros.model.parts import build_autoencoder
from mtv_world_ros.model.runtime import place
from mtv_world_ros.model.serving import memory_check, prepare
from mtv_world_ros.model.serving.prepare import Float8Linear, to_float8
from mtv_world_ros.model.serving.serving_options import ServingOptions
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from mtv_world_ros.model.world_model import DiffusionWorldModel
from mtv_world_ros.training.training_config import HistoryConfig, load_training_config


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return imported(tmp_path_factory.mktemp('wan'))


def load(folder: Path, serving: str = '', device: str = 'cpu') -> DiffusionWorldModel:
    dtype = torch.float32 if device == 'cpu' else torch.bfloat16
    options = ServingOptions.parse(serving)
    return DiffusionWorldModel(
        load_checkpoint(folder), device=device, dtype=dtype, serving=options
    )


def difference(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.abs(one.astype(int) - other)


def test_settings_are_read_from_a_text() -> None:
    assert ServingOptions.parse('') == ServingOptions()
    options = ServingOptions.parse(' fuse_lora=true  context_parallel=2 ')
    assert options == ServingOptions(fuse_lora=True, context_parallel=2)
    options = ServingOptions.parse("weights=float8 compile=false tiny_decoder='my weights/tae'")
    assert options == ServingOptions(weights='float8', tiny_decoder='my weights/tae')


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('fuse_lorra=true', r"'fuse_lorra' is not one of .*did you mean 'fuse_lora'"),
        ('fuse_lora=yes', r"fuse_lora is 'yes'; it must be true or false"),
        ('context_parallel', r"context_parallel is ''; it must be a whole number"),
        ('context_parallel=0', 'context_parallel is 0; it must be 1 or more'),
        ('context_parallel=2 fuse_lora=false', 'context_parallel, .* need fuse_lora=true'),
        ('cuda_graphs=true fuse_lora=false', 'cuda_graphs, .* need fuse_lora=true'),
        ('offload=true fuse_lora=false', 'offload and .* need fuse_lora=true'),
        ('weights=float8 fuse_lora=false', 'weights=float8 need fuse_lora=true'),
        ('weights=int4', "weights is 'int4'; it must be one of same, float8"),
        ('offload=true compile=true', 'offload and compile exclude each other'),
        ('offload=true context_parallel=2', 'offload and context_parallel exclude each other'),
        ('tiny_encoder=true', 'tiny_encoder=true needs tiny_decoder'),
        ("tiny_decoder='a b", 'cannot be read: No closing quotation'),
    ],
)
def test_wrong_settings_are_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ServingOptions.parse(text)


@pytest.mark.parametrize('serving', ['offload=true', 'attention=native', 'fuse_lora=false'])
def test_an_option_predicts_the_same(folder: Path, serving: str) -> None:
    assert difference(predict(load(folder, serving), [0]), predict(load(folder), [0])).max() <= 1


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


def test_cuda_graphs_need_cuda(folder: Path) -> None:
    with pytest.raises(ConfigError, match='cuda_graphs=true needs a CUDA device, device is cpu'):
        load(folder, 'cuda_graphs=true')


class FakeCuda:
    """What `prepare` takes of `torch.cuda`: a replay computes the captured pass once more."""

    def __init__(self) -> None:
        self.now = ['cuda:0']
        self.passes: list[Any] = []
        self.captures: list[Any] = []

    def Stream(self, device: torch.device) -> Any:
        return SimpleNamespace(device=device, wait_stream=lambda other: None)

    def CUDAGraph(self) -> Any:
        made = SimpleNamespace()
        made.replay = lambda: made.out.copy_(double(**made.inputs))
        return made

    def current_stream(self) -> Any:
        return self.Stream(torch.device(self.now[-1]))

    def graph_pool_handle(self) -> object:
        return object()

    @contextmanager
    def device(self, device: torch.device) -> Iterator[None]:
        self.now.append(str(device))
        yield
        self.now.pop()

    @contextmanager
    def stream(self, side: Any) -> Iterator[None]:
        yield

    @contextmanager
    def graph(self, made: Any, *, pool: object, stream: Any) -> Iterator[None]:
        yield
        made.inputs, made.out = self.passes[-1]
        self.captures.append((str(stream.device), self.now[-1], pool))


def double(x: Tensor) -> Tensor:
    return 2 * x


def test_a_captured_pass_reads_its_inputs_anew_on_its_own_device(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fake = FakeCuda()
    monkeypatch.setattr(torch, 'cuda', fake)

    def forward(x: Tensor, y: Tensor | None = None) -> Tensor:
        fake.passes.append(({'x': x}, double(x)))
        return fake.passes[-1][1]

    model: Any = SimpleNamespace(forward=forward)
    prepare.capture_graphs(model, torch.device('cuda:1'))
    given = [torch.full((size,), float(value)) for value, size in enumerate((2, 3, 2, 3))]
    found = [model.forward(x, y=None) for x in given]
    for x, out in zip(given, found, strict=True):  # none is overwritten by a later replay
        assert torch.equal(out, 2 * x)
    assert [capture[:2] for capture in fake.captures] == [('cuda:1', 'cuda:1')] * 2
    assert fake.captures[0][2] is fake.captures[1][2]


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


def test_a_block_compiles_without_a_break_and_without_a_compiler_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One code for both blocks; `eager` traces as on a GPU and compiles nothing."""
    model = build(TRANSFORMER).eval().requires_grad_(False)
    monkeypatch.setenv('CXX', 'no-such-compiler')
    with pytest.raises(ConfigError, match=r'needs a compiler \(.*\) on the path or named by CXX'):
        prepare.compile_blocks(model, torch.device('cpu'))
    monkeypatch.setenv('CXX', sys.executable)
    plain = model(**values(model))
    compiles = model.compile_repeated_blocks
    monkeypatch.setattr(
        model, 'compile_repeated_blocks', lambda **how: compiles(**how, backend='eager')
    )
    with torch._dynamo.config.patch(recompile_limit=1):
        prepare.compile_blocks(model, torch.device('cpu'))
        torch._dynamo.utils.counters.clear()
        torch.testing.assert_close(model(**values(model)), plain, rtol=0, atol=1e-5)
        assert torch._dynamo.utils.counters['stats']['unique_graphs'] == 1
        model(**values(model, batch=2))  # another shape, beyond torch's own limit
    assert torch._dynamo.utils.counters['stats']['unique_graphs'] == 2


def test_float8_keeps_three_bits_and_a_scale_of_each_row() -> None:
    """e4m3: half a step is 1/16 of a number, or 2^-10 of the largest's 448th where it is tiny."""
    torch.manual_seed(0)
    linear = nn.Linear(64, 48)
    with torch.no_grad():
        linear.weight[3] *= 1000  # a row of its own must not coarsen the others
    kept: Any = Float8Linear(linear)
    assert kept.weight.dtype == torch.float8_e4m3fn
    back = kept.weight.float() * kept.scale
    error = (back - linear.weight).abs()
    tiny = linear.weight.abs().amax(1, keepdim=True) / 448 * 2**-10
    assert (error <= torch.maximum(linear.weight.abs() / 16, tiny) * 1.001).all()
    x = torch.randn(5, 7, 64)
    torch.testing.assert_close(kept(x), F.linear(x, back, linear.bias), rtol=1e-4, atol=1e-4)


def test_float8_halves_the_blocks_and_stays_within_six_percent() -> None:
    model = build(TRANSFORMER).eval().requires_grad_(False)
    plain = model(**values(model))
    linear = sum(m.weight.numel() for m in model.blocks.modules() if isinstance(m, nn.Linear))
    to_float8(model)
    assert not any(isinstance(m, nn.Linear) for m in model.blocks.modules())
    kept: Any = [m.weight for m in model.blocks.modules() if isinstance(m, Float8Linear)]
    assert sum(w.numel() * w.element_size() for w in kept) == linear
    error = (model(**values(model)) - plain).square().mean().sqrt() / plain.square().mean().sqrt()
    assert 0 < error < 0.06


def test_a_float8_model_predicts_nearly_the_same_and_exchanges_no_adapter(folder: Path) -> None:
    model = load(folder, 'weights=float8')
    assert difference(predict(model, [0]), predict(load(folder), [0])).mean() < 3
    with pytest.raises(ConfigError, match='weights=float8 keeps no weights'):
        model.use_adapter(Path('adapter'))


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
    before = predict(plain, [0])
    with torch.inference_mode():
        expected = decode_frames(TinyAutoencoder.load(tiny_file), latents[0])
    assert difference(expected.numpy(), before).max() > 1
    decoded = predict(load(folder, f'tiny_decoder={tiny_file}'), [0])
    assert difference(decoded, expected.numpy()).max() <= 1
    both = predict(load(folder, f'tiny_decoder={tiny_file} tiny_encoder=true'), [0])
    assert both.shape == decoded.shape and difference(both, decoded).max() > 1


def test_the_tiny_decoder_is_for_wans_latents(folder: Path, tiny_file: Path) -> None:
    checkpoint = load_checkpoint(folder)
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
    assert memory_check.peak_bytes(work) == 4 * (3000 + 100)


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
    monkeypatch.setattr(memory_check, 'free_bytes', lambda device: 24 * 2**30)
    tiny = f'tiny_decoder={tiny_file}'
    device = torch.device('cuda')
    with pytest.raises(ModelMemoryError) as told:
        memory_check.check_memory(checkpoint, ServingOptions.parse(tiny), device, torch.bfloat16)
    # 16.40 G numbers of the transformer and 0.13 G of the autoencoder, 2 bytes each
    assert '(30.8 for weights, ' in str(told.value)
    assert "24.0 are free; set offload=true or weights=float8 in 'serving'" in str(told.value)
    offloaded = ServingOptions.parse(f'{tiny} offload=true')
    memory_check.check_memory(checkpoint, offloaded, device, torch.bfloat16)
    block = sum(p.numel() for p in checkpoint.transformer.blocks[0].parameters())
    rest = sum(p.numel() for p in checkpoint.transformer.parameters()) - 40 * block
    vae = sum(p.numel() for p in checkpoint.autoencoder.parameters())
    held = memory_check.weight_bytes(checkpoint, offloaded, torch.bfloat16)
    assert held == 2 * (rest + 2 * block + vae)


def test_a_graph_keeps_its_memory_beside_that_of_decoding(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    checkpoint: Any = preset('wan-1.3b')
    for serving, expected in (('', 5), ('cuda_graphs=true', 8)):
        peaks = iter((3, 5))
        monkeypatch.setattr(memory_check, 'peak_bytes', lambda work, peaks=peaks: next(peaks))
        options = ServingOptions.parse(serving)
        assert memory_check.activation_bytes(checkpoint, options, torch.bfloat16) == expected


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
        predict(model, [0])


_STARVED = """
import resource
import numpy as np
from mtv_world_ros.assembly import load_pipeline
from mtv_world_ros.errors import ModelMemoryError
model = load_pipeline(num_threads=1, dtype='float32').world_model
spec = model.spec
shape = (len(spec.views), 1 + spec.num_frames, spec.height, spec.width, 3)
def predict(count):
    return model.predict_batch(
        np.zeros((shape[0], *shape[2:]), np.uint8), np.zeros(shape, np.uint8),
        positions=np.zeros((shape[1], 14)), seeds=range(count), num_inference_steps=1,
        should_stop=lambda: False)
used = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()
hard = resource.getrlimit(resource.RLIMIT_AS)[1]
resource.setrlimit(resource.RLIMIT_AS, (used + 300 * 2**20, hard))
try:
    predict(400)
    print('no error')
except ModelMemoryError as error:
    print(error)
resource.setrlimit(resource.RLIMIT_AS, (hard, hard))
print(predict(1).shape == (1, shape[0], shape[1] - 1, *shape[2:]))
"""


def test_a_real_lack_of_memory_drops_the_rollout_and_the_process_goes_on() -> None:
    run = subprocess.run(
        [sys.executable, '-c', _STARVED], capture_output=True, text=True, check=False
    )
    told, goes_on = run.stdout.splitlines() or [run.stderr, '']
    assert told.startswith('out of memory on cpu with 2 views of ')
    assert "set offload=true or weights=float8 in 'serving'" in told
    assert goes_on == 'True'


@pytest.mark.gpu
@pytest.mark.parametrize(
    ('serving', 'tolerance'),
    [
        ('compile=true', 3.0),
        ('cuda_graphs=true', 0.1),
        ('compile=true cuda_graphs=true', 3.0),
        ('offload=true', 0.1),
        ('weights=float8', 6.0),
    ],
)
def test_an_option_predicts_nearly_the_same_on_a_gpu(
    folder: Path, serving: str, tolerance: float
) -> None:
    """Mean difference in bytes; kernels differ in the last bits of bfloat16."""
    plain = load(folder, device='cuda')
    quick = load(folder, serving, device='cuda')
    for seed in (0, 1):  # the second replays what the first captured
        assert difference(predict(quick, [seed]), predict(plain, [seed])).mean() < tolerance


@pytest.mark.gpu
def test_encoders_leave_the_gpu_when_blocks_are_offloaded(folder: Path) -> None:
    model = load(folder, 'offload=true', device='cuda')
    predict(model, [0])
    assert {p.device.type for p in model.image_encoder.model.parameters()} == {'cpu'}
    assert {p.device.type for b in model.transformer.blocks for p in b.parameters()} == {'cpu'}


@pytest.mark.gpu
def test_products_in_float8_on_a_gpu_are_those_of_the_cpu() -> None:
    torch.manual_seed(0)
    kept: Any = Float8Linear(nn.Linear(256, 512)).to('cuda')
    kept.bias.data = kept.bias.data.bfloat16()
    x = torch.randn(2, 100, 256, device='cuda', dtype=torch.bfloat16)
    expected = F.linear(x.float(), kept.weight.float() * kept.scale, kept.bias.float())
    error = (kept(x).float() - expected).square().mean().sqrt() / expected.square().mean().sqrt()
    assert error < 0.05


@pytest.mark.gpu
def test_blocks_in_float8_compile_on_a_gpu() -> None:
    """At widths that the device's product counts in, unlike those of the other tests."""
    widths = {'attention_head_dim': 32, 'ffn_dim': 128, 'added_kv_proj_dim': 64}
    model = build({**TRANSFORMER, **widths}).eval().requires_grad_(False)
    place(model, torch.device('cuda'), torch.bfloat16)
    kinds = {
        name: torch.float32 if name == 'timestep' else torch.bfloat16 for name in values(model)
    }
    given = {name: v.to('cuda', kinds[name]) for name, v in values(model).items()}
    with torch.inference_mode():
        plain = model(**given).float()
        to_float8(model)
        eager = model(**given).float()
        prepare.compile_blocks(model, torch.device('cuda'))
        quick = model(**given).float()
    for found in (eager, quick):
        error = (found - plain).square().mean().sqrt() / plain.square().mean().sqrt()
        assert 0 < error < 0.1
