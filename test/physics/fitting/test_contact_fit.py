"""Friction, weight, grip, delay and table, found in masks and joint states alone."""

from __future__ import annotations

from dataclasses import replace
import json
from pathlib import Path
import re
import shutil

import numpy as np
import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import TrainingError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.model.checkpoint import checkpoint_folder
from mtv_world_ros.physics.arms.arms import Arms
from mtv_world_ros.physics.checkpoint_files import CONTACT_FILE, load_contact, load_foresight
from mtv_world_ros.physics.contact_settings import ContactOrigin
from mtv_world_ros.physics.engine.contact_scene import CompiledScene
from mtv_world_ros.physics.engine.engine import Engine
from mtv_world_ros.physics.fitting import contact_fit
from mtv_world_ros.physics.fitting.contact_fit import (
    find_delay,
    find_table,
    first_settings,
    fit_contact,
    read_contact,
    read_recordings,
)
from mtv_world_ros.physics.solid_foresight import SolidForesight
from mtv_world_ros.robot.file import load_robot, robot_path

VIEWS = ('low', 'high')
DEMO = share_path('resource', 'demo_episode')


@pytest.fixture(scope='module')
def recording(robot):
    return read_contact(DEMO, robot, VIEWS)


@pytest.fixture
def settings():
    found = load_contact(checkpoint_folder('bundled') / 'object_motion')
    assert found is not None
    return found


@pytest.fixture
def checkpoint(tmp_path) -> Path:
    copied = tmp_path / 'checkpoint'
    shutil.copytree(checkpoint_folder('bundled'), copied)
    return copied


def test_objects_are_where_masks_show_them_and_no_recorded_pose_is_read(recording):
    episode = read_episode(DEMO, views=VIEWS)
    assert episode.object_poses is not None
    true = episode.object_poses.T_base_object[:, :, :3, 3]
    carried = recording.displacements[-1, 0]
    assert carried == pytest.approx(true[-1, 0] - true[0, 0], abs=0.006)
    # the block below it is hidden in part by then: its masks no longer say where it is
    assert np.isnan(recording.displacements[-1, 1]).all()
    assert np.isfinite(recording.displacements[:5]).all()


def test_cameras_that_are_off_are_as_far_off_as_their_rays_pass_each_other(recording):
    found = contact_fit.find_cameras([recording] * 3)
    assert found.value < 0.001  # those of the simulator are right
    frame = recording.frame
    points = frame.points()
    rays = [points - pose[:3, 3] for pose in frame.poses]
    aside = np.cross(rays[0][0], rays[1][0])
    moved = frame.poses[0].copy()
    moved[:3, 3] += 0.014 * aside / np.linalg.norm(aside)
    off = replace(recording, frame=replace(frame, poses=(moved, frame.poses[1])))
    found = contact_fit.find_cameras([off] * 3)
    # one of the two rays is off by 14 mm: as if either were by 10
    assert found.value == pytest.approx(0.014 / np.sqrt(2), rel=0.15)
    assert (found.count, found.of) == (6, 6)


def test_slippery_fingers_are_unlikely_where_a_block_was_carried(
    recording, robot, response, settings
):
    trial = contact_fit._Trial.of(recording, settings, robot)
    tried = [settings.model_copy(update={'grip_friction': value}) for value in (0.05, 0.8, 1.6)]
    low, middle, high = trial.likelihoods(Engine(Arms(robot, response)), tried)
    assert middle > low + 2 and high > low + 2


