"""Vision models of the public kinds, tiny and random, saved as the public ones are."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch

#: side of the square that the tiny SAM 2 and SAM 3 see [px]
SAM2_SIZE, SAM3_SIZE = 64, 56
#: what the tiny detector was told to resize to [px]
EDGES = {'shortest_edge': 64, 'longest_edge': 107}
WORDS = ['[PAD]', '[UNK]', '[CLS]', '[SEP]', '[MASK]', '.']
WORDS += ['red', 'blue', 'green', 'block', 'cup', 'plate', 'white', 'bread']
#: the sizes that checkpoints fix: 64 channels of memory, hidden sizes of at least 128
_DECODER = {'hidden_size': 128, 'mlp_dim': 32, 'iou_head_hidden_dim': 32, 'num_attention_heads': 2}
_MEMORY = {
    'memory_attention_hidden_size': 128,
    'memory_attention_num_layers': 1,
    'memory_attention_feed_forward_hidden_size': 32,
    'memory_encoder_hidden_size': 128,
    'memory_encoder_output_channels': 64,
    'mask_downsampler_embed_dim': 128,
    'memory_fuser_embed_dim': 128,
    'memory_fuser_intermediate_dim': 32,
}


def save_sam2(folder: Path, *, present: float = 20.0) -> Path:
    """Save a SAM 2; `present` is the logit of seeing the objects."""
    from transformers import Sam2VideoConfig, Sam2VideoModel

    size = SAM2_SIZE
    backbone = {
        'model_type': 'sam2_hiera_det_model',
        'image_size': [size, size],
        'hidden_size': 8,
        'embed_dim_per_stage': [8, 16, 32, 64],
        'blocks_per_stage': [1, 2, 3, 1],
        'num_attention_heads_per_stage': [1, 1, 1, 1],
        'num_attention_heads': 1,
        'global_attention_blocks': [4],  # not where a stage starts
        'window_size_per_stage': [4, 2, 4, 2],
    }
    config = Sam2VideoConfig(
        image_size=size,
        vision_config={
            'model_type': 'sam2_vision_model',
            'backbone_config': backbone,
            'backbone_channel_list': [64, 32, 16, 8],
            'backbone_feature_sizes': [[size // 4] * 2, [size // 8] * 2, [size // 16] * 2],
            'fpn_hidden_size': 128,
        },
        prompt_encoder_config={'hidden_size': 128, 'image_size': size, 'mask_input_channels': 4},
        mask_decoder_config=_DECODER,
        memory_attention_rope_feat_sizes=[size // 16, size // 16],
        **_MEMORY,
    )
    torch.manual_seed(0)
    model = Sam2VideoModel(config).eval()
    _enliven(model, model.mask_decoder, present)
    return _save(model, folder)


def save_sam3(folder: Path, *, present: float = 20.0) -> Path:
    """Save a SAM 3 with its tokenizer."""
    from transformers import Sam3VideoConfig, Sam3VideoModel

    size, patch = SAM3_SIZE, 14
    side = size // patch
    backbone = {
        'model_type': 'sam3_vit_model',
        'image_size': size,
        'patch_size': patch,
        'pretrain_image_size': size // 2,
        'hidden_size': 32,
        'intermediate_size': 32,
        'num_hidden_layers': 2,
        'num_attention_heads': 2,
        'window_size': 4,
        'global_attn_indexes': [1],
    }
    vision = {
        'model_type': 'sam3_vision_model',
        'backbone_config': backbone,
        'fpn_hidden_size': 128,
        'backbone_feature_sizes': [[side * 4] * 2, [side * 2] * 2, [side] * 2],
        'scale_factors': [4.0, 2.0, 1.0, 0.5],
    }
    layers = {'hidden_size': 128, 'intermediate_size': 32, 'num_attention_heads': 2}
    text = {
        'model_type': 'clip_text_model',
        'vocab_size': len(_clip_vocabulary()),
        'hidden_size': 32,
        'intermediate_size': 32,
        'projection_dim': 32,
        'num_hidden_layers': 1,
        'num_attention_heads': 2,
        'max_position_embeddings': 32,
        'bos_token_id': 0,
        'eos_token_id': 1,
        'pad_token_id': 1,
    }
    detector = {
        'model_type': 'sam3',
        'vision_config': vision,
        'text_config': text,
        'geometry_encoder_config': {'num_layers': 1, **layers},
        'detr_encoder_config': {'num_layers': 1, **layers},
        'detr_decoder_config': {'num_layers': 1, 'num_queries': 10, **layers},
        'mask_decoder_config': {'hidden_size': 128, 'num_attention_heads': 2},
    }
    tracker = {
        'model_type': 'sam3_tracker_video',
        'image_size': size,
        'vision_config': vision,
        'prompt_encoder_config': {
            'hidden_size': 128,
            'image_size': size,
            'patch_size': patch,
            'mask_input_channels': 4,
        },
        'mask_decoder_config': _DECODER,
        'memory_attention_rope_feat_sizes': [side, side],
        **_MEMORY,
    }
    torch.manual_seed(0)
    config = Sam3VideoConfig(
        detector_config=detector, tracker_config=tracker, low_res_mask_size=side * 4
    )
    model = Sam3VideoModel(config).eval()
    _enliven(model.tracker_model, model.tracker_model.mask_decoder, present)
    _save(model, folder)
    _save_clip_tokenizer(folder)
    return folder


def save_dino(folder: Path) -> Path:
    """Save an MM-Grounding-DINO with its tokenizer and the preparation of its images."""
    from transformers import (
        BertTokenizerFast,
        MMGroundingDinoConfig,
        MMGroundingDinoForObjectDetection,
    )

    config = MMGroundingDinoConfig(
        backbone_config={
            'model_type': 'swin',
            'embed_dim': 8,
            'depths': [1, 1, 1, 1],
            'num_heads': [1, 1, 1, 1],
            'window_size': 4,
            'out_indices': [2, 3, 4],
            'image_size': 64,
        },
        text_config={
            'model_type': 'bert',
            'vocab_size': len(WORDS),
            'hidden_size': 16,
            'num_hidden_layers': 1,
            'num_attention_heads': 2,
            'intermediate_size': 16,
            'max_position_embeddings': 64,
        },
        d_model=32,
        encoder_layers=1,
        decoder_layers=2,
        encoder_attention_heads=2,
        decoder_attention_heads=2,
        encoder_ffn_dim=16,
        decoder_ffn_dim=16,
        num_queries=20,
        max_text_len=40,
        disable_custom_kernels=True,
    )
    torch.manual_seed(0)
    model: Any = MMGroundingDinoForObjectDetection(config).eval()
    with torch.no_grad():  # boxes that differ in size and place, scores that differ
        for parameter in model.bbox_embed[-1].layers[-1].parameters():
            parameter.normal_(std=0.5)
    _save(model, folder)
    (folder / 'vocab.txt').write_text('\n'.join(WORDS))
    BertTokenizerFast(str(folder / 'vocab.txt')).save_pretrained(folder)
    (folder / 'preprocessor_config.json').write_text(
        json.dumps(
            {
                'image_mean': [0.485, 0.456, 0.406],
                'image_std': [0.229, 0.224, 0.225],
                'size': EDGES,
            }
        )
    )
    return folder


def _enliven(model: Any, decoder: Any, present: float) -> None:
    """Fresh weights are so small that every mask is the same; and objects are to be seen."""
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.dim() > 1:
                parameter.mul_(4)
        decoder.pred_obj_score_head.proj_out.bias.fill_(present)


def _save(model: Any, folder: Path) -> Path:
    from transformers.utils import logging

    logging.disable_progress_bar()
    model.save_pretrained(folder)
    return folder


def _clip_vocabulary() -> list[str]:
    letters = 'abcdefghijklmnopqrstuvwxyz'
    return ['<|startoftext|>', '<|endoftext|>', *letters, *(f'{c}</w>' for c in letters)]


def _save_clip_tokenizer(folder: Path) -> None:
    from transformers import CLIPTokenizer

    words = {word: index for index, word in enumerate(_clip_vocabulary())}
    (folder / 'vocab.json').write_text(json.dumps(words))
    (folder / 'merges.txt').write_text('#version: 0.2\n')
    CLIPTokenizer(vocab=str(folder / 'vocab.json'), merges=str(folder / 'merges.txt'))
    CLIPTokenizer.from_pretrained(folder).save_pretrained(folder)
