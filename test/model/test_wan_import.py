"""Public weights become a checkpoint: every tensor accounted for, nothing else let in."""

from __future__ import annotations

import json
from pathlib import Path
import shutil

import pytest
from safetensors.torch import load_file, save_file
import torch
import yaml

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.model.trained_model import (
    load_trained_model,
    save_trained_model,
    TrainedModel,
)
from mtv_world_ros.model.wan_weights import import_weights, PartReport
from test.support.wan_files import (
    AUTOENCODER,
    CARD,
    clip_weights,
    SCHEDULER,
    TRANSFORMER,
    transformer_weights,
    umt5_weights,
    vae_model,
    write_shards,
    write_tokenizer,
    write_videox,
)

WEIGHTS = 'diffusion_pytorch_model.safetensors'


@pytest.fixture(scope='session')
def published(tmp_path_factory) -> Path:
    return write_videox(tmp_path_factory.mktemp('public') / 'Wan2.1-Fun-V1.1-tiny-Control')


@pytest.fixture
def videox(published, tmp_path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(published, tmp_path / 'videox'))


def bring_in(path: Path, out: Path, **changes: object) -> list[PartReport]:
    arguments = {
        'transformer': TRANSFORMER,
        'autoencoder': AUTOENCODER,
        'scheduler': SCHEDULER,
        'card': CARD,
    }
    return import_weights(path, out, **{**arguments, **changes})


def test_every_tensor_is_accounted_for(videox, tmp_path):
    reports = {report.part: report for report in bring_in(videox, tmp_path / 'out')}
    counts = {'transformer': transformer_weights(), 'text_encoder': umt5_weights()}
    for part, weights in counts.items():
        assert reports[part].loaded == len(weights)
        assert reports[part].parameters == sum(w.numel() for w in weights.values())
    assert reports['transformer'].new == ('view_embedding',)
    assert reports['autoencoder'].loaded == len(vae_model().state_dict())
    assert set(reports['image_encoder'].unused) == {
        'log_scale',
        'textual.head.0.weight',
        'visual.head',
    }
    written = json.loads((tmp_path / 'out' / 'import.json').read_text())
    assert [part['part'] for part in written] == list(reports)


def test_number_formats_and_values_are_kept(videox, tmp_path):
    bring_in(videox, tmp_path / 'out')
    stored = load_file(tmp_path / 'out' / 'transformer' / WEIGHTS)
    public = {k: v.bfloat16() for k, v in transformer_weights().items()}
    pairs = {
        'blocks.1.attn2.add_v_proj.weight': 'blocks.1.cross_attn.v_img.weight',
        'blocks.0.norm2.weight': 'blocks.0.norm3.weight',
        'scale_shift_table': 'head.modulation',
        'ref_conv.weight': 'ref_conv.weight',
        'patch_embedding.weight': 'patch_embedding.weight',
    }
    for ours, theirs in pairs.items():
        assert stored[ours].dtype == torch.bfloat16
        assert torch.equal(stored[ours], public[theirs]), ours
    assert stored['view_embedding'].shape == (3, 24) and not stored['view_embedding'].any()


def test_the_autoencoder_is_the_published_one(videox, tmp_path):
    bring_in(videox, tmp_path / 'out')
    loaded = load_trained_model(Checkpoint.open(tmp_path / 'out')).autoencoder
    for name, value in vae_model().state_dict().items():
        assert torch.equal(loaded.vae.state_dict()[name], value), name


def test_loads_and_saves_bit_for_bit(videox, tmp_path):
    bring_in(videox, tmp_path / 'out')
    first = load_trained_model(Checkpoint.open(tmp_path / 'out'), dtype=torch.bfloat16)
    save_trained_model(first, tmp_path / 'again', dtype=torch.bfloat16)
    second: TrainedModel = load_trained_model(
        Checkpoint.open(tmp_path / 'again'), dtype=torch.bfloat16
    )
    for name, value in first.transformer.state_dict().items():
        assert torch.equal(second.transformer.state_dict()[name], value), name
    assert second.text_encoder is not None and second.image_encoder is not None
    assert (tmp_path / 'again' / 'tokenizer' / 'tokenizer.json').is_file()
    assert type(second.scheduler).__name__ == 'UniPCMultistepScheduler'


@pytest.mark.slow
def test_shards_and_one_file_are_the_same(videox, tmp_path):
    bring_in(videox, tmp_path / 'whole')
    (videox / WEIGHTS).unlink()
    write_shards(videox, {k: v.bfloat16() for k, v in transformer_weights().items()})
    bring_in(videox, tmp_path / 'shards', shard_bytes=20_000)
    assert len(list((tmp_path / 'shards' / 'transformer').glob('*.safetensors'))) > 2
    whole, shards = (
        load_trained_model(Checkpoint.open(tmp_path / name)) for name in ('whole', 'shards')
    )
    for name, value in whole.transformer.state_dict().items():
        assert torch.equal(shards.transformer.state_dict()[name], value), name
    (videox / 'diffusion_pytorch_model.safetensors.index.json').unlink()
    bring_in(videox, tmp_path / 'without_index')


def test_a_diffusers_folder_is_read(videox, tmp_path):
    """Our own checkpoint folder is in diffusers' layout, and in transformers' names."""
    bring_in(videox, tmp_path / 'first')
    (tmp_path / 'first' / 'autoencoder').rename(tmp_path / 'first' / 'vae')
    reports = bring_in(tmp_path / 'first', tmp_path / 'second')
    assert [report.new for report in reports] == [(), (), (), ()]
    for file in (tmp_path / 'second').rglob('*.safetensors'):
        old = tmp_path / 'first' / file.relative_to(tmp_path / 'second')
        old = Path(str(old).replace('/autoencoder/', '/vae/'))
        assert load_file(file).keys() == load_file(old).keys()


