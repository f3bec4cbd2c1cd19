"""Futures side by side: stopping, passing by, plausibility, delays, warnings."""

from __future__ import annotations

from dataclasses import replace
import time

import numpy as np
import pytest

from mtv_world_ros.core.errors import RolloutPreempted
from mtv_world_ros.physics.arms.arms import Arms
from mtv_world_ros.physics.contact_settings import ContactSpread
from mtv_world_ros.physics.engine import engine as engine_module
from mtv_world_ros.physics.engine.drive_inputs import SUBSTEPS
from mtv_world_ros.physics.engine.engine import DivergenceLimits, Engine
from mtv_world_ros.physics.engine.futures import draw_futures
from mtv_world_ros.physics.solid_foresight import SolidForesight, TrackedSolids
from mtv_world_ros.physics.solids import Solid
from test.support import small_scene

SETTINGS = small_scene.SETTINGS.model_copy(update={'num_motions': 4})
BLOCK = Solid(centre=np.array([0.0, 0.0, 0.02]), size=np.array([0.02, 0.03, 0.04]))
AWAY = Solid(centre=np.array([0.5, 0.2, 0.02]), size=np.full(3, 0.04))


def batch_of(robot, *solids, **changed):
    return small_scene.batch_of(robot, *solids, **{'num_motions': 4, **changed})


def picking(seconds: float = 2.0) -> np.ndarray:
    """Commands (N, 2): down, close, up, at a block in the middle."""
    times = np.arange(0, seconds + 0.01, 0.02)
    height = 0.02 + 0.2 * np.clip(1 - times / 0.5, 0, 1) + 0.1 * np.clip((times - 1) / 0.5, 0, 1)
    return np.stack([height, np.where(times < 0.6, 0.04, 0.0)], -1)


def test_two_threads_and_parts_of_a_plan_give_the_same(lift):
    commands = picking()
    whole, _ = batch_of(lift, BLOCK, AWAY).advance(commands, 5)
    batch = batch_of(lift, BLOCK, AWAY, threads=2)
    first, state = batch.advance(commands[:51], 5)
    second, _ = batch.advance(commands[50:], 5, state)
    np.testing.assert_array_equal(second.points[:, 0], first.points[:, -1])
    np.testing.assert_allclose(second.points[:, -1], whole.points[:, -1], atol=1e-6)


def test_arms_that_pass_by_move_as_they_would_by_dynamics(lift, monkeypatch):
    commands = picking()
    passed, _ = batch_of(lift, BLOCK, AWAY).advance(commands, 5)
    monkeypatch.setattr(engine_module._Run, 'may_pass', lambda run, _: run.still < 0)
    computed, _ = batch_of(lift, BLOCK, AWAY).advance(commands, 5)
    assert passed.steps < 0.9 * computed.steps
    # where it is computed, what stands sinks into the table by .03 mm
    np.testing.assert_allclose(passed.points, computed.points, atol=5e-5)
    np.testing.assert_allclose(passed.joints, computed.joints, atol=1e-5)


def test_futures_differ_in_what_is_not_known_and_the_first_does_not(lift):
    futures = draw_futures(SETTINGS, (BLOCK,), Arms(lift, None).drives)
    first, *others = futures
    assert first.settings == SETTINGS and first.delay_s == 0 and not first.zeros.any()
    np.testing.assert_array_equal(first.solids[0].centre, BLOCK.centre)
    for future in others:
        assert future.settings.grip_friction != SETTINGS.grip_friction
        assert future.settings.density != SETTINGS.density
        assert future.delay_s > 0 and future.zeros[0] != 0
        assert future.solids[0].centre[2] == future.solids[0].size[2] / 2  # it stands
    again = draw_futures(SETTINGS, (BLOCK,), Arms(lift, None).drives)
    np.testing.assert_array_equal(again[1].solids[0].centre, others[0].solids[0].centre)


@pytest.mark.parametrize('table_varies', [False, True])
def test_an_error_of_the_cameras_moves_all_objects_alike(lift, table_varies):
    sure = ContactSpread(**dict.fromkeys(ContactSpread.model_fields, 0.0) | {'camera_m': 0.01})
    settings = SETTINGS.replace(spread=sure, table_varies=table_varies, num_motions=64)
    first, *others = draw_futures(settings, (BLOCK, AWAY), Arms(lift, None).drives)
    assert not first.shift.any()
    shifts = np.stack([future.shift for future in others])
    for future in others:
        for solid, found in zip(future.solids, (BLOCK, AWAY), strict=True):
            np.testing.assert_allclose(solid.centre, found.centre + future.shift, atol=1e-12)
            # it stands on the table in every future
            assert solid.bottom == pytest.approx(future.settings.table_m, abs=1e-12)
    deviations = shifts.std(0)
    assert deviations[:2] == pytest.approx([0.01, 0.01], rel=0.3)
    # a table of known height says how high they are, whatever the cameras say
    assert deviations[2] == pytest.approx(0.01 if table_varies else 0.0, rel=0.3)


