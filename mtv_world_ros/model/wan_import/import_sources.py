"""Where the parts of a public Wan 2.1 checkpoint lie in a folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from mtv_world_ros.errors import CheckpointError
from mtv_world_ros.model.tensor_files import INDEX, pickle_error, PICKLES

#: part: (folder in diffusers' layout, patterns of files in VideoX-Fun's layout, option, example)
PARTS = {
    'transformer': (
        ('transformer',),
        ('diffusion_pytorch_model*', '*Fun*Control*'),
        'PATH',
        'diffusion_pytorch_model.safetensors',
    ),
    'autoencoder': (
        ('autoencoder', 'vae'),
        ('*[Vv][Aa][Ee]*',),
        '--autoencoder',
        'Wan2.1_VAE.safetensors',
    ),
    'text_encoder': (
        ('text_encoder',),
        ('models_t5*', '*umt5*'),
        '--text-encoder',
        'models_t5_umt5-xxl-enc-bf16.safetensors',
    ),
    'image_encoder': (
        ('image_encoder',),
        ('models_clip*', '*clip*vit-h*', '*CLIP*'),
        '--image-encoder',
        'models_clip_open-clip-xlm-roberta-large-vit-huge-14.safetensors',
    ),
    'tokenizer': (('tokenizer', 'google/umt5-xxl'), (), '--tokenizer', 'google/umt5-xxl/'),
}


def find_sources(path: Path, given: Mapping[str, Path | None]) -> dict[str, Path]:
    """Returns file or folder of every part.

    Args:
        path: a folder in VideoX-Fun's or diffusers' layout, or the transformer's file.
        given: parts that lie elsewhere; None = look in `path`.

    Raises:
        CheckpointError: a part is nowhere, or only as a pickle; says which and where to give it.
    """
    if not path.exists():
        raise CheckpointError(f"'{path}' does not exist; name a checkpoint's folder or file")
    found = {part: place for part, place in given.items() if place is not None}
    for part, place in found.items():
        if not place.exists():
            raise CheckpointError(f"{PARTS[part][2]} '{place}' does not exist")
    if path.is_file():
        found['transformer'] = path
    for part in PARTS:
        if part not in found:
            found[part] = _find(path if path.is_dir() else path.parent, part)
    return found


def _find(folder: Path, part: str) -> Path:
    folders, patterns, option, example = PARTS[part]
    for name in folders:
        if (folder / name).is_dir():
            return folder / name
    files = sorted({file for pattern in patterns for file in folder.glob(pattern)})
    files = [file for file in files if file.is_file()]
    for suffix in (INDEX, '.safetensors'):
        readable = [file for file in files if file.name.endswith(suffix)]
        if readable:
            # shards without an index are found again by their folder
            return folder if len(readable) > 1 and part == 'transformer' else readable[0]
    pickles = [file for file in files if file.suffix in PICKLES]
    if pickles:
        raise pickle_error(pickles)
    raise CheckpointError(
        f"'{folder}' holds no {part}: expected a folder {' or '.join(folders)}/, or a file like "
        f'{example}; name it with {option}'
    )
