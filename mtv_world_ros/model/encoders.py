"""Context of the transformer's cross-attention: umT5 for instructions, CLIP for start images."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path
from typing import Any

import torch
from torch import nn, Tensor
import torch.nn.functional as F

from mtv_world_ros.core.bounded_input import check_weights, require_regular
from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.core.files import copy_folder
from mtv_world_ros.core.network_sizes import check_config_file
from mtv_world_ros.model.tensor_files import import_transformers
from mtv_world_ros.model.transformer.block import NUM_TEXT_TOKENS

FOLDERS = ('text_encoder', 'tokenizer')
#: mean and standard deviation of the colours that CLIP was trained with
_MEAN = (0.48145466, 0.4578275, 0.40821073)
_STD = (0.26862954, 0.26130258, 0.27577711)
_FOLDER = 'image_encoder'


class TextEncoder:
    """Encoder of prompts with a cache; umT5 is loaded for a new prompt and freed again.

    umT5-XXL takes 11 GB, and a robot's instruction seldom changes.

    Args:
        checkpoint: folder with `text_encoder/` and `tokenizer/`.
        dtype: dtype of its computations.
    """

    def __init__(self, checkpoint: Path, *, dtype: torch.dtype = torch.float32) -> None:
        for name in FOLDERS:
            if not (checkpoint / name).is_dir():
                raise CheckpointError(f"checkpoint '{checkpoint}' has no folder '{name}/'")
        self._checkpoint, self._dtype = checkpoint, dtype
        self._encoded: dict[str, Tensor] = {}

    def encode(self, prompt: str, device: torch.device | None = None) -> Tensor:
        """Return (1, 512, text_dim) tokens of a prompt, zero behind its end.

        Raises:
            CheckpointError: umT5 or its tokenizer cannot be loaded.
        """
        device = device or torch.device('cpu')
        if prompt not in self._encoded:
            self._encoded[prompt] = self._encode(prompt, device).cpu()
        return self._encoded[prompt].to(device)

    @torch.inference_mode()
    def _encode(self, prompt: str, device: torch.device) -> Tensor:
        tokenizer, model = self._load(device)
        tokens = tokenizer(
            [' '.join(prompt.split())],
            padding='max_length',
            max_length=NUM_TEXT_TOKENS,
            truncation=True,
            add_special_tokens=True,
            return_tensors='pt',
        ).to(device)
        hidden = model(tokens.input_ids, attention_mask=tokens.attention_mask).last_hidden_state
        return hidden * tokens.attention_mask[..., None]

    def _load(self, device: torch.device) -> tuple[Any, Any]:
        transformers = import_transformers()
        encoder, tokenizer = (str(self._checkpoint / name) for name in FOLDERS)
        check_config_file(Path(encoder) / 'config.json')
        try:
            require_regular(encoder, tokenizer)
            model = transformers.UMT5EncoderModel.from_pretrained(
                encoder, dtype=self._dtype, local_files_only=True, use_safetensors=True
            )
            check_weights(model, Path(encoder))
            return (
                transformers.AutoTokenizer.from_pretrained(tokenizer, local_files_only=True),
                model.to(device).eval(),
            )
        except (OSError, ValueError) as error:
            raise CheckpointError(
                f"'{encoder}' or '{tokenizer}' cannot be loaded: {error}"
            ) from error

    def save(self, checkpoint: Path) -> None:
        """Copy the files of the encoder into another checkpoint."""
        for name in FOLDERS:
            copy_folder(self._checkpoint / name, checkpoint / name)


class ImageEncoder:
    """Encoder of images to the tokens before CLIP's last layer, as in Wan.

    The last few images' tokens are kept: the seeds of a start frame and a chain that is anchored
    on one encode it once.

    Args:
        model: CLIP's image model, transformers' `CLIPVisionModel`.
        source: the checkpoint it came from.
        num_kept: images whose tokens are kept.
    """

    def __init__(self, model: nn.Module, source: Path, num_kept: int = 8) -> None:
        self.model: Any = model
        self._source, self._num_kept = source, num_kept
        self._kept: OrderedDict[bytes, Tensor] = OrderedDict()
        self._device, self._stays = torch.device('cpu'), True

    @classmethod
    def load(cls, checkpoint: Path, *, dtype: torch.dtype = torch.float32) -> ImageEncoder:
        """Return the one of a checkpoint folder.

        Raises:
            CheckpointError: the encoder is missing or cannot be loaded.
        """
        folder = checkpoint / _FOLDER
        check_config_file(folder / 'config.json')
        try:
            require_regular(folder)
            model = import_transformers().CLIPVisionModel.from_pretrained(
                str(folder), dtype=dtype, local_files_only=True, use_safetensors=True
            )
        except (OSError, ValueError) as error:
            raise CheckpointError(f"'{folder}' cannot be loaded: {error}") from error
        check_weights(model, folder)
        return cls(model.eval(), checkpoint)

    def to(self, device: torch.device, dtype: torch.dtype, *, stays: bool = True) -> ImageEncoder:
        """Move the encoder to a device and return it; `stays=False`: only while it encodes."""
        self._device, self._stays = device, stays
        self.model.to(device=device if stays else 'cpu', dtype=dtype)
        self._kept.clear()
        return self

    def encode(self, images: Tensor) -> Tensor:
        """Return (V, N, D) tokens of (V, H, W, 3) uint8 RGB images; N = 257 for ViT-H/14."""
        tokens = torch.stack([self._tokens(image) for image in images])
        if not self._stays:
            self.model.to('cpu')
        return tokens

    def _tokens(self, image: Tensor) -> Tensor:
        key = repr(tuple(image.shape)).encode() + image.cpu().numpy().tobytes()
        if key not in self._kept:
            self._kept[key] = self._encode(image)
            if len(self._kept) > self._num_kept:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]

    @torch.inference_mode()
    def _encode(self, image: Tensor) -> Tensor:
        self.model.to(self._device)
        size = self.model.config.image_size
        pixels = image.to(self.model.device).movedim(-1, 0)[None].float().div(255)
        # the whole image, squeezed to a square: Wan crops nothing
        pixels = F.interpolate(pixels, (size, size), mode='bicubic', align_corners=False)
        mean, std = (pixels.new_tensor(x)[:, None, None] for x in (_MEAN, _STD))
        pixels = ((pixels - mean) / std).to(self.model.dtype)
        return self.model(pixels, output_hidden_states=True).hidden_states[-2][0]

    def save(self, checkpoint: Path) -> None:
        """Copy the files of the encoder into another checkpoint."""
        copy_folder(self._source / _FOLDER, checkpoint / _FOLDER)
