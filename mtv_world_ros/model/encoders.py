"""umT5: the instruction as tokens for the transformer's cross-attention."""

from __future__ import annotations

from pathlib import Path
import shutil
from typing import Any

import torch
from torch import Tensor

from mtv_world_ros.errors import CheckpointError
from mtv_world_ros.model.tensor_files import import_transformers
from mtv_world_ros.model.transformer.context import NUM_TEXT_TOKENS

FOLDERS = ('text_encoder', 'tokenizer')


class TextEncoder:
    """Encodes prompts, each one once; umT5 is loaded for that and freed again.

    umT5-XXL takes 11 GB, and a robot's instruction seldom changes.

    Args:
        checkpoint: folder with `text_encoder/` and `tokenizer/`.
        dtype: of its computations.
    """

    def __init__(self, checkpoint: Path, *, dtype: torch.dtype = torch.float32) -> None:
        for name in FOLDERS:
            if not (checkpoint / name).is_dir():
                raise CheckpointError(f"checkpoint '{checkpoint}' has no folder '{name}/'")
        self._checkpoint, self._dtype = checkpoint, dtype
        self._encoded: dict[str, Tensor] = {}

    def encode(self, prompt: str, device: torch.device | None = None) -> Tensor:
        """Returns (1, 512, text_dim) tokens of a prompt, zero behind its end.

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
        try:
            model = transformers.UMT5EncoderModel.from_pretrained(
                encoder, dtype=self._dtype, local_files_only=True, use_safetensors=True
            )
            return (
                transformers.AutoTokenizer.from_pretrained(tokenizer, local_files_only=True),
                model.to(device).eval(),
            )
        except (OSError, ValueError) as error:
            raise CheckpointError(
                f"'{encoder}' or '{tokenizer}' cannot be loaded: {error}"
            ) from error

    def save(self, checkpoint: Path) -> None:
        """Copies its files into another checkpoint."""
        for name in FOLDERS:
            shutil.copytree(self._checkpoint / name, checkpoint / name)
