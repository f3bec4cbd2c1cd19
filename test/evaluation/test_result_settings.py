"""Names of checkpoints in stored results."""

from __future__ import annotations

from pathlib import Path
import shutil

import pytest

from mtv_world_ros.evaluation.result_settings import fingerprint
from mtv_world_ros.model.checkpoint import Checkpoint, checkpoint_folder
from mtv_world_ros.success.calibration import (
    Calibration,
    fit_path,
    HorizonCurve,
    load_fits,
    save_fit,
)


@pytest.mark.parametrize('of_pictures', [False, True])
def test_a_fit_that_was_stored_goes_on_under_the_name_that_it_began_with(tmp_path, of_pictures):
    folder = Path(shutil.copytree(checkpoint_folder('bundled'), tmp_path / 'copy'))
    fits = load_fits(folder)
    assert fits.calibration is not None and fits.horizon is not None
    for kind in (Calibration, HorizonCurve):
        fit_path(folder, kind, of_pictures=of_pictures).unlink(missing_ok=True)
    bare, used = (fingerprint(Checkpoint.open(folder), calibrated=c) for c in (False, True))
    for fit in fits:
        save_fit(folder, fit, of_pictures=of_pictures)
    assert fingerprint(Checkpoint.open(folder), calibrated=False) == bare
    # results of another estimate are other results
    assert fingerprint(Checkpoint.open(folder)) != used
