from importlib.util import find_spec

import numpy as np
import pytest

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.evaluation.metrics.image_quality import image_quality


def flat(*values):
    return np.stack([np.full((24, 32, 3), value, np.uint8) for value in values])


def measured(names, predicted, real):
    measure = image_quality(names)
    assert measure is not None
    return measure(predicted, real)


def test_psnr_and_ssim_of_flat_frames_have_closed_forms():
    found = measured(('psnr', 'ssim'), flat(110, 100), flat(100, 80))
    assert found['psnr'] == pytest.approx(np.mean(20 * np.log10(255 / np.array([10, 20]))))
    c1 = (0.01 * 255) ** 2
    ssim = [(2 * a * b + c1) / (a * a + b * b + c1) for a, b in ((110, 100), (100, 80))]
    assert found['ssim'] == pytest.approx(np.mean(ssim), abs=1e-4)


def test_equal_frames_have_a_finite_psnr_above_that_of_one_wrong_level():
    frames = flat(90, 100)
    found = measured(('psnr', 'ssim'), frames, frames)
    off = frames.copy()
    off[0, 0, 0, 0] += 1
    off[1, 0, 0, 0] += 1
    assert found['ssim'] == pytest.approx(1, abs=1e-3)
    assert measured(('psnr',), off, frames)['psnr'] < found['psnr'] < 200


def test_nothing_is_measured_unless_asked_for():
    assert image_quality(()) is None


def test_unknown_measure_is_an_error():
    with pytest.raises(ConfigError, match="'ssmi' is not one of psnr, ssim, lpips"):
        image_quality(('ssmi',))


@pytest.mark.skipif(find_spec('torchvision') is not None, reason='torchvision is installed')
def test_lpips_says_what_it_lacks():
    with pytest.raises(ConfigError, match='lpips needs torchvision'):
        image_quality(('psnr', 'lpips'))