@pytest.mark.slow
def test_the_search_finds_what_made_the_motions(robot, response, settings, recording, monkeypatch):
    """Recordings made by foresight itself under known numbers, in place of real ones."""
    fit = contact_fit.ContactFitSettings(num_draws=32, num_rounds=2)
    monkeypatch.setattr(contact_fit, '_FIT', fit)
    truth = settings.model_copy(update={'grip_friction': 0.05, 'num_motions': 1})
    frame = recording.frame
    tracked = SolidForesight(robot, response, truth).find(
        recording.names, frame.masks, frame.cameras, frame.poses
    )
    (motion,), _ = tracked.advance(recording.positions)
    made = replace(recording, displacements=motion.points - motion.points[0])
    told = list[str]()
    found, numbers = fit_contact([made] * 4, Arms(robot, response), settings, report=told.append)
    by_name = {one.name: one for one in numbers}
    # the search begins at 1.6; a block that slips says how well it is held, not why
    true = 0.05 * settings.finger_stiffness / settings.density
    assert by_name['hold'].low < true < by_name['hold'].high < 0.3 * true * 1.6 / 0.05
    assert by_name['grip_friction'].value < 0.5
    assert by_name['grip_friction'].high < settings.grip_friction
    assert found.grip_friction == by_name['grip_friction'].value
    assert found.spread.grip == pytest.approx(np.clip(by_name['grip_friction'].spread, 0.1, 0.8))
    assert by_name['grip_friction'].count == 4
    # enough draws are likely that their intervals tell something
    last = next(line for line in told if line.startswith('round 2'))
    assert float(last.split('worth ')[1].split()[0]) > 5
    assert 'too narrow' not in ' '.join(told)


@pytest.mark.slow
def test_numbers_that_make_up_for_each_other_are_within_their_intervals(
    robot, response, settings, recording, monkeypatch
):
    """Recordings of a slip, made by foresight itself under known numbers."""
    fit = contact_fit.ContactFitSettings(num_draws=32)
    monkeypatch.setattr(contact_fit, '_FIT', fit)
    numbers = {'grip_friction': 0.4, 'density': 900.0}
    numbers['finger_stiffness'] = 0.4 * settings.finger_stiffness
    truth = settings.model_copy(update={**numbers, 'num_motions': 1})
    frame = recording.frame
    tracked = SolidForesight(robot, response, truth).find(
        recording.names, frame.masks, frame.cameras, frame.poses
    )
    (motion,), _ = tracked.advance(recording.positions)
    made = replace(recording, displacements=motion.points - motion.points[0])
    found, all_found = fit_contact([made] * 3, Arms(robot, response), settings)
    by_name = {one.name: one for one in all_found}
    for name, value in numbers.items():
        assert by_name[name].low < value < by_name[name].high
    # an object slips where friction times force is too little for its weight: that alone shows
    hold = by_name['hold']
    assert hold.low < 0.4 * numbers['finger_stiffness'] / 900.0 < hold.high
    assert (
        hold.high / hold.low < 0.5 * by_name['grip_friction'].high / by_name['grip_friction'].low
    )
    assert not by_name['grip_friction'].apart
    assert 'not told apart from the other numbers by these' in str(by_name['grip_friction'])
    origin = ContactOrigin(by='mtv-world fit contact', recordings=3, telling=3, place='')
    assert found.fitted.replace(hold=()) == origin
    low, high = found.fitted.hold
    assert 0 < low < high
    # futures differ by what is not known once the others are
    assert found.spread.grip < 0.5 * np.log(
        by_name['grip_friction'].high / by_name['grip_friction'].low
    )


def test_intervals_of_many_alike_recordings_rest_on_enough_draws():
    """Where the likelihood of many leaves one draw, as much of it counts as leaves some."""
    rng = np.random.default_rng(0)
    draws = rng.normal(size=192)
    told = -20 * (draws - 0.3) ** 2 * 40  # as if a deviation of .025 were known
    weights, share = contact_fit._weights(told, np.zeros(192))
    assert weights.sum() == pytest.approx(1) and share < 0.5
    assert 16 <= contact_fit._effective_draws(weights) < 22
    few, whole = contact_fit._weights(-0.5 * draws**2, np.zeros(192))
    assert whole == 1 and contact_fit._effective_draws(few) > 50


def test_how_late_commands_arrive_is_found(recording, robot, response):
    late = np.concatenate([np.repeat(recording.recorded[:1], 5, 0), recording.recorded])
    delayed = replace(recording, recorded=late[: len(recording.recorded)])
    usual = find_delay([recording], Arms(robot, response))
    found = find_delay([delayed], Arms(robot, response))
    assert usual.value == pytest.approx(0.0, abs=0.01)
    assert found.value == pytest.approx(0.1, abs=0.01)
    assert str(found).startswith('commands arrive late by [s]: 0.1')
    assert str(found).endswith('(rests on 1 of 1 recordings)')


