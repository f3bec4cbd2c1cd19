"""Training of the object motion network on recorded episodes."""

from __future__ import annotations

import copy
from dataclasses import replace
import math
from pathlib import Path
import resource

import numpy as np
import pytest
import torch

from mtv_world_ros.bench.collect.collect_dataset import collect
from mtv_world_ros.bench.collect.episode_maker import CollectConfig
from mtv_world_ros.bench.collect.record import RecordConfig
from mtv_world_ros.bench.world.opengl import missing_opengl
from mtv_world_ros.cli import main
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.errors import ConfigError, TrainingError
from mtv_world_ros.files import share_path
from mtv_world_ros.lab.training.object_motion import motion_training, windows
from mtv_world_ros.lab.training.object_motion import tracks as tracks_module
from mtv_world_ros.lab.training.object_motion.motion_training import (
    end_errors,
    mean_network,
    MotionTraining,
    read_tracks,
    train_motion,
)
from mtv_world_ros.lab.training.object_motion.tracks import object_tracks, ObjectTracks
from mtv_world_ros.lab.training.object_motion.windows import filled_up, pools_of, TrackPool
from mtv_world_ros.model.object_motion.network import (
    _rotation,
    Memory,
    Motion,
    ObjectMotionNetwork,
    Truth,
)
from mtv_world_ros.model.object_motion.predictor import (
    load_contact,
    load_network,
    load_predictor,
    save_contact,
    save_network,
)

VIEWS = ('low', 'high')


