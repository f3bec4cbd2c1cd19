"""An estimate that nothing was compared with gives no verdict, and says what mends it."""

from dataclasses import replace
from math import isnan, nan
from shutil import copytree

import numpy as np
import pytest

from mtv_world_ros import judge
from mtv_world_ros.core.data_types import JointTrajectory, SuccessEstimate
from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.core.files import share_path, write_json
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.physics.checkpoint_files import load_contact, save_contact
from mtv_world_ros.physics.contact_settings import ContactOrigin
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.success.calibration import Calibration, fit_path
from mtv_world_ros.success.doubts import Grounds

FOUND = ContactOrigin(by='mtv-world fit contact', recordings=8, telling=3)
GUESSED = 'numbers of contact (contact.json) were never fitted on recordings'


def estimate(foreseen: float, *, is_calibrated: bool = False) -> SuccessEstimate:
    return SuccessEstimate(
        probability=0.21,
        interval=(0.05, 0.4),
        jaccard=np.zeros((2, 1)),
        reasons=('missed by 40 mm',),
        features={'foreseen': foreseen},
        is_calibrated=is_calibrated,
    )


@pytest.mark.parametrize(
    ('contact', 'is_calibrated', 'foreseen', 'says'),
    [
        ('guessed', False, -0.5, 'run mtv-world fit contact'),  # of a checkpoint without any fit
        ('', False, nan, 'run mtv-world fit success'),  # pictures alone, which nothing vouches for
        ('guessed', False, nan, 'run mtv-world fit success'),
        ('guessed', True, -0.5, 'run mtv-world fit contact'),  # calibrated for something else
        ('guessed', True, nan, ''),
        ('', True, nan, ''),
    ],
)
def test_without_grounds_there_is_no_verdict(contact, is_calibrated, foreseen, says):
    given = estimate(foreseen)
    found = Grounds.of(contact, is_calibrated).bear(given)
    if not says:
        assert found is given
        return
    assert isnan(found.probability) and all(map(isnan, found.interval))
    assert found.trust == found.reasons[0] and found.trust.startswith('cannot tell, because ')
    assert found.reasons[0].index(says) < found.reasons[0].index(', or mtv-world')
    assert found.reasons[0].endswith('without this doubt 0.21 [0.05, 0.40]')
    assert found.reasons[-1:] == given.reasons and found.features == given.features


def test_where_physics_was_fitted_here_foreseen_motions_are_grounds():
    given = estimate(-0.5)
    assert Grounds.of('', is_calibrated=False).bear(given) is given


def test_a_calibrated_estimate_needs_no_other_grounds():
    given = estimate(-0.5, is_calibrated=True)
    assert Grounds.of('guessed', is_calibrated=True).bear(given) is given


def test_an_estimate_that_abstains_keeps_its_reason():
    given = replace(estimate(nan), probability=nan, interval=(nan, nan))
    assert Grounds.of('guessed', is_calibrated=False).bear(given) is given


@pytest.fixture
def own(tmp_path):
    """A checkpoint of one's own, of which nothing was calibrated."""
    copytree(share_path('resource', 'checkpoint'), tmp_path / 'own')
    for of_pictures in (False, True):
        fit_path(tmp_path / 'own', Calibration, of_pictures=of_pictures).unlink()
    return tmp_path / 'own'


@pytest.mark.parametrize(
    ('origin', 'doubt'),
    [
        (None, GUESSED),
        (FOUND.replace(telling=0), '0 of the 8 recordings that'),
        (FOUND.replace(telling=2), '2 of the 8 recordings that'),
        (FOUND, ''),
        (FOUND.replace(hold=(2.2, 235.0)), 'whether things slip between fingers is known within'),
        (FOUND.replace(telling=1, hold=(2.2, 22.0)), ''),
    ],
)
def test_a_checkpoint_says_what_its_numbers_of_contact_rest_on(own, origin, doubt):
    folder = own / 'object_motion'
    contact = load_contact(folder)
    assert contact is not None
    save_contact(contact.replace(fitted=origin), folder)
    grounds = Pipeline.load(own, num_threads=1, segmenter='colour').judge.grounds
    assert grounds.foreseen.startswith(doubt) and bool(grounds.foreseen) == bool(doubt)
    assert grounds.pictures.startswith('the estimate was never calibrated for this checkpoint')
    # what `calibrate` fits has to be the bare estimate
    bare = Pipeline.load(own, num_threads=1, segmenter='colour', calibrated=False)
    assert bare.judge.grounds == Grounds()


def test_files_of_before_count_as_never_fitted(own):
    file = own / 'object_motion' / 'contact.json'
    contact = load_contact(file.parent)
    assert contact is not None
    old = {key: value for key, value in contact.model_dump().items() if key != 'fitted'}
    write_json(file, old)
    again = load_contact(file.parent)
    assert again is not None and again.doubt == GUESSED
    write_json(file, old | {'fitted': {'by': 'somebody'}})
    with pytest.raises(CheckpointError, match='recordings'):
        load_contact(file.parent)


def test_the_bundled_model_has_grounds():
    assert Pipeline.load(num_threads=1, segmenter='colour').judge.grounds == Grounds()


@pytest.mark.parametrize(('foresight', 'mends'), [(True, 'fit contact'), (False, 'fit success')])
def test_imagined_frames_abstain_and_recorded_ones_do_not(own, foresight, mends):
    """With the bundled weights and guessed numbers, on the bundled episode, which succeeds."""
    folder = own / 'object_motion'
    contact = load_contact(folder)
    assert contact is not None
    save_contact(contact.replace(fitted=None), folder)
    pipeline = Pipeline.load(own, num_threads=1, segmenter='colour', foresight=foresight)
    recording = load_recording(
        share_path('resource', 'demo_episode'), pipeline.spec, pipeline.robot
    )
    assert judge(pipeline, recording).probability > 0.75
    episode = pipeline.begin(
        recording.observation(0), RolloutOptions(instruction=recording.instruction)
    )
    plan = recording.commands
    kept = (plan.times > 1e-6) & (plan.times <= 1.6)
    plan = JointTrajectory(
        joint_names=plan.joint_names, times=plan.times[kept], positions=plan.positions[kept]
    )
    (chunk,) = episode.extend(plan)
    assert isnan(chunk.success.probability)
    assert f': run mtv-world {mends} ' in chunk.success.reasons[0]
