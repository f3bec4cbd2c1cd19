"""A table that is not as high as the numbers of contact say is seen in the first frame."""

from __future__ import annotations

import numpy as np
import pytest

from mtv_world_ros.core.files import share_path
from mtv_world_ros.model.checkpoint import checkpoint_folder
from mtv_world_ros.physics.checkpoint_files import load_contact, load_response
from mtv_world_ros.physics.fitting.contact_fit import read_contact
from mtv_world_ros.physics.solid_foresight import SolidForesight


@pytest.fixture(scope='module')
def recording(robot):
    return read_contact(share_path('resource', 'demo_episode'), robot, ('low', 'high'))


@pytest.fixture(scope='module')
def foresight(robot):
    folder = checkpoint_folder('bundled') / 'object_motion'
    settings = load_contact(folder)
    assert settings is not None and settings.table_m == 0.0
    few = settings.model_copy(update={'num_motions': 2})
    return SolidForesight(robot, load_response(folder, robot), few)


def raised(recording, metres: float):
    """Arguments of `find`: cameras, and all they see, are higher by so much."""
    poses = [np.array(pose) for pose in recording.frame.poses]
    for pose in poses:
        pose[2, 3] += metres
    return recording.names, recording.frame.masks, recording.frame.cameras, poses


def heights(tracked) -> list[float]:
    return [float(s.centre[2] - s.size[2] / 2) for s in tracked.futures()[0].solids]


@pytest.mark.parametrize(('off_m', 'word'), [(0.012, 'higher'), (-0.012, 'lower')])
def test_a_small_error_is_corrected_for_the_episode_and_said(foresight, recording, off_m, word):
    found = foresight.find(*raised(recording, off_m))
    assert found.foresight.settings.table_m == pytest.approx(off_m, abs=1.5e-3)
    (reason,) = found.reasons
    assert reason.startswith(f'the table seems 12 mm {word} than contact.json has it; corrected')
    assert heights(found) == pytest.approx([off_m] * 2, abs=1.5e-3)
    # they stand: nothing falls, and nothing is pushed up
    still = np.repeat(recording.positions[:1], 21, axis=0)
    motions, after = found.advance(still)
    assert np.abs(np.diff(motions[0].points[..., 2], axis=0)).max() < 1e-3
    assert after.reasons == found.reasons and not after.doubts
    # the checkpoint's own numbers are as they were, and later frames keep to what was found
    assert foresight.settings.table_m == 0.0
    again, *_ = foresight.find_again(found, *raised(recording, off_m))
    assert again.foresight.settings.table_m == found.foresight.settings.table_m
    assert again.reasons == found.reasons


def test_a_table_that_is_as_it_was_found_is_not_corrected(foresight, recording):
    for off_m in (0.0, 0.001):
        found = foresight.find(*raised(recording, off_m))
        assert found.foresight is foresight and not found.reasons


@pytest.mark.parametrize(('off_m', 'text'), [(0.06, 'seems to float'), (-0.06, 'below the table')])
def test_a_large_error_allows_no_verdict(foresight, recording, off_m, text):
    found = foresight.find(*raised(recording, off_m))
    assert found.foresight is foresight
    _, after = found.advance(np.repeat(recording.positions[:1], 6, axis=0))
    assert len(after.doubts) == 2 and all(text in doubt for doubt in after.doubts.values())


def test_one_object_alone_does_not_tell(foresight, recording):
    names, masks, *where = raised(recording, 0.012)
    found = foresight.find(names[:1], masks[:, :1], *where)
    assert found.foresight is foresight and not found.reasons


@pytest.mark.parametrize('off_m', [-0.06, 0.11])
def test_a_table_that_varies_is_where_objects_of_the_first_frame_end_below(
    foresight, recording, off_m
):
    settings = foresight.settings.model_copy(update={'table_varies': True})
    anywhere = SolidForesight(foresight.robot, foresight.response, settings)
    found = anywhere.find(*raised(recording, off_m))
    assert found.foresight.settings.table_m == pytest.approx(off_m, abs=2e-3)
    # they stand, and the arm moves as if the table was not there
    still = np.repeat(recording.positions[:1], 21, axis=0)
    motions, after = found.advance(still)
    assert np.abs(np.diff(motions[0].points[..., 2], axis=0)).max() < 2e-3
    assert not after.doubts and not after.reasons
