"""Public vision models from a local folder: found by type, checked, loaded without pickle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mtv_world_ros.core.bounded_input import check_weights, read_json, require_regular
from mtv_world_ros.core.errors import CheckpointError, ConfigError
from mtv_world_ros.core.network_sizes import check_sizes

#: `model_type` in a folder's config.json -> (class in transformers, a public name of it)
VISION_MODELS = {
    'mm-grounding-dino': (
        'MMGroundingDinoForObjectDetection',
        'openmmlab-community/mm_grounding_dino_tiny_o365v1_goldg_v3det',
    ),
    'sam2_video': ('Sam2VideoModel', 'facebook/sam2.1-hiera-tiny'),
    'sam3_video': ('Sam3VideoModel', 'facebook/sam3'),
}


#: the environment variable that names the folder of public weights
WEIGHTS_VARIABLE = 'MTV_WORLD_WEIGHTS'


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmenterOptions:
    """Options of a segmenter: name, weights, device.

    Attributes:
        name: name that the user chose.
        weights: folder of public weights, at any depth up to two; None = there is none.
        device: device of the models: `cpu`, `cuda`, ...
    """

    name: str
    weights: Path | None = None
    device: str = 'cpu'

    def has_models(self, *kinds: str) -> bool:
        """Return whether the folder of weights has these models, keys of `VISION_MODELS`.

        Raises:
            ConfigError: `weights` is no folder.
        """
        return self.weights is not None and set(kinds) <= set(find_weights(self.weights))

    def folders(self, *kinds: str) -> tuple[Path, ...]:
        """Return the folders of these models.

        Raises:
            ConfigError: there is no folder of weights, or a model is not in it.
        """
        if self.weights is None:
            raise ConfigError(
                f"segmenter is '{self.name}', whose weights are looked for in the folder that "
                f'{WEIGHTS_VARIABLE} names; it is not set'
            )
        found = find_weights(self.weights)
        missing = [kind for kind in kinds if kind not in found]
        if missing:
            names = ', '.join(f'{kind} ({VISION_MODELS[kind][1]})' for kind in missing)
            raise ConfigError(f"segmenter is '{self.name}', but '{self.weights}' holds no {names}")
        return tuple(found[kind] for kind in kinds)


def find_weights(root: Path) -> dict[str, Path]:
    """Return the folders of vision models in or up to two levels below a folder, by type.

    The folders' names do not matter; of two models of a type the first by name is taken.

    Raises:
        ConfigError: `root` is no folder.
    """
    if not root.is_dir():
        raise ConfigError(
            f"'{root}' is no folder; set MTV_WORLD_WEIGHTS to the folder that holds the weights, "
            'or unset it to segment by colour'
        )
    found: dict[str, Path] = {}
    for pattern in ('config.json', '*/config.json', '*/*/config.json'):
        for config in sorted(root.glob(pattern)):
            kind = _model_type(config)
            if kind in VISION_MODELS:
                found.setdefault(kind, config.parent)
    return found


def load_vision_model(folder: Path, kind: str, device: str) -> Any:
    """Return a model of `transformers`, float32, in evaluation mode.

    Args:
        folder: folder as `hf download <name> --local-dir <folder>` leaves it.
        kind: the `model_type` that its config.json must have, a key of `VISION_MODELS`.
        device: `cpu`, `cuda`, ...

    Raises:
        CheckpointError: files are missing, broken, or of another model.
        ConfigError: transformers is not installed.
    """
    class_name, public_name = VISION_MODELS[kind]
    _check_folder(folder, kind, public_name)
    transformers = import_transformers()
    from safetensors import SafetensorError
    import torch

    transformers.utils.logging.disable_progress_bar()
    try:
        require_regular(folder)
        model, report = getattr(transformers, class_name).from_pretrained(
            folder,
            local_files_only=True,
            use_safetensors=True,
            dtype=torch.float32,
            output_loading_info=True,
        )
    except (OSError, ValueError, RuntimeError, SafetensorError) as error:
        raise CheckpointError(f"the weights in '{folder}' cannot be read: {error}") from error
    if report['missing_keys']:
        raise CheckpointError(
            f"the weights in '{folder}' lack {_some(sorted(report['missing_keys']))}; "
            f'download {public_name} again'
        )
    check_weights(model, folder)
    return model.to(device).eval()


def import_transformers() -> Any:
    """Return the package `transformers`.

    Raises:
        ConfigError: the package is not installed.
    """
    try:
        import transformers
    except ImportError as error:
        raise ConfigError(
            "the package 'transformers' is not installed; install mtv_world_ros[vision], or "
            'choose the segmenter `colour`, which needs no weights'
        ) from error
    return transformers


def load_tokenizer(folder: Path) -> Any:
    """Return the tokenizer in the folder of the weights.

    Raises:
        CheckpointError: there is none.
    """
    if not any((folder / name).is_file() for name in ('tokenizer.json', 'vocab.txt')):
        raise CheckpointError(f"'{folder}' has no tokenizer.json; download the whole repository")
    require_regular(folder)
    return import_transformers().AutoTokenizer.from_pretrained(folder, local_files_only=True)


def preprocessor_config(folder: Path) -> dict[str, Any]:
    """Read the image preprocessing of a folder of weights; empty if it states none."""
    path = folder / 'preprocessor_config.json'
    return _read(path) if path.is_file() else {}


def _check_folder(folder: Path, kind: str, public_name: str) -> None:
    config = folder / 'config.json'
    if not config.is_file():
        raise CheckpointError(
            f"'{folder}' has no config.json; name a folder with {public_name} or another "
            f'{kind} model'
        )
    values = _read(config)
    check_sizes(values, f"'{config}'")
    found = str(values.get('model_type'))
    if found != kind:
        raise CheckpointError(
            f"'{folder}' holds a model of type '{found}', not '{kind}' ({public_name})"
        )
    if not any(folder.glob('*.safetensors')):
        raise CheckpointError(
            f"'{folder}' has no *.safetensors; other formats are not loaded, for they may run code"
        )


def _model_type(config: Path) -> str:
    return str(_read(config).get('model_type'))


def _read(path: Path) -> dict[str, Any]:
    try:
        values = read_json(path)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"'{path}' cannot be read: {error}") from error
    return values if isinstance(values, dict) else {}


def _some(names: Sequence[str]) -> str:
    more = f' and {len(names) - 3} more' if len(names) > 3 else ''
    return ', '.join(names[:3]) + more