def test_parts_may_lie_elsewhere(videox, tmp_path):
    other = tmp_path / 'other'
    other.mkdir()
    save_file(clip_weights(), other / 'clip.safetensors')
    next(videox.glob('models_clip*')).unlink()
    with pytest.raises(CheckpointError, match=r'holds no image_encoder.*--image-encoder'):
        bring_in(videox, tmp_path / 'out')
    reports = bring_in(
        videox / WEIGHTS,
        tmp_path / 'out',
        elsewhere={'image_encoder': other / 'clip.safetensors', 'tokenizer': None},
    )
    assert reports[3].source == str(other / 'clip.safetensors')


def change(videox: Path, drop: str = '', **put: torch.Tensor) -> None:
    weights = load_file(videox / WEIGHTS)
    weights.pop(drop, None)
    save_file({**weights, **{k.replace('__', '.'): v for k, v in put.items()}}, videox / WEIGHTS)


@pytest.mark.parametrize(
    ('drop', 'put', 'message'),
    [
        ('blocks.1.ffn.0.bias', {}, r'1 tensors are missing: blocks\.1\.ffn\.net\.0\.proj\.bias'),
        ('ref_conv.weight', {}, r"no 'ref_conv.weight'.*Expected V1\.1"),
        ('', {'control_adapter__conv__weight': (4, 4)}, r'another model: control_adapter\.conv'),
        ('', {'patch_embedding__weight': (24, 36, 1, 2, 2)}, r'takes 36 channels, expected 48'),
        ('', {'patch_embedding__weight': (32, 48, 1, 2, 2)}, r'has width 32, the preset 24'),
        ('', {'blocks__0__ffn__2__weight': (24, 41)}, r"ffn\.2\.weight' has shape \[24, 41\]"),
        ('patch_embedding.weight', {}, r'holds no Wan transformer'),
    ],
)
def test_weights_of_another_model_are_refused(videox, tmp_path, drop, put, message):
    change(videox, drop, **{name: torch.zeros(shape) for name, shape in put.items()})
    with pytest.raises(CheckpointError, match=message):
        bring_in(videox, tmp_path / 'out')
    assert not list(tmp_path.glob('out*'))


def test_another_number_of_heads_is_refused(videox, tmp_path):
    (videox / 'config.json').write_text(json.dumps({'num_heads': 12}))
    with pytest.raises(CheckpointError, match='says 12 attention heads, the preset 2'):
        bring_in(videox, tmp_path / 'out')


def test_encoders_of_another_width_are_refused(videox, tmp_path):
    narrow = {k: v[..., :16].contiguous() for k, v in umt5_weights().items()}
    save_file(narrow, videox / 'models_t5_umt5-xxl-enc-bf16.safetensors')
    with pytest.raises(CheckpointError, match='tokens of width 16, the transformer takes 32'):
        bring_in(videox, tmp_path / 'out')


def test_a_missing_shard_is_named(videox, tmp_path):
    (videox / WEIGHTS).unlink()
    write_shards(videox, transformer_weights())
    gone = 'diffusion_pytorch_model-00002-of-00003.safetensors'
    (videox / gone).unlink()
    with pytest.raises(CheckpointError, match=f'lacks the shards .*{gone}'):
        bring_in(videox, tmp_path / 'out')
    (videox / 'diffusion_pytorch_model.safetensors.index.json').unlink()
    with pytest.raises(CheckpointError, match=r'lacks shards \[2\] of 00003'):
        bring_in(videox, tmp_path / 'out')


@pytest.mark.parametrize('name', ['Wan2.1_VAE', 'models_t5_umt5-xxl-enc-bf16'])
def test_a_pickle_is_refused_unread(videox, tmp_path, name):
    (videox / f'{name}.safetensors').rename(videox / f'{name}.pth')
    with pytest.raises(CheckpointError, match=rf'{name}.pth.*never read; expected .safetensors'):
        bring_in(videox, tmp_path / 'out')


def test_a_damaged_file_is_named(videox, tmp_path):
    (videox / WEIGHTS).write_bytes((videox / WEIGHTS).read_bytes()[:500])
    with pytest.raises(CheckpointError, match='diffusion_pytorch_model.safetensors. cannot be'):
        bring_in(videox, tmp_path / 'out')


def test_an_existing_checkpoint_is_not_overwritten(videox, tmp_path):
    write_tokenizer(tmp_path / 'out')
    with pytest.raises(CheckpointError, match='exists; give --out'):
        bring_in(videox, tmp_path / 'out')


def test_the_command_prints_what_became_of_every_part(videox, tmp_path, capsys):
    preset = tmp_path / 'tiny.yaml'
    video = {'num_frames': 4, 'width': 32, 'height': 32}
    sections = {'transformer': TRANSFORMER, 'autoencoder': AUTOENCODER, 'scheduler': SCHEDULER}
    preset.write_text(yaml.safe_dump({**sections, 'video': video}))
    out = tmp_path / 'out'
    assert main(['import', 'wan', str(videox), '--preset', str(preset), '--out', str(out)]) == 0
    printed = capsys.readouterr().out
    assert 'transformer: 89 tensors, 0.0 M parameters (BF16)' in printed
    assert 'new, zero: view_embedding' in printed
    assert "left out: 1 (CLIP's temperature)" in printed
    assert load_trained_model(Checkpoint.open(out)).card.prompt.startswith(
        'The robotic arm picks up objects'
    )
    (videox / WEIGHTS).unlink()
    assert main(['import', 'wan', str(videox), '--out', str(tmp_path / 'other')]) == 1
    assert 'holds no transformer: expected a folder transformer/' in capsys.readouterr().err