@pytest.fixture(scope='module', autouse=True)
def one_thread():
    """Small operations on more threads than are free wait for each other most of the time."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def short_windows(monkeypatch) -> None:
    """A training step takes as long as its windows are."""
    monkeypatch.setattr(windows, 'WINDOW', 8)


@pytest.fixture(scope='module')
def episodes(tmp_path_factory) -> list[Path]:
    """Two episodes with a picture of the first frame alone, and where the objects went."""
    if reason := missing_opengl():
        pytest.skip(reason)
    out = tmp_path_factory.mktemp('first_pictures')
    policies = ('expert-noise-0.107', 'expert-stop-0.925')
    config = CollectConfig(policies=policies, record=RecordConfig(pictures='first'))
    collect('stack_blocks_two', 2, 5, out, config=config, progress=False)
    return sorted(path.parent for path in out.rglob('metadata.yaml'))


def busiest(track: ObjectTracks, count: int = 16) -> ObjectTracks:
    """The steps of an episode in which objects go furthest."""
    ways = np.linalg.norm(np.diff(track.points, axis=0), axis=-1).max(axis=1)
    gone = np.concatenate([[0.0], ways.cumsum()])
    first = int((gone[count:] - gone[:-count]).argmax())
    rows = slice(first, first + count + 1)
    return replace(
        track,
        tools=track.tools[rows],
        gaps=track.gaps[rows],
        recorded_tools=track.recorded_tools[rows],
        recorded_gaps=track.recorded_gaps[rows],
        points=track.points[rows],
        rotations=track.rotations[rows],
        known=track.known[rows],
    )


def test_tracks_are_the_recorded_poses_from_where_the_masks_have_the_objects(episodes, robot):
    (track,) = object_tracks(episodes[0], robot, VIEWS)
    recorded = read_episode(episodes[0]).object_poses
    assert recorded is not None and track.turns_known and track.known.all()
    true = recorded.T_base_object[:, :, :3, 3]
    assert np.linalg.norm(track.points[0] - true[0], axis=-1).max() < 0.015
    np.testing.assert_allclose(track.points - track.points[0], true - true[0], atol=1e-6)
    assert track.tools.shape[:2] == (len(track.points), 2)
    # before anything happens, tools are where they are commanded
    np.testing.assert_allclose(track.recorded_tools[0], track.tools[0], atol=2e-3)
    assert track.recorded_tools.shape == track.tools.shape
    np.testing.assert_allclose(track.recorded_gaps, track.gaps, atol=0.02)


def test_without_recorded_poses_the_masks_tell(robot, monkeypatch):
    demo = share_path('resource', 'demo_episode')

    def without_poses(*arguments, **options):
        return replace(read_episode(*arguments, **options), object_poses=None)

    monkeypatch.setattr(tracks_module, 'read_episode', without_poses)
    track, later = object_tracks(demo, robot, VIEWS, num_starts=2)
    assert 20 < len(later.points) < len(track.points) - 20
    assert later.known[0].any()
    np.testing.assert_allclose(later.tools, track.tools[-len(later.tools) :])
    assert not track.turns_known and track.known.any(axis=0).all()
    assert np.isfinite(track.points).all()
    # the demo stacks a block: something rises by more than its own height, between the fingers
    assert (track.points[..., 2].max(0) - track.points[0, :, 2]).max() > 0.03
    assert (track.recorded_gaps - track.gaps).max() > 0.015


def error_of_one_step(network: ObjectMotionNetwork, tracks: list[ObjectTracks]) -> float:
    """Mean error [m] after one step of 0.1 s from where the moving objects really were."""
    errors = []
    for track in tracks:
        batch = TrackPool([track]).whole(0)
        truth = Truth(
            points=batch.points,
            rotations=batch.rotations,
            known=batch.known,
            forced=torch.ones(batch.points.shape[:2], dtype=torch.bool)[:, :-1],
            lost_m=torch.tensor([torch.inf]),
            off=motion_training._off_way(batch),
        )
        with torch.inference_mode():
            motion = network(batch.scene, truth)
        moves = batch.points.diff(dim=1).norm(dim=-1) > 1e-3
        errors.append((motion.points - batch.points).norm(dim=-1)[:, 1:][moves].mean())
    return float(torch.stack(errors).nanmean())


def test_training_learns_its_own_episodes_and_writes_them(
    episodes, robot, tmp_path, short_windows
):
    read, skipped = read_tracks(episodes, robot, VIEWS, 3)
    # pictures of the first frame only: nowhere else to begin
    assert [len(starts) for starts in read] == [1, 1] and not skipped
    tracks = [busiest(starts[0]) for starts in read]
    torch.manual_seed(0)
    untrained = ObjectMotionNetwork(width=24, hidden=8)
    before = error_of_one_step(untrained, tracks)
    config = MotionTraining(steps=32, batch_size=16, learning_rate=0.02, forced_share=1.0)
    network = train_motion(tracks, tmp_path / 'b', config, init=untrained)
    assert error_of_one_step(network, tracks) < 0.9 * before
    after, _ = end_errors(network, tracks)
    loaded = load_network(tmp_path / 'b' / 'object_motion')
    np.testing.assert_allclose(end_errors(loaded, tracks)[0], after, atol=1e-6)
    assert (loaded.width, loaded.hidden) == (24, 8)
    with pytest.raises(ConfigError, match='exists; give another --out'):
        train_motion(tracks, tmp_path / 'b', config)
    with pytest.raises(TrainingError, match='--init: the network is 24 wide .* set --width'):
        train_motion(tracks, tmp_path / 'c', replace(config, width=16), init=loaded)


def test_products_in_bfloat16_train_nearly_the_same_and_keep_float32(
    episodes, robot, tmp_path, short_windows
):
    tracks = [starts[0] for starts in read_tracks(episodes, robot, VIEWS)[0]]
    config = MotionTraining(steps=8, batch_size=4, forced_share=1.0, width=24, hidden=8)
    weights = []
    for dtype in (torch.float32, torch.bfloat16):
        network = train_motion(tracks, tmp_path / str(dtype), replace(config, dtype=dtype))
        assert {value.dtype for value in network.state_dict().values()} == {torch.float32}
        weights.append(network.state_dict()['node.0.weight'])
    assert 0 < (weights[1] - weights[0]).norm() < 0.05 * weights[0].norm()


def test_training_goes_on_from_networks_and_replaces_none_unasked(
    episodes, robot, tmp_path, short_windows, capsys
):
    one, two = tmp_path / 'one', tmp_path / 'two'
    small = ['--steps', '1', '--batch-size', '2', '--threads', '1']
    train = ['train-motion', str(episodes[0].parent), *small]
    assert main([*train, '--out', str(one), '--width', '16', '--hidden', '8']) == 0
    again = [*train, '--out', str(two), '--init', f'{one},{one}', '--ensemble', str(one)]
    assert main(again) == 0
    loaded = load_network(two / 'object_motion')
    assert (loaded.width, loaded.hidden) == (16, 8)
    assert len(load_predictor(two / 'object_motion', robot).members) == 2
    assert main(again) == 1
    assert "two/object_motion' exists; give another --out" in capsys.readouterr().err
    contact = load_contact(share_path('resource', 'checkpoint', 'object_motion'))
    assert contact is not None
    save_contact(contact, two / 'object_motion')
    assert main([*again, '--overwrite']) == 0
    assert load_contact(two / 'object_motion') == contact
    assert main([*train, '--out', str(tmp_path / 'new'), '--device', 'gpu']) == 1
    assert "device 'gpu' is not known" in capsys.readouterr().err
    assert main([*train, '--out', str(tmp_path / 'new'), '--init', str(tmp_path)]) == 1
    assert 'cannot be used' in capsys.readouterr().err and not (tmp_path / 'new').exists()


def test_the_mean_of_networks_has_the_mean_of_their_weights():
    first, second = (ObjectMotionNetwork(width=24, hidden=8) for _ in range(2))
    mean = mean_network([first, second]).state_dict()
    for name, value in second.state_dict().items():
        torch.testing.assert_close(mean[name], (value + first.state_dict()[name]) / 2)
    with pytest.raises(TrainingError, match='networks of several sizes have no mean'):
        mean_network([first, ObjectMotionNetwork(width=16, hidden=8)])


def test_without_a_step_the_mean_is_written_as_it_is(episodes, robot, tmp_path):
    tracks = [object_tracks(episodes[0], robot, VIEWS)[0]]
    mean = ObjectMotionNetwork(width=24, hidden=8, fingertips=True, yielding=True, touching=True)
    train_motion(tracks, tmp_path, MotionTraining(steps=0), init=mean)
    loaded = load_network(tmp_path / 'object_motion').state_dict()
    assert all(torch.equal(loaded[name], value) for name, value in mean.state_dict().items())
    assert (tmp_path / 'motion.csv').read_text() == 'step,loss\n'


def test_siblings_share_a_batch_and_count_for_more_where_they_part(episodes, robot, monkeypatch):
    (track,) = object_tracks(episodes[0], robot, VIEWS)
    assert track.scene == ''
    away = track.points + np.linspace(0, 0.05, len(track.points))[:, None, None] * [1, 0, 0]
    first, second = replace(track, scene='a'), replace(track, scene='a', points=away)
    monkeypatch.setattr(windows, '_FROM_START', 1.0)
    monkeypatch.setattr(windows, '_SIBLINGS_SHARE', 0.5)
    more = replace(track, features=np.concatenate([track.features, track.features[:1]]))
    pool, other = pools_of([track, first, second, more], 'cpu')
    assert [family.tolist() for family in pool.families] == [[1, 2]] and not other.families
    rng = np.random.default_rng(0)
    assert [len(group) for group in pool._drawn(8, rng)] == [2, 2, 1, 1, 1, 1]
    parted = pool.draw(8, rng).parted
    shift = 0.05 * np.arange(len(track.points)) / (len(track.points) - 1)
    wanted = torch.from_numpy(shift[: windows.WINDOW + 1] > 0.01)
    assert (parted[:4] == wanted[:, None]).all()
    assert not parted[4:].any()


def test_windows_are_of_their_tracks_turned_and_seen_a_little_elsewhere(episodes, robot):
    (track,) = object_tracks(episodes[0], robot, VIEWS)
    pool, rng = TrackPool([track]), np.random.default_rng(1)
    recorded = torch.from_numpy(track.points).float()
    found = _distances(recorded, torch.from_numpy(track.tools).float())
    for _ in range(8):
        batch = pool.draw(16, rng)
        assert batch.points.shape == (16, windows.WINDOW + 1, *recorded.shape[1:])
        begins = batch.scene.points[..., 2].sort(-1).values - recorded[0, :, 2].sort().values
        assert begins.abs().max() < 0.006
        # how far apart tools and objects are does not turn
        near = _distances(batch.points, batch.scene.tools)
        starts = torch.arange(len(recorded) - windows.WINDOW)
        rows = starts[:, None] + torch.arange(windows.WINDOW + 1)
        for window in near:
            assert (window - found[rows]).abs().amax((1, 2, 3)).min() < 0.006


def test_objects_that_are_not_there_change_nothing(episodes, robot):
    (track,) = object_tracks(episodes[0], robot, VIEWS)
    count = len(track.features)
    torch.manual_seed(0)
    network = ObjectMotionNetwork(width=24, hidden=8)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.05)
    losses, motions = [], []
    for one in (track, filled_up(track, count + 2)):
        batch = TrackPool([one]).whole(0)
        motions.append(network(batch.scene))
        losses.append(motion_training._loss(motions[-1], batch))
    assert motions[1].points.shape[2] == count + 2
    torch.testing.assert_close(motions[1].points[:, :, :count], motions[0].points)
    torch.testing.assert_close(losses[1], losses[0])
    losses[1].backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in network.parameters())


@pytest.mark.parametrize('shape', [(12, 30), (30, 12)])
def test_muon_steps_along_the_nearest_orthogonal_matrix_in_float32(shape):
    torch.manual_seed(0)
    U, _, Vh = torch.linalg.svd(torch.randn(*shape), full_matrices=False)
    gradient = U @ torch.diag(torch.linspace(0.3, 1.0, 12)) @ Vh
    weight = torch.nn.Parameter(torch.zeros(*shape))
    weight.grad = gradient.clone()
    plain, own = (
        torch.optim.Muon([weight], lr=1.0, weight_decay=0.0),
        torch.nn.Parameter(weight.clone()),
    )
    own.grad = gradient.clone()
    motion_training._Muon([own], lr=1.0, weight_decay=0.0).step()
    plain.step()
    # torch's is off by what bfloat16 rounds
    assert 0 < (own - weight).norm() < 0.02 * weight.norm()
    # -U V^T but for the sizes of its singular values, which stay near one
    sizes = -(U.T @ own.detach() @ Vh.T)
    off = sizes - torch.diag(sizes.diagonal())
    assert off.abs().max() < 1e-4 and (sizes.diagonal() / sizes.diagonal().mean()).min() > 0.6


def test_a_lost_object_goes_on_from_the_truth_as_fast_as_it_really_is():
    torch.manual_seed(0)
    points = 0.1 * torch.randn(2, 4, 3, 3)
    turn = torch.tensor([0.0, 0.0, 0.3])
    rotations = torch.stack([_rotation(step * turn) for step in range(4)])
    rotations = rotations[None, :, None].expand(2, 4, 3, 3, 3)
    forced = torch.zeros(2, 3, dtype=torch.bool)
    known = torch.ones(2, 4, 3, dtype=torch.bool)
    truth = Truth(
        points=points,
        rotations=rotations,
        known=known,
        forced=forced,
        lost_m=torch.tensor([0.02, torch.inf]),
        off=torch.arange(8.0).view(2, 4, 1, 1).expand(2, 4, 1, 7),
    )
    aside = torch.zeros(2, 3, 3)
    aside[:, 1, 0] = 0.03
    aside[:, 2, 0] = 0.01
    now = Memory(
        points=points[:, 2] + aside,
        rotations=torch.eye(3).expand(2, 3, 3, 3),
        velocity=torch.ones(2, 3, 6),
        hidden=torch.ones(2, 3, 5),
        held=torch.zeros(2, 3, 1),
        spread=torch.zeros(2, 3),
        off=torch.full((2, 1, 7), -1.0),
        off_before=torch.full((2, 1, 7), -2.0),
    )
    right = truth.put_right(now, 2)
    lost = torch.tensor([[False, True, False], [False, False, False]])
    assert torch.equal(right.points[~lost], now.points[~lost])
    assert torch.equal(right.velocity[~lost], now.velocity[~lost])
    assert torch.equal(right.points[lost], points[:, 2][lost])
    assert torch.equal(right.rotations[lost][0], rotations[0, 2, 1])
    way = torch.cat([points[0, 2, 1] - points[0, 1, 1], turn])
    torch.testing.assert_close(right.velocity[lost][0], way, rtol=0.02, atol=1e-6)
    assert torch.equal(right.hidden, now.hidden)
    # where something is lost, tools are put right as well
    assert right.off[:, 0, 0].tolist() == [2, -1] and right.off_before[:, 0, 0].tolist() == [1, -2]
    # so are tools that are lost themselves
    alone = replace(truth, points=now.points[:, None].expand_as(points))
    assert alone.put_right(now, 2).off[:, 0, 0].tolist() == [2, -1]
    near = replace(now, off=truth.off[:, 2] + 0.01)
    assert torch.equal(alone.put_right(near, 2).off, near.off)
    # one that starts from the truth keeps its own speed
    forced[:, 2] = True
    right = truth.put_right(now, 2)
    assert torch.equal(right.points, points[:, 2])
    assert torch.equal(right.velocity[~lost], now.velocity[~lost])
    assert right.off[:, 0, 0].tolist() == [2, 6] and right.off_before[:, 0, 0].tolist() == [1, 5]
    # nobody knows where something hidden is
    known[:, 2] = False
    right = truth.put_right(now, 2)
    assert torch.equal(right.points, now.points) and torch.equal(right.velocity, now.velocity)


def test_lost_objects_are_put_right_in_the_first_part_of_the_training_only(episodes, robot):
    tracks = [object_tracks(path, robot, VIEWS)[0] for path in episodes]
    batch = pools_of(tracks, 'cpu')[0].draw(3, np.random.default_rng(0))
    config = MotionTraining(lost_m=0.015, lost_share=0.4)
    for progress, wanted in ((0.0, 0.015), (0.39, 0.015), (0.41, math.inf)):
        found = motion_training._lost_m(progress, config, batch)
        assert found.tolist() == pytest.approx([wanted] * 3)


def test_gradients_shrink_from_step_to_step(episodes, robot):
    tracks = [object_tracks(path, robot, VIEWS)[0] for path in episodes]
    batch = pools_of(tracks, 'cpu')[0].draw(3, np.random.default_rng(0))
    torch.manual_seed(0)
    network = ObjectMotionNetwork(width=24, hidden=8)
    plain, seen = network.step, []
    network.step = motion_training._damped(plain)
    damped = []
    for step in (plain, network.step):
        network.step = step
        scene = replace(batch.scene, points=batch.scene.points.clone().requires_grad_())
        motion = network(scene)
        (gradient,) = torch.autograd.grad(motion.points[:, 4, :, 2].sum(), scene.points)
        damped.append(gradient[..., 2])
        seen.append(motion.points)
    assert torch.equal(seen[0], seen[1])
    # an untrained network leaves everything where it is: the gradient goes through four steps
    torch.testing.assert_close(damped[1], motion_training._KEPT**4 * damped[0], rtol=0.05, atol=0)


@pytest.mark.gpu
def test_captured_passes_give_the_loss_and_gradients_of_plain_ones(episodes, robot):
    tracks = [object_tracks(path, robot, VIEWS)[0] for path in episodes]
    torch.manual_seed(0)
    plain = ObjectMotionNetwork(width=24, hidden=8)
    for parameter in plain.parameters():
        torch.nn.init.normal_(parameter, std=0.05)
    quick = copy.deepcopy(plain).to('cuda')
    passes, captured = motion_training._Passes(plain), motion_training._Passes(quick)
    (pool,) = pools_of(tracks, 'cuda')
    most = max(len(track.features) for track in tracks)
    (same,) = pools_of([filled_up(track, most) for track in tracks], 'cpu')
    for seed in range(3):
        losses = []
        for one, run in ((same, passes), (pool, captured)):
            batch = one.draw(8, np.random.default_rng(seed))
            forced = torch.zeros(8, windows.WINDOW, dtype=torch.bool, device=batch.points.device)
            forced[:, 0] = True
            lost_m = torch.full((8,), 0.02, device=batch.points.device)
            losses.append(run(batch, forced, lost_m).item())
        assert losses[1] == pytest.approx(losses[0], rel=1e-3)
        for wanted, found in zip(plain.parameters(), quick.parameters(), strict=True):
            torch.testing.assert_close(found.grad.cpu(), wanted.grad, rtol=0.01, atol=1e-3)


def _distances(points, tools):
    """(..., T, O, A) of points (..., T, O, 3), objects in the order of their distance."""
    apart = points[..., :, None, :] - tools[..., None, :, :3, 3]
    return apart.norm(dim=-1).sort(-2).values


def test_episodes_that_cannot_be_used_are_named(tmp_path, robot):
    with pytest.raises(TrainingError, match='no episode can be trained on'):
        read_tracks([tmp_path], robot, VIEWS)
    with pytest.raises(TrainingError, match='no episode is left to train on'):
        train_motion([], tmp_path / 'b', MotionTraining())


def test_a_full_disk_leaves_the_last_network_whole(tmp_path):
    """Files may not grow beyond a limit here, which fails at the same calls as a full disk."""
    first, second = (ObjectMotionNetwork(width=24, hidden=8) for _ in range(2))
    save_network(first, tmp_path / 'object_motion')
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    try:
        with pytest.raises(OSError, match='too large|No space'):
            save_network(second, tmp_path / 'object_motion')
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [path.name for path in tmp_path.iterdir()] == ['object_motion']
    kept, wanted = load_network(tmp_path / 'object_motion').state_dict(), first.state_dict()
    assert all(torch.equal(kept[name], value) for name, value in wanted.items())


def test_an_imagined_grasp_that_fails_costs_what_a_missed_one_costs(episodes, robot):
    (track,) = object_tracks(episodes[0], robot, VIEWS)
    stays = TrackPool([track]).whole(0)
    still = stays.points[:, :1].expand_as(stays.points)
    carried = still + torch.linspace(0, 0.1, still.shape[1])[None, :, None, None]
    turns = torch.eye(3).expand_as(stays.rotations)

    def cost(imagined, real):
        spread = torch.full(real.shape[:3], 0.01)
        held = torch.zeros(*real.shape[:3], 2)
        motion = Motion(
            points=imagined,
            rotations=turns,
            held=held,
            spread=spread,
            off=motion_training._off_way(stays),
        )
        return motion_training._loss(motion, replace(stays, points=real, rotations=turns)).item()

    assert cost(carried, still) == pytest.approx(cost(still, carried), rel=1e-5)
    assert cost(carried, carried) < cost(still, carried)


def test_a_swing_that_is_missed_costs_what_a_wrong_place_costs(episodes, robot):
    (track,) = object_tracks(episodes[0], robot, VIEWS)
    real = TrackPool([track]).whole(0)
    held = torch.zeros(*real.points.shape[:3], 2)

    def cost(angle=0.0, aside=0.0):
        cos, sin = math.cos(angle), math.sin(angle)
        turn = torch.tensor([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        motion = Motion(
            points=real.points + torch.tensor([aside, 0.0, 0.0]),
            rotations=real.rotations @ turn,
            held=held,
            spread=torch.full(real.points.shape[:3], 0.01),
            off=motion_training._off_way(real),
        )
        return motion_training._loss(motion, real).item()

    assert cost(angle=0.15) - cost() > 0.5 * (cost(aside=0.005) - cost())
    assert cost(angle=3.1) - cost() < cost(aside=0.05) - cost()  # how far it tumbles


def test_what_follows_a_tool_is_carried_and_what_stays_is_not(episodes, robot):
    (track,) = object_tracks(episodes[0], robot, VIEWS)
    real = TrackPool([track]).whole(0)
    tools = torch.eye(4).repeat(1, 9, 2, 1, 1)
    tools[0, :, 0, 2, 3] = 0.01 * torch.arange(9)  # the first tool rises, the second stands still
    points = torch.zeros(1, 9, 3, 3)
    points[0, :, 0, 2] = 0.01 * torch.arange(9)
    points[0, :, 2, 0] = 0.5
    carried, asked = motion_training._carried(replace(real, tools=tools, points=points))
    assert carried[0, :, 0, 0].all() and not carried[0, :, 1:].any()
    assert asked[0, :, :2, 0].all()  # the third object is far away
    assert not asked[0, :, 2].any() and not asked[..., 1].any()


def test_turned_and_mirrored_tools_are_off_their_way_as_they_were(episodes, robot):
    (track,) = object_tracks(episodes[0], robot, VIEWS)
    batch = TrackPool([track]).whole(0)
    wanted, rng = motion_training._off_way(batch), np.random.default_rng(0)
    found = [motion_training._off_way(windows._turned(batch, rng)) for _ in range(12)]
    # mirrored, what is across the fingers' travel is to the other side, and turns about the
    # other two axes are the other way round
    mirror = torch.tensor([-1.0, 1, 1, 1, -1, -1, 1])
    same = [(off - wanted).abs().max() < 1e-5 for off in found]
    mirrored = [(off - wanted * mirror).abs().max() < 1e-5 for off in found]
    assert any(same) and any(mirrored)
    assert all(a or b for a, b in zip(same, mirrored, strict=True))


def test_a_tool_that_is_not_expected_to_be_stopped_costs(episodes, robot):
    (track,) = object_tracks(episodes[0], robot, VIEWS)
    real = TrackPool([track]).whole(0)

    def cost(**wrong: float) -> float:
        off = motion_training._off_way(real).clone()
        for column, by in wrong.items():
            off[..., int(column[1:])] += by
        motion = Motion(
            points=real.points,
            rotations=real.rotations,
            held=torch.zeros(*real.points.shape[:3], 2),
            spread=torch.full(real.points.shape[:3], 0.01),
            off=off,
        )
        return motion_training._loss(motion, real).item()

    assert cost(_2=0.01) == pytest.approx(cost() + 1.5, rel=1e-4)  # half a square, of 1 cm
    assert cost(_6=0.01) == pytest.approx(cost() + 1.5, rel=1e-4)
    assert cost(_4=0.1) == pytest.approx(cost() + 0.3, rel=1e-4)