def test_what_cameras_see_elsewhere_is_foreseen_where_they_see_it(lift):
    sure = ContactSpread(**dict.fromkeys(ContactSpread.model_fields, 0.0) | {'camera_m': 0.01})
    settings = SETTINGS.replace(spread=sure, table_varies=True)
    foresight = SolidForesight(lift, None, settings)
    tracked = TrackedSolids(foresight=foresight, names=('block',), solids=(AWAY,))
    motions, _ = tracked.advance(picking())  # nothing touches it
    assert len(motions) == 4
    for motion in motions:
        np.testing.assert_allclose(motion.points[0, 0], AWAY.centre, atol=1e-4)
        np.testing.assert_allclose(motion.points[-1, 0], AWAY.centre, atol=1e-3)


def test_nothing_differs_where_all_is_known(lift):
    sure = ContactSpread(**dict.fromkeys(ContactSpread.model_fields, 0.0))
    motion, _ = batch_of(lift, BLOCK, spread=sure).advance(picking(), 5)
    np.testing.assert_array_equal(motion.points[1:], motion.points[:-1])


def test_a_late_future_does_the_same_later(lift):
    spread = ContactSpread(**dict.fromkeys(ContactSpread.model_fields, 0.0) | {'delay_s': 0.1})
    batch = batch_of(lift, AWAY, spread=spread)
    joints = batch.advance(picking(), 1)[0].joints[..., 0]
    for number in (1, 2, 3):
        late = round(batch.futures[number].delay_s / 0.02)
        if late:
            np.testing.assert_allclose(
                joints[number, late:], joints[0, :-late], atol=0.02 * 0.4 + 1e-3
            )


@pytest.mark.parametrize('is_crowded', [False, True])
def test_it_stops_within_50_ms(lift, monkeypatch, is_crowded):
    monkeypatch.setattr(engine_module, 'CROWDED_CONSTRAINTS', 40)
    solids = cluttered(6) if is_crowded else (BLOCK, AWAY)
    batch = batch_of(lift, *solids, num_motions=64)
    batch.advance(picking(0.2), 5)  # all is compiled
    asked = []

    def should_stop() -> bool:
        asked.append(time.thread_time())
        return len(asked) > 12

    with pytest.raises(RolloutPreempted):
        batch.advance(picking(), 5, should_stop=should_stop)
    # by the time of this thread, which computes all: other work on the machine does not count
    assert np.max(np.diff(asked)) < 0.05


def test_objects_that_cannot_all_be_where_they_were_found_are_refused_at_once(lift):
    places = np.random.default_rng(0).normal([0.0, 0.0, 0.1], 0.01, (20, 3))
    heap = [Solid(centre=place, size=np.full(3, 0.2)) for place in places]
    begun = time.process_time()
    one = tracked(lift, *heap)
    motions, one = one.advance(picking())
    assert time.process_time() - begun < 5
    assert all(np.isnan(motion.points).all() for motion in motions)
    assert 'objects overlap' in one.reasons[-1] and one.refusal


def cluttered(towers: int) -> list[Solid]:
    """Towers of two blocks side by side, where the hand comes down: many touches."""
    size, places = np.full(3, 0.04), np.arange(towers) - (towers - 1) / 2
    return [
        Solid(centre=np.array([0.041 * place, 0.0, height]), size=size)
        for place in places
        for height in (0.02, 0.06)
    ]


def test_crowded_futures_are_computed_in_pieces_that_depend_on_nothing_else(lift, monkeypatch):
    commands, asked, run = picking(1.0), [], Engine.run

    def counted(self, models, data, states, controls, out):
        asked.append((len(models), controls.shape[1]))
        run(self, models, data, states, controls, out)

    monkeypatch.setattr(Engine, 'run', counted)
    monkeypatch.setattr(engine_module, 'CROWDED_CONSTRAINTS', 40)
    found = []
    for threads in (1, 2):
        asked.clear()
        motion, state = batch_of(lift, *cluttered(3), threads=threads).advance(commands, 5)
        assert any(steps == SUBSTEPS for _, steps in asked)
        assert all(many <= threads for many, steps in asked if steps == SUBSTEPS)
        found.append((motion.points, state.lost))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    assert found[0][1] == found[1][1] == {}


