"""`world_model.json`: what a checkpoint takes, gives and was trained on."""

from __future__ import annotations

from collections.abc import Mapping
import json
from pathlib import Path
from typing import Any

from mtv_world_ros.data_types import WorldModelSpec
from mtv_world_ros.errors import CheckpointError, nearest
from mtv_world_ros.model.action_features import CONTROLS

CARD = 'world_model.json'
_CARD_KEYS = {
    'views': list,
    'fps': (int, float),
    'num_frames': int,
    'width': int,
    'height': int,
    'robot': str,
    'control': str,
    'object_mask': bool,
    'rendering': dict,
    'trained_on': dict,
}
#: what an adapter and the checkpoint that it is used on have in common
SHARED_KEYS = tuple(key for key in _CARD_KEYS if key not in ('rendering', 'trained_on'))
#: what only models with text need: the instruction, what to keep away from and how strongly; the
#: denoising steps that a model is made for; and `history.HistorySettings`
OPTIONAL_KEYS = {
    'prompt': str,
    'negative_prompt': str,
    'guidance_scale': (int, float),
    'num_inference_steps': int,
    'history': dict,
}


def read_card(folder: Path) -> dict[str, Any]:
    """Returns the checked contents of `world_model.json`.

    Raises:
        CheckpointError: missing, not JSON, or with missing, unknown or ill-typed keys.
    """
    path = Path(folder) / CARD
    if not path.is_file():
        raise CheckpointError(
            f"'{folder}' is not a checkpoint: it has no {CARD}; train one with 'mtv-world train' "
            "or set 'checkpoint' to a folder that has it"
        )
    try:
        card = json.loads(path.read_text())
    except json.JSONDecodeError as error:
        raise CheckpointError(f"'{path}' is not valid JSON: {error}") from error
    check_card(card, path)
    return card


def check_same_model(card: Mapping[str, Any], adapter: Path) -> None:
    """Checks that an adapter was trained for what a checkpoint takes and gives.

    Args:
        card: of the checkpoint.
        adapter: its folder; one without a card of its own is not checked.

    Raises:
        CheckpointError: it was not.
    """
    if not (adapter / CARD).is_file():
        return
    theirs = read_card(adapter)
    for key in SHARED_KEYS:
        mine, other = card[key], theirs[key]
        if mine != other:
            raise CheckpointError(
                f"adapter '{adapter}' was trained with '{key}' {other}, this checkpoint's is "
                f'{mine}; use the checkpoint that it was trained on'
            )


def spec_of(card: Mapping[str, Any]) -> WorldModelSpec:
    """Returns what a card says of the model's input and output."""
    return WorldModelSpec(
        views=tuple(card['views']),
        fps=float(card['fps']),
        num_frames=card['num_frames'],
        width=card['width'],
        height=card['height'],
        robot=card['robot'],
        num_inference_steps=card.get('num_inference_steps', 4),
        num_history=card.get('history', {}).get('num_frames', 0),
    )


def check_card(card: Mapping[str, Any], path: Path) -> None:
    """Checks the keys and types of a card; `path` is for the message.

    Raises:
        CheckpointError: missing, unknown or ill-typed keys.
    """
    _check_keys(card, path)
    num_steps = card.get('num_inference_steps', 1)
    if num_steps < 1:
        raise CheckpointError(
            f"'{path}': num_inference_steps is {num_steps}; it must be at least 1"
        )
    if card['control'] not in CONTROLS:
        raise CheckpointError(
            f"'{path}': control '{card['control']}' is not one of {', '.join(CONTROLS)}"
        )


def _check_keys(card: Mapping[str, Any], path: Path) -> None:
    known = {**_CARD_KEYS, **OPTIONAL_KEYS}
    for key in card:
        if key not in known:
            raise CheckpointError(f"'{path}': unknown key '{key}'{nearest(key, known)}")
    for key, kind in known.items():
        if key not in card:
            if key in OPTIONAL_KEYS:
                continue
            raise CheckpointError(f"'{path}': key '{key}' is missing")
        if not isinstance(card[key], kind):
            raise CheckpointError(f"'{path}': '{key}' is {card[key]!r}, expected {kind}")
