"""A LoRA file, in the layouts that people share, read as factors of a transformer's layers.

Diffusers' converters read three of these nine layouts; of others they drop tensors in silence.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from functools import cache
from math import sqrt
from pathlib import Path
import re
from typing import Any, NamedTuple

from pydantic import Field
from safetensors import safe_open, SafetensorError
from torch import nn, Tensor

from mtv_world_ros.core.bounded_input import check_finite, parse_json, read_json, require_regular
from mtv_world_ros.core.config import Count, Number, Schema, validated
from mtv_world_ros.core.errors import CheckpointError, ConfigError
from mtv_world_ros.model.tensor_files import pickle_error, PICKLES

#: diffusers' key for peft's configuration in a file; peft's own file for it, and its prefix
METADATA = 'lora_adapter_metadata'
PEFT_CONFIG = 'adapter_config.json'
_PEFT_PREFIX = 'base_model.model.'
#: prefixes of module names in files of peft, DiffSynth-Studio, ComfyUI, diffusers, Kohya (with
#: another `_`: VideoX-Fun), LyCORIS, OneTrainer
_PREFIX = re.compile(
    r'(base_model\.model\.)?'
    r'(pipe\.dit\.|(model\.)?diffusion_model\.|transformer\.|lora_unet__?|lycoris_'
    r'|lora_transformer_)?'
)
_KEY = re.compile(r'(.+?)[._](lora_A|lora_B|lora[._]down|lora[._]up|alpha)(\.default)?(\.weight)?')
_PART = {'lora_A': 'A', 'lora_down': 'A', 'lora_B': 'B', 'lora_up': 'B', 'alpha': 'alpha'}
#: tensors that are not read, and why
_REFUSED = {
    r'(lora_te|text_encoder).*': 'it is for a text encoder',
    r'transformer_2\..*': "it is for Wan 2.2's second transformer",
    r'.*\.(lora_magnitude_vector|dora_scale)\b.*': 'DoRA scales whole weights, which is not read',
    r'.*\.(hada|lokr|oft|lora_mid)_?.*': 'LoHa, LoKr, OFT and convolutions are not read',
    r'.*\.(diff|diff_b|diff_m|set_weight)': 'whole differences (.diff, .diff_b) are not read: '
    'bake them into the weights',
    r'.*\.bias': 'changes of biases are not read',
}
#: peft's settings that change nothing once an adapter is trained
_WITHOUT_EFFECT = {
    'auto_mapping', 'base_model_name_or_path', 'corda_config', 'ensure_weight_tying', 'eva_config',
    'exclude_modules', 'fan_in_fan_out', 'inference_mode', 'layers_pattern', 'layers_to_transform',
    'loftq_config', 'lora_dropout', 'megatron_core', 'peft_version', 'qalora_group_size',
    'revision', 'runtime_config', 'target_modules', 'task_type',
}  # fmt: skip
#: and those with a value that changes nothing
_PLAIN = {
    'peft_type': ('LORA',),
    'bias': ('none',),
    'init_lora_weights': (True, 'gaussian', 'orthogonal', 'eva'),
}


#: characters of a pattern for the names of modules
_LONGEST_PATTERN = 200
#: signs of repetition in such a pattern
_MOST_REPEATS = 3


class Factors(NamedTuple):
    """Change of a module's weight: `scale * B @ A`; A (r, in), B (out, r)."""

    A: Tensor
    B: Tensor
    scale: float


class PeftSettings(Schema):
    """Scaling of the factors, under peft's names.

    Attributes:
        r: default rank of modules without an entry in `rank_pattern`.
        lora_alpha: default alpha of modules without an entry in `alpha_pattern`; None = stored
            with the tensors.
        rank_pattern: ranks by a regular expression for the end of a module's name.
        alpha_pattern: alphas by a regular expression for the end of a module's name.
        use_rslora: the product counts alpha / sqrt(r) in place of alpha / r.
    """

    r: Count
    lora_alpha: Number | None = None
    rank_pattern: dict[str, Count] = Field(default_factory=dict, max_length=10_000)
    alpha_pattern: dict[str, Number] = Field(default_factory=dict, max_length=10_000)
    use_rslora: bool = False

    def scale(self, module: str, rank: int) -> float:
        """Return the scale of the product of a module's factors.

        Args:
            module: name of the module in the file.
            rank: rank of the module's factors.

        Raises:
            ConfigError: another rank than the settings say, or no alpha.
        """
        stated = _matching(self.rank_pattern, module, self.r)
        if stated != rank:
            raise ConfigError(f"'{module}' has rank {rank}, the settings say {stated}")
        alpha = _matching(self.alpha_pattern, module, self.lora_alpha)
        if alpha is None:
            raise ConfigError(f"the settings have no lora_alpha for '{module}'")
        return alpha / (sqrt(rank) if self.use_rslora else rank)


