"""A vision-language model that runs here, through transformers, without torchvision."""

from __future__ import annotations

from collections.abc import Sequence
import hashlib
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from mtv_world_ros.bounded_input import check_weights
from mtv_world_ros.config import Count, expected, Schema
from mtv_world_ros.data_types import ByteArray
from mtv_world_ros.errors import CheckpointError, ConfigError, ModelMemoryError
from mtv_world_ros.vision.describers.vlm import ChatAnswer


class LocalVlmConfig(Schema):
    """Which model, and where it runs."""

    model: str = Field(
        description='folder, or name on the Hugging Face Hub (`Qwen/Qwen3-VL-4B-Instruct`)'
    )
    device: str = Field(default='cpu', description='`cpu`, `cuda`, ...')
    dtype: str = Field(
        default='auto',
        description="`auto` (the weights' own), `float32`, `bfloat16` or `float16`",
    )
    max_new_tokens: Annotated[Count, expected('a positive whole number')] = Field(
        default=1024, description='longest answer'
    )


class LocalVlm:
    """Asks a model of transformers' image-text-to-text class; see `Chat`.

    Only safetensors weights are loaded, and no code that comes with a model is run.

    Raises:
        ConfigError: transformers is not installed, or `dtype` is none.
        CheckpointError: there is no such model, or it is no chat model for images.
    """

    def __init__(self, config: LocalVlmConfig) -> None:
        self.config = config
        model, self._processor = _load(config)
        self._model = model.to(config.device).eval()
        self._template = self._processor.chat_template or self._processor.tokenizer.chat_template
        if not self._template:
            raise CheckpointError(
                f"'{config.model}' has no chat template, so it cannot be asked; set the "
                "describer's 'local: model' to an instruction-tuned one"
            )

    @property
    def identity(self) -> str:
        """The name, and of a folder what its files are."""
        folder = Path(self.config.model).expanduser()
        if not folder.is_dir():
            return self.config.model
        digest = hashlib.sha256()
        for file in sorted(path for path in folder.iterdir() if path.is_file()):
            stat = file.stat()
            digest.update(f'{file.name} {stat.st_size} {stat.st_mtime_ns}\n'.encode())
        return f'{self.config.model} ({digest.hexdigest()[:8]})'

    def ask(self, frame: ByteArray, turns: Sequence[str]) -> ChatAnswer:
        """Returns the most likely answer to the last turn; see `Chat`.

        Raises:
            ModelMemoryError: the device ran out of memory.
        """
        import torch

        inputs = self._processor.apply_chat_template(
            _messages(frame, turns),
            chat_template=self._template,
            add_generation_prompt=True,
            tokenize=True,
            return_dict=True,
            return_tensors='pt',
        ).to(self._model.device, self._model.dtype)
        limit = self.config.max_new_tokens
        try:
            with torch.inference_mode():
                # a checkpoint's own sampling settings go: temperature 0
                output = self._model.generate(
                    **inputs,
                    max_new_tokens=limit,
                    do_sample=False,
                    temperature=None,
                    top_p=None,
                    top_k=None,
                )
        except torch.OutOfMemoryError as error:
            raise ModelMemoryError(
                f"'{self.config.model}' does not fit on '{self.config.device}' ({error}); set "
                "the describer's 'local: device' or a smaller model"
            ) from error
        said = output[0, inputs['input_ids'].shape[1] :]
        text = self._processor.tokenizer.decode(said, skip_special_tokens=True)
        return ChatAnswer(text, is_cut_off=len(said) >= limit)


def _messages(frame: ByteArray, turns: Sequence[str]) -> list[dict[str, Any]]:
    from PIL import Image

    contents: list[list[dict[str, Any]]] = [[{'type': 'text', 'text': turn}] for turn in turns]
    contents[0].insert(0, {'type': 'image', 'image': Image.fromarray(frame)})
    return [
        {'role': 'assistant' if index % 2 else 'user', 'content': content}
        for index, content in enumerate(contents)
    ]


def _load(config: LocalVlmConfig) -> tuple[Any, Any]:
    try:
        import torch
        from transformers import AutoConfig, AutoModelForImageTextToText
    except ImportError as error:
        raise ConfigError(
            f"the describer 'local' needs transformers and pillow ({error}); "
            "pip install '.[describe]'"
        ) from error
    dtype = config.dtype if config.dtype == 'auto' else getattr(torch, config.dtype, None)
    if dtype != 'auto' and not isinstance(dtype, torch.dtype):
        raise ConfigError(
            f"dtype '{config.dtype}' of the describer is none; valid are auto, float32, bfloat16 "
            'and float16'
        )
    source = str(Path(config.model).expanduser())
    try:
        architecture = AutoConfig.from_pretrained(source)
        model = AutoModelForImageTextToText.from_pretrained(
            source, config=architecture, dtype=dtype, use_safetensors=True
        )
        check_weights(model, Path(source))
        return model, _load_processor(source, architecture)
    except (OSError, ValueError, KeyError, ImportError) as error:
        raise CheckpointError(
            f"'{config.model}' cannot be loaded as a vision-language model: {error}. Set the "
            "describer's 'local: model' to the folder or the Hub's name of one that transformers "
            'knows, with safetensors weights'
        ) from error


def _load_processor(source: str, architecture: Any) -> Any:
    """The model's processor with what still images need alone.

    Many processors also have a part for videos, which exists with torchvision only; it is left
    out. Images are prepared with Pillow.
    """
    from transformers import AutoImageProcessor, AutoTokenizer
    from transformers.models.auto.processing_auto import PROCESSOR_MAPPING

    if type(architecture) not in PROCESSOR_MAPPING:
        raise ValueError(f"transformers has no processor for '{architecture.model_type}'")
    kind = _for_images(PROCESSOR_MAPPING[type(architecture)])
    loaders = {
        'image_processor': lambda: AutoImageProcessor.from_pretrained(source, backend='pil'),
        'tokenizer': lambda: AutoTokenizer.from_pretrained(source),
        'video_processor': lambda: None,
    }
    parts = kind.get_attributes()
    unknown = [part for part in parts if part not in loaders]
    if unknown:
        raise ValueError(f"the processor of '{architecture.model_type}' also needs {unknown}")
    values, _ = kind.get_processor_dict(source)
    return kind.from_args_and_dict([loaders[part]() for part in parts], values)


def _for_images(kind: Any) -> Any:
    """The processor class, with the check lifted that its part for videos is there."""

    class ImageOnly(kind):
        def check_argument_for_proper_class(self, argument_name: str, argument: Any) -> Any:
            if argument_name == 'video_processor':
                return type(None)
            return super().check_argument_for_proper_class(argument_name, argument)

    return ImageOnly
