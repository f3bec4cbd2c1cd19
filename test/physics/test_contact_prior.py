"""Contact parameters that were not fitted in this robot cell: wide, joint draws."""

import numpy as np
import pytest

from mtv_world_ros.core.files import share_path
from mtv_world_ros.model.checkpoint import checkpoint_folder
from mtv_world_ros.physics.arms.arms import Arms
from mtv_world_ros.physics.checkpoint_files import load_contact
from mtv_world_ros.physics.contact_settings import (
    ContactDraw,
    ContactOrigin,
    ENOUGH_TELLING,
    MAX_MOTIONS,
    PRIOR_LOG_STD,
    RANGES,
)
from mtv_world_ros.physics.engine.futures import draw_futures
from mtv_world_ros.physics.fitting.contact_fit import _joint_draws
from mtv_world_ros.physics.solid_foresight import SolidForesight, TrackedSolids
from mtv_world_ros.physics.solids import Solid
from mtv_world_ros.robot.file import load_robot

ROBOT = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))
BLOCK = Solid(centre=np.array([0.1, 0.3, 0.02]), size=np.full(3, 0.04))
FITTED = ContactOrigin(
    by='mtv-world fit contact', recordings=20, telling=ENOUGH_TELLING, place='cell 2'
)


@pytest.fixture(scope='module')
def settings():
    found = load_contact(checkpoint_folder('bundled') / 'object_motion')
    assert found is not None
    return found


@pytest.mark.parametrize(
    ('origin', 'place', 'expected'),
    [
        (FITTED, 'cell 2', True),
        (FITTED, 'cell 3', False),
        (FITTED, '', False),  # the node does not say where it is
        (FITTED.replace(place=''), '', True),  # nor do the recordings
        (FITTED.replace(place=None), 'cell 3', True),  # older files hold everywhere
        (FITTED.replace(telling=ENOUGH_TELLING - 1), 'cell 2', False),
        # a fit that tells little was made here all the same: its draws are as wide as that
        (FITTED.replace(telling=0, hold=(1.0, 500.0)), 'cell 2', True),
        (FITTED.replace(telling=0, hold=(1.0, 500.0)), 'cell 3', False),
        (None, '', False),
    ],
)
def test_parameters_are_fitted_where_their_recordings_were_made(settings, origin, place, expected):
    assert settings.replace(fitted=origin).is_fitted_at(place) is expected


def test_the_bundled_parameters_are_fitted_in_the_nominal_simulator_alone(settings):
    assert settings.is_fitted_at('simulator/nominal')
    assert not settings.is_fitted_at('simulator/bold') and not settings.is_fitted_at('')


def test_the_prior_is_wide_around_the_settings_and_within_its_ranges(settings):
    prior = settings.as_prior()
    assert len(prior.draws) == MAX_MOTIONS
    for name, (low, high) in RANGES.items():
        scale = settings.finger_stiffness if name == 'finger_stiffness' else 1.0
        logs = np.log([getattr(draw, name) / scale for draw in prior.draws])
        assert np.log(low) - 1e-9 <= logs.min() and logs.max() <= np.log(high) + 1e-9
        middle = np.log(getattr(settings, name) / scale)
        assert np.median(logs) == pytest.approx(middle, abs=0.1)
        # the ranges cut what is far off
        assert 0.5 * PRIOR_LOG_STD < logs.std() < 1.1 * PRIOR_LOG_STD
    # slippery fingers, heavy objects and weak grippers together are among the first futures
    hold = [d.grip_friction * d.finger_stiffness / d.density for d in prior.draws[:15]]
    fitted = settings.grip_friction * settings.finger_stiffness / settings.density
    assert min(hold) < 0.06 * fitted


