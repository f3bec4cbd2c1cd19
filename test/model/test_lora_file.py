"""LoRA files of diffusers, peft, VideoX-Fun, Kohya and ComfyUI: applied as they were trained."""

from __future__ import annotations

import json
from pathlib import Path
import time
from typing import Any

from diffusers import WanPipeline
from diffusers.training_utils import _collate_lora_metadata
from peft import get_peft_model, LoraConfig
from peft.utils import get_peft_model_state_dict
import pytest
from safetensors.torch import load_file, save_file
import torch
from torch import Tensor

from mtv_world_ros.core.errors import CheckpointError, ConfigError
from mtv_world_ros.model.lora import Adapters
from mtv_world_ros.model.lora_file import PeftSettings
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from mtv_world_ros.training.adapter import TARGETS
from test.support.wan_files import DIM, FFN, LAYERS
from test.support.wan_lora import build, RANK, run

Pairs = dict[str, tuple[Tensor, Tensor]]
LORA = 'pytorch_lora_weights.safetensors'
#: settings of peft that say how strongly an adapter counts
SETTINGS = {
    'alpha': {'lora_alpha': 2 * RANK},
    'rslora': {'lora_alpha': 2 * RANK, 'use_rslora': True},
    'alpha_pattern': {'lora_alpha': RANK, 'alpha_pattern': {'to_q': 4 * RANK, 'ffn.net.2': 1}},
    'rank_pattern': {'lora_alpha': 2 * RANK, 'rank_pattern': {r'blocks.1.attn\d.to_k': 2}},
    'both': {
        'lora_alpha': 3,
        'use_rslora': True,
        'rank_pattern': {'to_v': 8},
        'alpha_pattern': {'attn1.to_v': 5},
    },
}


@pytest.mark.parametrize(
    'pattern', ['(a+)+', '(.*)*b', '(a|a)*', '.*.*.*.*x', 'x' * 300, '(a?){30}', r'(\w+\.)+q']
)
def test_a_pattern_that_could_take_forever_is_refused_in_time(pattern):
    settings = PeftSettings(r=4, lora_alpha=1.0, rank_pattern={pattern: 4})
    begin_s = time.process_time()
    with pytest.raises(ConfigError, match='could take forever'):
        settings.scale('a' * 60, 4)
    assert time.process_time() - begin_s < 0.5


@pytest.mark.parametrize('pattern', ['to_q', r'blocks\.\d+\.to_q', r'.*attn[12].*', r'a\+b'])
def test_patterns_that_people_write_are_matched(pattern):
    settings = PeftSettings(r=4, lora_alpha=1.0, rank_pattern={pattern: 8})
    assert settings.scale('other', 4) == 0.25


def randomize(model: torch.nn.Module) -> None:
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if '.lora_' in name:
                parameter.copy_(0.2 * torch.randn(parameter.shape, generator=generator))


def adapted(**settings: Any) -> MultiViewWanTransformer:
    """A transformer with an adapter of peft, whose output is peft's own."""
    model = build()
    model.add_adapter(
        LoraConfig(r=RANK, target_modules=TARGETS, **settings), adapter_name='default'
    )
    randomize(model)
    return model


def of_pipeline(folder: Path, **settings: Any) -> Tensor:
    model = adapted(**settings)
    WanPipeline.save_lora_weights(
        folder,
        transformer_lora_layers=get_peft_model_state_dict(model),
        **_collate_lora_metadata({'transformer': model}),
    )
    return run(model)


def of_model(folder: Path, **settings: Any) -> Tensor:
    model = adapted(**settings)
    model.save_lora_adapter(folder)
    return run(model)


def of_peft(folder: Path, **settings: Any) -> Tensor:
    model = build()
    peft = get_peft_model(model, LoraConfig(r=RANK, target_modules=TARGETS, **settings))
    randomize(peft)
    peft.save_pretrained(folder)
    return run(peft.get_base_model())


@pytest.mark.parametrize('settings', SETTINGS)
@pytest.mark.parametrize('save', [of_pipeline, of_model, of_peft])
def test_a_saved_adapter_counts_as_much_as_it_was_trained_to(tmp_path, save, settings):
    expected = save(tmp_path / 'lora', **SETTINGS[settings])
    model = build()
    assert not torch.allclose(run(model), expected, atol=0.1)
    Adapters(model).use(tmp_path / 'lora')
    torch.testing.assert_close(run(model), expected, rtol=0, atol=1e-4)