def test_crowded_futures_have_an_end_that_no_clock_decides(lift, monkeypatch):
    monkeypatch.setattr(engine_module, 'CROWDED_CONSTRAINTS', 40)
    limits = DivergenceLimits(max_mean_constraints=20)
    monkeypatch.setattr(engine_module, '_LIMITS', limits)
    lost = []
    for _ in range(2):
        one = tracked(lift, *cluttered(3))
        motions, then = one.advance(picking(1.0))
        assert all(np.isnan(motion.points).all() for motion in motions) and then.refusal
        assert 'more touches, for longer' in then.reasons[-1]
        lost.append(then.state.lost)
    assert lost[0] == lost[1]


@pytest.mark.parametrize('threads', [1, 2])
def test_a_future_that_cannot_be_is_dropped_and_said(
    lift, threads, capfd, caplog, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(engine_module, '_told', set())
    batch = batch_of(lift, AWAY, threads=threads)
    state = batch.start(picking()[0])
    physics = state.physics.copy()
    physics[1, 1 + batch._scene.model.nq + batch._scene.solid_dofs[0]] = 1e3  # m/s
    physics[2, 1 + batch._scene.solid_qpos[0]] = np.nan
    state = replace(state, physics=physics, still=np.zeros(4, int))
    motion, then = batch.advance(picking(), 5, state)
    assert set(then.lost) == {1, 2}
    assert then.lost[2] == 'the engine diverged'
    assert then.lost[1] in ('an object left the table for good', then.lost[2])
    assert np.isfinite(motion.points[[0, 3]]).all()
    assert not list(tmp_path.iterdir()) and capfd.readouterr() == ('', '')
    told = [record.getMessage() for record in caplog.records]
    assert told and len(told) == len(set(told)) and all('MuJoCo' in line for line in told)


def tracked(robot, *solids, **changed) -> TrackedSolids:
    foresight = SolidForesight(robot, None, SETTINGS.model_copy(update=changed))
    names = tuple(f'object {k}' for k in range(len(solids)))
    return TrackedSolids(foresight=foresight, names=names, solids=solids)


def test_where_too_few_futures_are_left_nothing_is_said(lift):
    one = tracked(lift, AWAY)
    _, one = one.advance(picking(0.2))
    lost = replace(one, state=replace(one.state, lost=dict.fromkeys(range(3), 'diverged')))
    motions, _ = lost.advance(picking(0.2))
    assert all(np.isnan(motion.points).all() for motion in motions)
    assert lost.reasons == ('3 of 4 foreseen futures do not count: diverged',)
    # most of them: then there is no verdict at all
    assert lost.refusal == '3 of 4 foreseen futures are implausible'
    few = replace(one, state=replace(one.state, lost={2: 'diverged'}))
    motions, _ = few.advance(picking(0.2))
    assert [motion.weight for motion in motions] == [1, 1, 0, 1]


def test_what_floats_is_named_and_not_foreseen(lift):
    floating = replace(AWAY, centre=np.array([0.5, 0.2, 0.3]))
    motions, then = tracked(lift, BLOCK, floating).advance(picking(0.4))
    assert np.isnan(motions[0].points[:, 1]).all() and np.isfinite(motions[0].points[:, 0]).all()
    assert then.reasons == ("'object 1' seems to float 280 mm above the table",)


def test_what_stands_on_another_does_not_float(lift):
    upper = replace(AWAY, centre=np.array([0.5, 0.2, 0.06]))
    motions, then = tracked(lift, AWAY, upper).advance(picking(0.4))
    assert not then.reasons and np.isfinite(motions[0].points).all()


def test_what_is_not_seen_by_two_views_is_not_foreseen_and_hit_by_nothing(lift):
    motions, then = tracked(lift, None, AWAY).advance(picking(0.4))
    assert np.isnan(motions[0].points[:, 0]).all() and np.isfinite(motions[0].points[:, 1]).all()
    assert np.isnan(then.sizes[:, 0]).all()


def test_what_is_almost_hollow_is_of_one_kind_in_all_futures(lift):
    # 6 cm wide is where a flat box begins to count as a tray; futures differ by 1.5 % in size
    almost = Solid(centre=np.array([0.3, 0.0, 0.015]), size=np.array([0.0602, 0.0602, 0.03]))
    batch = batch_of(lift, almost, num_motions=16)
    assert len(batch.futures) == 16


def test_nothing_on_the_table_is_foreseen_as_nothing(lift):
    foresight = SolidForesight(lift, None, SETTINGS)
    tracked = TrackedSolids(foresight=foresight, names=(), solids=())
    motions, then = tracked.advance(picking(0.5))
    assert len(motions) == SETTINGS.num_motions
    assert motions[0].points.shape[1:] == (0, 3)
    assert then.sizes.shape == (SETTINGS.num_motions, 0, 3)