def test_the_table_is_found_where_objects_stand(recording):
    found = find_table([recording])
    assert found.value == pytest.approx(0.0, abs=1e-3)
    assert str(found).endswith('(rests on 2 of 2 objects)')
    raised = []
    for pose in recording.frame.poses:
        higher = np.array(pose)
        higher[2, 3] += 0.012  # cameras and all they see are higher
        raised.append(higher)
    frame = replace(recording.frame, poses=tuple(raised))
    found = find_table([replace(recording, frame=frame)])
    assert found.value == pytest.approx(0.012, abs=5e-4)
    assert found.low < 0.012 < found.high


def test_several_tables_and_measured_commands_are_told(robot, recording, settings):
    def of(*recordings):
        said: list[str] = []
        return contact_fit.settings_of_place(settings, recordings, said.append), said

    changed, said = of(recording)
    assert changed == settings and not said
    poses = [np.array(pose) for pose in recording.frame.poses]
    for pose in poses:
        pose[2, 3] += 0.06
    raised = replace(recording, frame=replace(recording.frame, poses=tuple(poses)))
    changed, said = of(recording, raised)
    assert changed.table_varies and changed.squeeze == 0
    low, high = map(float, re.findall(r'\d\.\d+', said[0]))
    assert low == pytest.approx(0, abs=2e-3) and high == pytest.approx(0.06, abs=2e-3)
    assert contact_fit._Trial.of(raised, changed, robot).table_m == pytest.approx(0.06, abs=2e-3)
    changed, said = of(replace(recording, positions=recording.recorded))
    assert changed.squeeze > 0 and 'measured positions' in said[0]


@pytest.mark.filterwarnings('error')
def test_numbers_of_which_nothing_tells_say_so():
    draws = np.log(np.tile([[0.5], [1.0], [2.0]], (64, 1)))
    found = contact_fit._finding(
        'table_friction', draws[:, 0], np.zeros((192, 3)), np.full(192, 1 / 192)
    )
    assert found.count == 0 and 'none of 3 recordings tells' in str(found)
    assert found.low == pytest.approx(0.5) and found.high == pytest.approx(2.0)


def test_recordings_that_say_nothing_are_refused(robot, response, recording, tmp_path):
    recordings, skipped = read_recordings([DEMO, tmp_path], robot, VIEWS)
    assert len(recordings) == 1 and list(skipped) == [str(tmp_path)]
    unseen = replace(recording, displacements=np.full_like(recording.displacements, np.nan))
    for nothing in ([], [unseen]):
        with pytest.raises(TrainingError, match='no episode says where an object went'):
            fit_contact(nothing, Arms(robot, response))


@pytest.mark.parametrize('left_out', [1, 7])
def test_joint_states_without_a_gripper_leave_a_recording_out(
    robot, tmp_path, monkeypatch, left_out
):
    read = contact_fit.read_episode

    def without(path, **options):
        episode = read(path, **options)
        states = episode.joint_states
        kept = [column for column in range(len(states.joint_names)) if column not in (6, left_out)]
        names = tuple(states.joint_names[column] for column in kept)
        states = replace(states, joint_names=names, positions=states.positions[:, kept])
        return replace(episode, joint_states=states)

    missing = {robot.joint_names[6], robot.joint_names[left_out]}
    monkeypatch.setattr(contact_fit, 'read_episode', without)
    recordings, skipped = read_recordings([DEMO], robot, VIEWS)
    assert not recordings
    assert all(name in skipped[str(DEMO)] for name in missing)
    assert '--robot' in skipped[str(DEMO)]


def test_measured_recordings_in_which_nothing_is_ever_held_tell_nothing(
    robot, response, recording
):
    """No stop of fingers, or masks that lose what was held: nothing is simulated."""
    measured = replace(recording, positions=recording.recorded, stops=())
    lost = np.full_like(recording.displacements, np.nan)
    lost[:5] = 0.0  # it leaves the table, and is seen no more
    lines = []
    settings, found = fit_contact(
        [measured, replace(measured, displacements=lost)],
        Arms(robot, response),
        report=lines.append,
    )
    assert found[-1].name == 'hold' and found[-1].count == 0
    assert 'not within' in settings.doubt
    assert any('0 of these stops, in 0 of 2 recordings' in line for line in lines)