def _matching(pattern: Mapping[str, Any], module: str, default: Any) -> Any:
    """Return the value of the first pattern that matches, as peft matches them."""
    try:
        found = (v for key, v in pattern.items() if _expression(key).match(module))
        return next(found, default)
    except re.error as error:
        raise ConfigError(f'a pattern is no regular expression: {error}') from error


@cache
def _expression(pattern: str) -> re.Pattern[str]:
    """Return a pattern of peft's settings, which takes little time whatever it is matched with.

    Raises:
        ConfigError: the pattern is long, repeats a group, or repeats too often: a search may
            take time that grows exponentially with the length of a name.
    """
    repeats = re.findall(r'(?<!\\)[*+{?]', pattern)
    if len(pattern) > _LONGEST_PATTERN or len(repeats) > _MOST_REPEATS or ')' in _before(pattern):
        raise ConfigError(
            f"the pattern '{pattern[:_LONGEST_PATTERN]}' could take forever; write module names, "
            f'with at most {_MOST_REPEATS} of * + ? {{ and none behind a group'
        )
    return re.compile(rf'(.*\.)?({pattern})$')


def _before(pattern: str) -> list[str]:
    """Return what stands before each sign of repetition."""
    return re.findall(r'(.)[*+{?]', pattern)


def read_lora(file: Path, transformer: nn.Module) -> dict[str, Factors]:
    """Return the factors by the name of the transformer's module.

    Raises:
        CheckpointError: a pickle, damaged, for another model, or with settings that are not read:
            every tensor must find its place, and every setting count.
    """
    tensors, settings = _read(file)
    modules = {n: m for n, m in transformer.named_modules() if isinstance(m, nn.Linear)}
    names = _names(modules)
    found: dict[str, Factors] = {}
    for module, parts in _by_module(file, tensors).items():
        if module not in names:
            raise CheckpointError.unknown(
                f"'{file}':",
                module,
                names,
                is_not=' is no layer of this transformer',
                advice='; the LoRA is for another model',
                most=0,
            )
        if names[module] in found:
            raise CheckpointError(f"'{file}': layer '{module}' is there under two names")
        found[names[module]] = _factors(file, module, parts, modules[names[module]], settings)
    if not found:
        raise CheckpointError(f"'{file}' has no tensors; expected the factors of a LoRA")
    return found


def _read(file: Path) -> tuple[dict[str, Tensor], PeftSettings | None]:
    if file.suffix in PICKLES:
        raise pickle_error([file])
    try:
        require_regular(file)
        with safe_open(file, framework='pt') as handle:
            tensors = {name: handle.get_tensor(name) for name in handle.keys()}  # noqa: SIM118
            for name, tensor in tensors.items():
                check_finite(tensor, name, file)
            text = (handle.metadata() or {}).get(METADATA)
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"LoRA '{file}' cannot be loaded: {error}") from error
    where, config = f"'{file}': {METADATA}", None
    try:
        if text is not None:
            config = parse_json(text, METADATA)
        elif any(name.startswith(_PEFT_PREFIX) for name in tensors):
            where = f"'{file.with_name(PEFT_CONFIG)}'"
            config = read_json(file.with_name(PEFT_CONFIG))
    except FileNotFoundError as error:
        raise CheckpointError(
            f"'{file}' was saved by peft, without its {PEFT_CONFIG} beside it: how strongly it "
            'counts stands there'
        ) from error
    except (OSError, ValueError, ConfigError) as error:
        raise CheckpointError(f'{where} cannot be used: {error}') from error
    return tensors, None if config is None else _settings(config, where)