def test_a_file_of_peft_is_read_with_the_settings_beside_it(tmp_path):
    expected = of_peft(tmp_path / 'lora', lora_alpha=16)
    model = build()
    adapters = Adapters(model)
    adapters.use(tmp_path / 'lora' / 'adapter_model.safetensors')
    torch.testing.assert_close(run(model), expected, rtol=0, atol=1e-4)
    (tmp_path / 'lora' / 'adapter_config.json').unlink()
    with pytest.raises(CheckpointError, match=r'without its adapter_config\.json beside it'):
        adapters.use(tmp_path / 'lora' / 'adapter_model.safetensors')


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'use_dora': True}, 'use_dora=True is not supported'),
        ({'init_lora_weights': 'pissa'}, "init_lora_weights='pissa' is not supported"),
        ({'modules_to_save': ['proj_out']}, 'modules_to_save='),
        ({'peft_type': 'LOKR'}, "peft_type='LOKR' is not supported"),
        ({'r': 8}, 'has rank 4, the settings say 8'),
        ({'r': 0}, "'r'"),
        ({'lora_alpha': 'much'}, "'lora_alpha'"),
        ({'lora_alpha': None}, 'the settings have no lora_alpha'),
        ({'alpha_pattern': {'(': 2}}, 'is no regular expression'),
        ([1], 'must be a map of settings'),
        ('{', 'cannot be used'),
    ],
)
def test_settings_that_are_not_applied_are_refused(tmp_path, change, message):
    of_pipeline(tmp_path, lora_alpha=8)
    config = adapted(lora_alpha=8).peft_config['default'].to_dict()
    if isinstance(change, dict):
        changed = {f'transformer.{key}': value for key, value in {**config, **change}.items()}
        change = json.dumps(changed, default=list)
    text = change if isinstance(change, str) else json.dumps(change)
    tensors = load_file(tmp_path / LORA)
    save_file(tensors, tmp_path / 'changed.safetensors', {'lora_adapter_metadata': text})
    with pytest.raises(CheckpointError, match=message):
        Adapters(build()).use(tmp_path / 'changed.safetensors')


#: module names: in Wan's files, in diffusers' class, inputs, outputs
QKV = (('q', 'to_q'), ('k', 'to_k'), ('v', 'to_v'))
INNER = {
    **{f'self_attn.{wan}': (f'attn1.{ours}', DIM, DIM) for wan, ours in QKV},
    **{f'cross_attn.{wan}': (f'attn2.{ours}', DIM, DIM) for wan, ours in QKV},
    'self_attn.o': ('attn1.to_out.0', DIM, DIM),
    'cross_attn.o': ('attn2.to_out.0', DIM, DIM),
    'cross_attn.k_img': ('attn2.add_k_proj', DIM, DIM),
    'cross_attn.v_img': ('attn2.add_v_proj', DIM, DIM),
    'ffn.0': ('ffn.net.0.proj', DIM, FFN),
    'ffn.2': ('ffn.net.2', FFN, DIM),
}
MODULES = {
    f'blocks.{n}.{wan}': (f'blocks.{n}.{ours}', i, o)
    for n in range(LAYERS)
    for wan, (ours, i, o) in INNER.items()
}
HEAD = {'head.head': ('proj_out', DIM, 64)}


def factors(modules: dict[str, tuple[str, int, int]]) -> Pairs:
    generator = torch.Generator().manual_seed(7)

    def random(*shape: int) -> Tensor:
        return 0.2 * torch.randn(shape, generator=generator)

    return {name: (random(RANK, i), random(o, RANK)) for name, (_, i, o) in modules.items()}


def keys(
    pairs: Pairs, start: str, a: str, b: str, *, flat: bool = False, alpha: float = 0
) -> dict[str, Tensor]:
    found = {}
    for name, pair in pairs.items():
        module = start + (name.replace('.', '_') if flat else name)
        found |= {f'{module}{a}.weight': pair[0], f'{module}{b}.weight': pair[1]}
        if alpha:
            found[f'{module}.alpha'] = torch.tensor(alpha)
    return found


ALPHA = 2.0
DOWN = ('.lora_down', '.lora_up')
PEFT = ('.lora_A', '.lora_B')
#: styles that people share: beginning, factors, flattened names, alpha
STYLES: dict[str, tuple[str, tuple[str, str], bool, float]] = {
    'DiffSynth-Studio': ('', ('.lora_A.default', '.lora_B.default'), False, 0),
    'UniAnimate': ('pipe.dit.', ('.lora_A.default', '.lora_B.default'), False, 0),
    'ComfyUI': ('diffusion_model.', PEFT, False, 0),
    'ComfyUI with alpha': ('diffusion_model.', DOWN, False, ALPHA),
    'ComfyUI, whole model': ('model.diffusion_model.', ('.lora.down', '.lora.up'), False, ALPHA),
    'Kohya': ('lora_unet_', DOWN, True, ALPHA),
    'VideoX-Fun': ('lora_unet__', DOWN, True, ALPHA),
    'LyCORIS': ('lycoris_', DOWN, True, ALPHA),
    'diffusers before peft': ('transformer.', ('_lora.down', '_lora.up'), False, 0),
}