def test_a_recording_that_is_left_out_tells_nothing(settings):
    draws = np.log(np.array([[0.1, 1.0, 300.0, 1.0], [2.0, 1.0, 300.0, 1.0]] * 32))
    likely = np.where(np.arange(64) % 2, 0.0, -9.0)  # rough fingers
    samples = contact_fit.ContactSamples(
        first=settings,
        logs=draws,
        likelihoods=np.stack([likely, np.zeros(64)], axis=1),
        others=np.zeros(64),
        stops=((), ()),
    )
    (told, _), (untold, _) = samples.fit(), samples.without(0).fit()
    assert told.grip_friction == pytest.approx(2.0, rel=0.01)
    assert untold.grip_friction == pytest.approx(np.sqrt(0.2), rel=0.01)
    assert untold.fitted is not None and untold.fitted.recordings == 1


def test_fingers_begin_as_their_joints_follow(robot, response):
    found = first_settings(Arms(robot, response))
    columns = [robot.joint_names.index(tool.gripper_joint) for tool in robot.tools]
    both = 0.5 / response.compliance[columns]
    assert found.finger_stiffness == pytest.approx(both.mean(), rel=0.05)


def test_the_command_writes_what_a_checkpoint_foresees_with(checkpoint, capsys, monkeypatch):
    fit = contact_fit.ContactFitSettings(num_draws=8, num_rounds=1)
    monkeypatch.setattr(contact_fit, '_FIT', fit)
    words = ['fit', 'contact', str(DEMO), '--checkpoint', str(checkpoint), '--motions', '2']
    assert main(words) != 0
    assert '--overwrite' in capsys.readouterr().err
    assert main([*words, '--overwrite']) == 0
    file = checkpoint / 'object_motion' / CONTACT_FILE
    out = capsys.readouterr().out
    assert f'1 episodes, 0 left out: {file}' in out
    for text in ('height of the table [m]: ', 'friction of fingers: ', 'of 1 recordings'):
        assert text in out
    contact = load_contact(file.parent)
    assert contact is not None and contact.num_motions == 2
    assert contact.model_dump(mode='json') == json.loads(file.read_text())


def test_how_arms_follow_is_found_where_a_checkpoint_does_not_know(
    tmp_path, robot, capsys, monkeypatch
):
    """Of one episode alone nothing is: defaults are taken, and said."""
    fingers = contact_fit.FingerFitSettings(num_candidates=4)
    fit = contact_fit.ContactFitSettings(num_draws=4, num_rounds=1)
    monkeypatch.setattr(contact_fit, '_FINGERS', fingers)
    monkeypatch.setattr(contact_fit, '_FIT', fit)
    assert main(['fit', 'contact', str(DEMO), '--out', str(tmp_path / 'new')]) == 0
    told = capsys.readouterr().out
    assert 'how 14 joints follow commands was not found' in told and 'one episode' in told
    assert 'draws decide' in told and 'intervals are too narrow' in told  # of four draws
    assert load_foresight(tmp_path / 'new' / 'object_motion', robot).response is None


@pytest.mark.parametrize('name', ['franka', 'ur5e_pair'])
def test_robots_without_inertias_have_numbers_to_begin_with(name):
    arms = Arms(load_robot(robot_path(name)), None)
    found = first_settings(arms)
    assert np.isfinite(found.finger_stiffness) and found.finger_stiffness > 50
    assert any('state no inertia' in note for note in arms.notes)


@pytest.mark.parametrize('deep_m', [0.0, 0.03])
def test_a_fit_says_how_far_fingers_are_below_the_table_of_the_objects(
    robot, response, recording, deep_m
):
    """Cameras that see all by as much too high draw fingers as far below the table."""
    arms, said = Arms(robot, response), list[str]()
    lowest = arms.drives.spread(recording.recorded[::10])
    height_m = CompiledScene.compiled(arms, ()).lowest_fingers(lowest)[0].min()
    poses = [np.array(pose) for pose in recording.frame.poses]
    for pose in poses:
        pose[2, 3] += height_m + deep_m
    off = replace(recording, frame=replace(recording.frame, poses=tuple(poses)))
    contact_fit.report_depths([off, recording], arms, 0.001, said.append)
    if not deep_m:
        assert not said
        return
    depth_mm = float(re.search(r'\[mm\]: \S+ (\d+) \(at', said[0]).group(1))
    assert depth_mm == pytest.approx(1e3 * deep_m, abs=2)
    assert '1 of 2 recordings' in said[0] and 'run mtv-world fit camera again' in said[1]