def test_futures_take_the_joint_draws_in_turn(settings):
    draws = tuple(
        ContactDraw(
            grip_friction=0.2 * k, table_friction=0.1 * k, density=100.0 * k, finger_stiffness=30.0
        )
        for k in (1, 2)
    )
    given = settings.replace(draws=draws, num_motions=4)
    futures = draw_futures(given, (BLOCK,), Arms(ROBOT, None).drives)
    found = [future.settings for future in futures]
    # the first is as it was found
    assert [one.grip_friction for one in found] == [settings.grip_friction, 0.2, 0.4, 0.2]
    assert [one.density for one in found] == [settings.density, 100.0, 200.0, 100.0]
    # what hangs on a parameter goes with it
    assert found[2].tray_kg == pytest.approx(settings.tray_kg * 200 / settings.density)
    ratio = 30 / settings.finger_stiffness
    assert found[1].finger_damping == pytest.approx(settings.finger_damping * ratio)
    # all else differs as before
    without = draw_futures(given.replace(draws=()), (BLOCK,), Arms(ROBOT, None).drives)
    for one, other in zip(futures, without, strict=True):
        np.testing.assert_array_equal(one.solids[0].centre, other.solids[0].centre)
        np.testing.assert_array_equal(one.zeros, other.zeros)


def test_draws_of_the_posterior_are_joint_and_their_first_ones_are_spread_evenly(settings):
    """Friction and density that make up for each other: only their ratio is known."""
    rng = np.random.default_rng(0)
    logs = np.zeros((4000, len(RANGES)))
    logs[:, 0] = rng.normal(-1.0, 0.6, len(logs))
    logs[:, 2] = logs[:, 0] + 6.0 + rng.normal(0.0, 0.05, len(logs))
    weights = np.exp(-0.5 * ((logs[:, 0] + 1.2) / 0.4) ** 2)
    weights /= weights.sum()
    draws = _joint_draws(settings, logs, weights)
    grip, density = (np.log([getattr(d, n) for d in draws]) for n in ('grip_friction', 'density'))
    assert np.corrcoef(grip, density)[0, 1] > 0.97
    assert grip.mean() == pytest.approx(weights @ logs[:, 0], abs=0.1)
    hold = grip - density
    # 3, 7 and 15 draws divide the posterior into equal parts: they lean to neither side
    levels = weights @ (logs[:, 0] - logs[:, 2] <= hold[:15, None]).T
    for count in (3, 7, 15):
        expected = np.arange(1, count + 1) / (count + 1)
        assert np.sort(levels[:count]) == pytest.approx(expected, abs=0.002)
    for count in (8, 15, 64):
        expected = np.quantile(logs[:, 0] - logs[:, 2], [0.2, 0.8])
        assert np.quantile(hold[:count], [0.2, 0.8]) == pytest.approx(expected, abs=0.02)


def test_foresight_of_another_robot_cell_draws_from_the_prior(settings):
    foresight = SolidForesight(ROBOT, None, settings)
    assert foresight.at_place('simulator/nominal') is foresight
    elsewhere = foresight.at_place('cell 3')
    assert not elsewhere.is_fitted and elsewhere.settings == settings.as_prior()
    assert foresight.is_fitted and foresight.settings == settings
    assert not elsewhere.with_robot(ROBOT).is_fitted
    assert elsewhere.at_place('simulator/nominal') is elsewhere


def test_the_prior_can_be_taken_back_and_found_objects_are_simulated_anew(settings):
    few = settings.replace(num_motions=3)
    fitted = SolidForesight(ROBOT, None, few)
    elsewhere = fitted.at_place('cell 3')
    again = elsewhere.as_fitted()
    assert again.is_fitted and again.settings == few and fitted.as_fitted() is fitted
    assert elsewhere.with_robot(ROBOT).as_fitted().settings == few
    positions = np.tile(np.clip(0.0, ROBOT.lower, ROBOT.upper), (11, 1))

    def tracked(foresight):
        return TrackedSolids(foresight=foresight, names=('block',), solids=(BLOCK,))

    def grips(objects):
        return [future.settings.grip_friction for future in objects.futures()]

    expected, of_fit = tracked(fitted).advance(positions)
    _, of_prior = tracked(elsewhere).advance(positions)
    assert grips(of_prior)[1:] == [draw.grip_friction for draw in elsewhere.settings.draws[:2]]
    anew = of_prior.simulated_by(fitted.with_robot(ROBOT))  # by a simulator of its own
    assert anew.batch is None and anew.is_fitted and not of_prior.is_fitted
    assert grips(anew) == grips(of_fit) != grips(of_prior)
    found, _ = anew.advance(positions)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one.points, other.points, atol=1e-12)
    # the table of the place stays
    low = tracked(elsewhere._on_table(-0.01)).simulated_by(fitted)
    assert low.foresight.settings == few.replace(table_m=-0.01)