@pytest.mark.parametrize('style', STYLES)
def test_styles_that_people_share_add_their_product_to_the_weights(tmp_path, style):
    start, (a, b), flat, alpha = STYLES[style]
    modules = {**MODULES, **HEAD}
    pairs = factors(modules)
    save_file(keys(pairs, start, a, b, flat=flat, alpha=alpha), tmp_path / 'lora.safetensors')
    expected = build()
    with torch.no_grad():
        for name, (ours, *_) in modules.items():
            down, up = pairs[name]
            product = (alpha / RANK if alpha else 1.0) * up @ down
            expected.get_parameter(f'{ours}.weight').add_(product)
    model = build()
    before = run(model)
    Adapters(model).use(tmp_path / 'lora.safetensors')
    torch.testing.assert_close(run(model), run(expected), rtol=0, atol=1e-4)
    assert not torch.allclose(run(model), before, atol=1e-2)


@pytest.mark.parametrize('style', ['ComfyUI', 'ComfyUI with alpha', 'Kohya'])
def test_styles_that_diffusers_reads_are_applied_as_it_applies_them(tmp_path, style):
    start, (a, b), flat, alpha = STYLES[style]
    tensors = keys(factors(MODULES), start, a, b, flat=flat, alpha=alpha)
    save_file(tensors, tmp_path / 'lora.safetensors')
    theirs = build()
    theirs.load_lora_adapter(WanPipeline.lora_state_dict(tmp_path / 'lora.safetensors'))
    model = build()
    Adapters(model).use(tmp_path / 'lora.safetensors')
    torch.testing.assert_close(run(model), run(theirs), rtol=0, atol=1e-4)


Q = 'blocks.0.self_attn.q'


@pytest.mark.parametrize(
    ('key', 'value', 'message'),
    [
        ('blocks.7.self_attn.q.lora_A.weight', torch.zeros(4, DIM), r"'blocks\.7\..* is no layer"),
        ('img_emb.proj.1.lora_A.weight', torch.zeros(4, 32), 'one of its two factors'),
        ('img_emb.proj.1.alpha', torch.tensor(4.0), 'one of its two factors'),
        (f'{Q}.lora_B.default.weight', torch.zeros(99, 4), 'for another size'),
        (f'{Q}.lora_B.default.weight', torch.zeros(DIM, 4, dtype=torch.int8), 'not floats'),
        (f'{Q}.alpha', torch.ones(2), 'alpha of .* must be one number'),
        (f'{Q}.alpha', torch.tensor(float('nan')), 'no finite numbers'),
        (f'{Q}.lora_A.weight', torch.zeros(4, DIM), 'is there under two names'),
        ('lora_te_encoder.lora_down.bias', torch.zeros(4), 'it is for a text encoder'),
        ('transformer_2.proj_out.lora_A.weight', torch.zeros(4, DIM), "Wan 2.2's second"),
        (f'{Q}.diff_b', torch.zeros(DIM), 'whole differences'),
        ('diffusion_model.blocks.0.norm3.diff', torch.zeros(DIM), 'whole differences'),
        (f'{Q}.dora_scale', torch.zeros(DIM), 'DoRA scales'),
        (f'{Q}.lora_magnitude_vector', torch.zeros(DIM), 'DoRA scales'),
        (f'{Q}.lora_B.bias', torch.zeros(DIM), 'changes of biases'),
        (f'{Q}.hada_w1_a', torch.zeros(DIM, 4), 'LoHa, LoKr'),
        (f'{Q}.lokr_w1', torch.zeros(4, 4), 'LoHa, LoKr'),
        ('something', torch.zeros(4), "'something' is no factor"),
    ],
)
def test_a_file_with_a_tensor_that_finds_no_place_is_refused(tmp_path, key, value, message):
    tensors = keys(factors(MODULES), '', '.lora_A.default', '.lora_B.default')
    save_file({**tensors, key: value}, tmp_path / 'lora.safetensors')
    with pytest.raises(CheckpointError, match=message):
        Adapters(build()).use(tmp_path / 'lora.safetensors')


def test_a_file_without_tensors_is_refused(tmp_path):
    save_file({}, tmp_path / 'lora.safetensors')
    with pytest.raises(CheckpointError, match='has no tensors'):
        Adapters(build()).use(tmp_path / 'lora.safetensors')
