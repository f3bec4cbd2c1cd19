"""Clips in latents: conditions are dropped by chance, each by itself."""

from __future__ import annotations

import pytest
import torch

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.model.conditioning import Conditioning
from mtv_world_ros.training.clips.encoding import drop_conditions
from mtv_world_ros.training.objective import NoiseDraws
from mtv_world_ros.training.training_config import AugmentConfig, ObjectiveConfig

COUNT = 2000


def conditions() -> Conditioning:
    def ones(*shape: int) -> torch.Tensor:
        return torch.ones(COUNT, *shape)

    return Conditioning(
        control=ones(2, 3, 2, 1, 1),
        start_control=ones(2, 3, 1, 1),
        start=ones(2, 3, 2, 1, 1),
        reference=ones(2, 3, 1, 1),
        text=ones(4, 5),
        image=ones(6, 5),
    )


def test_control_start_image_and_its_tokens_are_dropped_by_themselves():
    augment = AugmentConfig(
        control_dropout=0.1, reference_dropout=0.2, image_dropout=0.3, start_dropout=0.15
    )
    out = drop_conditions(conditions(), augment, NoiseDraws(0, 0, range(COUNT)))
    gone = {
        name: (getattr(out, name) == 0).flatten(1).all(1)
        for name in ('control', 'start_control', 'start', 'reference', 'image')
    }
    for name, dropped in gone.items():  # a sample is dropped whole or not at all
        assert torch.equal(dropped, (getattr(out, name) == 0).flatten(1).any(1)), name
    assert torch.equal(gone['control'], gone['start_control'])
    names = ('control', 'reference', 'image', 'start')
    shares = [gone[name].float().mean().item() for name in names]
    assert shares == pytest.approx([0.1, 0.2, 0.3, 0.15], abs=0.03)
    for other, product in (('control', 0.02), ('start', 0.03)):  # independent: the product
        both = (gone[other] & gone['reference']).float().mean().item()
        assert both == pytest.approx(product, abs=0.012)
    assert (out.text == 1).all()


def test_the_start_image_is_in_one_place():
    """As `clip_idx` of VideoX-Fun decides: 0 leaves the slot, any other frame the tokens."""
    frames = torch.rand(3, 2, 3, 1, 1)
    other = torch.rand(3, 2, 3, 1, 1) + 1
    slot = frames.unsqueeze(3).repeat(1, 1, 1, 2, 1, 1)
    parts = {'control': slot, 'start_control': frames, 'start': slot, 'reference': frames}
    first = Conditioning(**parts).with_one_start()
    assert torch.equal(first.start, slot) and first.anchor is not None
    assert not first.anchor.any()
    anchor = torch.stack([frames[0], other[1], 1.001 * frames[2]])  # the same up to rounding
    mixed = Conditioning(**parts, anchor=anchor).with_one_start()
    assert mixed.anchor is not None
    for index, shows_start in enumerate((True, False, True)):
        assert mixed.start[index].any() == shows_start
        assert mixed.anchor[index].any() != shows_start
    assert torch.equal(mixed.anchor[1], other[1])


def test_without_dropout_nothing_is_drawn():
    draws = NoiseDraws(0, 0, range(COUNT))
    drop_conditions(conditions(), AugmentConfig(), draws)
    assert torch.equal(draws.uniform(), NoiseDraws(0, 0, range(COUNT)).uniform())


@pytest.mark.parametrize(
    ('make', 'message'),
    [
        (lambda: AugmentConfig(image_dropout=1.1), r'augment.image_dropout is 1.1.*\[0, 1\]'),
        (lambda: ObjectiveConfig(sigma_weighting='bell'), "'bell' is not one of uniform, middle"),
        (lambda: ObjectiveConfig(huber_delta=0.0), 'huber_delta is 0.0; it must be positive'),
    ],
)
def test_settings_out_of_range_are_refused(make, message):
    with pytest.raises(ConfigError, match=message):
        make()
    assert AugmentConfig().replace(image_dropout=1.0).image_dropout == 1.0
