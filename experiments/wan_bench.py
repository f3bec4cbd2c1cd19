"""A Wan preset with random weights, to measure: its parts, a chunk, the stock pipeline."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
import gc
import inspect
from typing import Any

from diffusers import WanImageToVideoPipeline, WanTransformer3DModel
import torch
from torch import nn, Tensor

from mtv_world_ros.model.autoencoders import TinyAutoencoder
from mtv_world_ros.model.conditioning import (
    condition,
    Conditioning,
    ControlBatch,
    decode_frames,
    with_anchor,
    with_history,
)
from mtv_world_ros.model.parts import build_autoencoder, build_scheduler
from mtv_world_ros.model.runtime import place
from mtv_world_ros.model.serving import compile_norms, prepare, ServingOptions
from mtv_world_ros.model.transformer.block import NUM_TEXT_TOKENS
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from mtv_world_ros.model.world_model import denoise, sample_latents
from mtv_world_ros.training.training_config import TrainingConfig

_IMAGE_TOKENS = 257
#: of a stock Wan image-to-video transformer: noisy 16, mask 4, image 16
_STOCK_CHANNELS = 36


class Bench:
    """The parts of a preset with random weights, made ready, and a chunk's inputs."""

    def __init__(
        self, config: TrainingConfig, options: argparse.Namespace, serving: ServingOptions
    ) -> None:
        self.config, self.options = config, options
        self.device, self.dtype = torch.device(options.device), getattr(torch, options.dtype)
        with torch.device('meta'):
            transformer = MultiViewWanTransformer(**config.transformer)
            autoencoder: Any = build_autoencoder(config.autoencoder)
        home = torch.device('cpu') if serving.offload else self.device
        self.transformer = self._random(transformer, home)
        self.autoencoder = self.decoder = self._random(autoencoder, self.device)
        if serving.compile:
            compile_norms(self.autoencoder)
        if serving.tiny_decoder:
            self.decoder = self._random(TinyAutoencoder(), self.device)
        if serving.tiny_encoder:
            self.autoencoder = self.decoder
        self.scheduler = build_scheduler(config.scheduler)
        video = config.video
        shape = (1, len(video.views), 1 + video.num_frames, video.height, video.width, 3)
        self.frames = torch.randint(0, 256, shape, dtype=torch.uint8, device=self.device)
        prepare(self.transformer, serving, self.device)
        self._forget_peak()

    def close(self) -> None:
        """Free the device."""
        del self.transformer, self.autoencoder, self.decoder
        gc.collect()
        if self.device.type == 'cuda':
            torch.cuda.empty_cache()

    def _forget_peak(self) -> None:
        """What making the parts took is none of serving's memory."""
        if self.device.type == 'cuda':
            torch.cuda.reset_peak_memory_stats(self.device)

    def _random(self, module: Any, device: torch.device) -> Any:
        """Random weights that keep activations finite, made where they are used."""
        rope = getattr(module, 'rope', None)  # computed; `to_empty` would lose it
        # its number format first: float32 takes twice the memory
        module = place(module, torch.device('meta'), self.dtype).to_empty(device=device)
        if rope is not None:
            arguments = self.config.transformer
            module.rope = type(rope)(
                arguments['attention_head_dim'],
                arguments['patch_size'],
                arguments['rope_max_seq_len'],
                arguments['view_offset'],
            )
        place(module, device, self.dtype)
        torch.manual_seed(self.options.seed)
        for name, parameter in module.named_parameters():
            if parameter.ndim > 1:
                nn.init.normal_(parameter, std=0.02)
            else:
                nn.init.constant_(parameter, 0.0 if name.endswith('bias') else 1.0)
        return module.eval().requires_grad_(False)

    def encode(self) -> Conditioning:
        """Start images, trajectory videos and history to latents; text and image at hand."""
        latents = condition(
            self.autoencoder, self.frames[:, :, 0], ControlBatch.drawn(self.frames)
        )
        history = self.config.history
        if history.anchored:
            latents = with_anchor(self.autoencoder, latents, self.frames[:, :, 0])
        if history.num_frames:
            sigmas = torch.full((1,), history.noise_level, device=self.device)
            before = self.frames[:, :, : history.num_frames]
            latents = with_history(self.autoencoder, latents, before, sigmas)
        return self.with_tokens(latents)

    def with_tokens(self, latents: Conditioning) -> Conditioning:
        """The same under a text and start images."""
        views, arguments = self.frames.shape[1], self.config.transformer
        text = self._tokens(NUM_TEXT_TOKENS, arguments['text_dim'])
        image = self._tokens(views * _IMAGE_TOKENS, arguments['image_dim'])
        return replace(latents, text=text, image=image)

    def _tokens(self, count: int, width: int) -> Tensor:
        return torch.zeros(1, count, width, device=self.device, dtype=self.dtype)

    def step(self, given: Conditioning) -> Tensor:
        """One pass of the transformer."""
        noise = torch.zeros_like(given.control)
        timestep = torch.full((), 500.0, device=self.device)
        return denoise(self.transformer, noise, timestep, given, given.text)

    def decode(self, latents: Tensor) -> Tensor:
        """Latents to frames."""
        return decode_frames(self.decoder, latents.to(self.dtype))

    def chunk(self, steps: int) -> Tensor:
        """The whole way from frames to frames."""
        given = self.encode()
        latents = sample_latents(
            self.transformer,
            self.scheduler,
            given,
            seed=0,
            num_inference_steps=steps,
            should_stop=lambda: False,
        )
        return self.decode(latents)

    def stock(self) -> Callable[[int], object]:
        """The pipeline of diffusers itself on the same blocks and autoencoder; takes the steps."""
        known = inspect.signature(WanTransformer3DModel).parameters
        arguments = {k: v for k, v in self.config.transformer.items() if k in known}
        with torch.device('meta'):
            stock: Any = WanTransformer3DModel(**{**arguments, 'in_channels': _STOCK_CHANNELS})
        stock = self._stock_like(stock)
        pipe: Any = WanImageToVideoPipeline(
            None,  # type: ignore[arg-type]
            None,  # type: ignore[arg-type]
            self.autoencoder.vae,
            build_scheduler(self.config.scheduler),  # type: ignore[arg-type]
            transformer=stock,
        )
        pipe.set_progress_bar_config(disable=True)
        pipe.encode_image = lambda *_: self._tokens(_IMAGE_TOKENS, arguments['image_dim'])
        video, views = self.config.video, self.frames.shape[1]
        shape = (1, 3, video.height, views * video.width)
        image = torch.rand(shape, device=self.device, dtype=torch.float32)

        def run(steps: int) -> object:
            return pipe(
                image=image,
                height=video.height,
                width=views * video.width,
                num_frames=1 + video.num_frames,
                num_inference_steps=steps,
                guidance_scale=1.0,
                prompt_embeds=self._tokens(NUM_TEXT_TOKENS, arguments['text_dim']),
                output_type='pt',
            )

        return run

    def _stock_like(self, stock: Any) -> Any:
        """The stock class around this transformer's own tensors, but for the way in."""
        shallow: Any = WanTransformer3DModel.from_config({**stock.config, 'num_layers': 0})
        stock.patch_embedding = nn.Conv3d(
            _STOCK_CHANNELS, stock.patch_embedding.out_channels, (1, 2, 2), (1, 2, 2)
        )
        tensors = {
            name: value
            for name, value in self.transformer.state_dict().items()
            if name in stock.state_dict() and not name.startswith('patch_embedding.')
        }
        tensors |= {
            f'patch_embedding.{k}': v.to(self.device, self.dtype)
            for k, v in stock.patch_embedding.state_dict().items()
        }
        stock.load_state_dict(tensors, assign=True)
        stock.rope = shallow.rope.to(self.device)
        return stock.eval().requires_grad_(False)