def _settings(config: Any, where: str) -> PeftSettings:
    if not isinstance(config, dict):
        raise CheckpointError(f'{where} must be a map of settings, got {config!r}')
    bare = {str(key).removeprefix('transformer.'): value for key, value in config.items()}
    for name, value in bare.items():
        ignored = name in _WITHOUT_EFFECT or name in PeftSettings.model_fields
        if value and not ignored and value not in _PLAIN.get(name, ()):
            raise CheckpointError(
                f'{where}: {name}={value!r} is not supported; merge the adapter with peft and '
                'import the merged weights'
            )
    read = {k: v for k, v in bare.items() if k in PeftSettings.model_fields and v is not None}
    return validated(PeftSettings, read, where, error=CheckpointError)


def _by_module(file: Path, tensors: Mapping[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    """The parts `A`, `B` and `alpha` of every module, by its name in the file without prefix."""
    found: dict[str, dict[str, Tensor]] = defaultdict(dict)
    for key, value in tensors.items():
        why = next((f'; {why}' for mark, why in _REFUSED.items() if re.fullmatch(mark, key)), '')
        match = _KEY.fullmatch(key)
        if why or not match:
            raise CheckpointError(f"'{file}': tensor '{key}' is no factor of a LoRA{why}")
        part = _PART[match[2].replace('.', '_')]
        module = _PREFIX.sub('', match[1], count=1)
        if part in found[module]:
            raise CheckpointError(f"'{file}': '{key}' is there under two names")
        found[module][part] = value
    return found


def _names(modules: Mapping[str, Any]) -> dict[str, str]:
    """Map the names that files use for a module, also flattened with `_`, to ours."""
    from diffusers.loaders.single_file_utils import convert_wan_transformer_to_diffusers

    attention = [f'{kind}_attn.{n}' for kind in ('self', 'cross') for n in 'qkvo']
    inner = [*attention, 'cross_attn.k_img', 'cross_attn.v_img', 'ffn.0', 'ffn.2']
    numbers = {name.split('.')[1] for name in modules if name.startswith('blocks.')}
    wan = [f'blocks.{number}.{name}' for number in numbers for name in inner]
    wan += ['text_embedding.0', 'text_embedding.2', 'time_embedding.0', 'time_embedding.2']
    wan += ['time_projection.1', 'img_emb.proj.1', 'img_emb.proj.3', 'head.head']
    ours = convert_wan_transformer_to_diffusers({f'{name}.weight': name for name in wan})
    bare = {theirs: name.removesuffix('.weight') for name, theirs in ours.items()}
    names = {name: name for name in modules}
    names |= {theirs: name for theirs, name in bare.items() if name in modules}
    return names | {theirs.replace('.', '_'): name for theirs, name in names.items()}


def _factors(
    file: Path,
    module: str,
    parts: Mapping[str, Tensor],
    layer: nn.Linear,
    settings: PeftSettings | None,
) -> Factors:
    if not {'A', 'B'} <= set(parts):
        raise CheckpointError(f"'{file}': layer '{module}' has one of its two factors only")
    a, b = parts['A'], parts['B']
    if a.shape[1:] != (layer.in_features,) or b.shape != (layer.out_features, a.shape[0]):
        raise CheckpointError(
            f"'{file}': the factors of '{module}' are {list(b.shape)} x {list(a.shape)}, the "
            f'layer is {layer.out_features} x {layer.in_features}: the LoRA is for another size'
        )
    if not (a.is_floating_point() and b.is_floating_point()):
        raise CheckpointError(f"'{file}': the factors of '{module}' are {a.dtype}, not floats")
    try:
        return Factors(a, b, _scale(module, a.shape[0], parts.get('alpha'), settings))
    except ConfigError as error:
        raise CheckpointError(f"'{file}': {error}") from error


def _scale(module: str, rank: int, alpha: Tensor | None, settings: PeftSettings | None) -> float:
    """Return alpha / rank; 1 where neither tensors nor settings hold an alpha."""
    if alpha is None:
        return 1.0 if settings is None else settings.scale(module, rank)
    if settings is not None and settings.lora_alpha is not None:
        raise ConfigError(f"'{module}' has an alpha of its own, and one in the settings")
    if alpha.numel() != 1:
        raise ConfigError(f"alpha of '{module}' must be one number, got {alpha.tolist()}")
    return alpha.item() / rank
