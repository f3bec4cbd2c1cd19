"""The object motion network: chunks, padding, files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mtv_world_ros.errors import CheckpointError
from mtv_world_ros.files import share_path
from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.model.object_motion.arm_response import ArmResponse
from mtv_world_ros.model.object_motion.network import (
    _pose,
    _rotation,
    ObjectMotionNetwork,
    off_way,
    Scene,
)
from mtv_world_ros.model.object_motion.predictor import (
    add_members,
    load_network,
    load_predictor,
    Member,
    ObjectMotionPredictor,
    save_network,
    TrackedObjects,
)
from mtv_world_ros.model.object_motion.stacked import stacked

STEPS = 12


def lively(seed: int, width: int = 32, hidden: int = 16, **more: bool) -> ObjectMotionNetwork:
    """An untrained network that moves objects: as it is made it would hold everything still."""
    torch.manual_seed(seed)
    network = ObjectMotionNetwork(width=width, hidden=hidden, **more)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return network.eval()


@pytest.fixture
def network() -> ObjectMotionNetwork:
    return lively(0)


@pytest.fixture
def double():
    """Rounding grows from contact to contact; in double precision it stays small."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def scene(num_objects: int, present: int) -> Scene:
    generator = torch.Generator().manual_seed(1)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    tools = torch.eye(4).repeat(1, STEPS + 1, 2, 1, 1)
    tools[..., :3, 3] = 0.1 * random(1, STEPS + 1, 2, 3)
    known = torch.arange(num_objects) < present
    return Scene(
        points=torch.where(known[:, None], 0.1 * random(1, num_objects, 3), 0.0),
        features=torch.where(known[:, None, None], 0.1 * random(1, num_objects, 2, 9), 0.0),
        present=known[None],
        tools=tools,
        gaps=random(1, STEPS + 1, 2),
    )


@pytest.mark.parametrize('touching', [False, True])
def test_two_calls_one_after_the_other_are_one_call(touching):
    network, given = lively(0, touching=touching), scene(3, 3)
    with torch.inference_mode():
        whole = network(given)
        part = replace(given, tools=given.tools[:, :6], gaps=given.gaps[:, :6])
        first, memory = network.roll(part)
        part = replace(given, tools=given.tools[:, 4:], gaps=given.gaps[:, 4:])
        second, _ = network.roll(part, memory, skip=1)
    torch.testing.assert_close(first.points, whole.points[:, :6])
    torch.testing.assert_close(second.points, whole.points[:, 5:])
    torch.testing.assert_close(second.rotations, whole.rotations[:, 5:])


ALL = {'fingertips': True, 'yielding': True, 'touching': True}


@pytest.mark.parametrize(
    'more', [[{}, {}], [ALL] * 3, [{}, {'yielding': True}], [{'yielding': True}, ALL]]
)
def test_stacked_networks_compute_what_each_computes(more, double):
    networks = [lively(k, width=32 + 8 * k * (k > 1), **own) for k, own in enumerate(more)]
    given = scene(3, 3)
    # fingers as far apart as an object is wide: then their thickness counts
    given = replace(given, gaps=0.08 * given.gaps)
    names = ('points', 'features', 'present', 'tools', 'gaps')
    parts = [  # each has scenes of its own
        replace(given, **{name: getattr(given, name).repeat_interleave(2, 0) for name in names})
        for _ in networks
    ]
    parts = [replace(part, points=part.points + 0.01 * k) for k, part in enumerate(parts)]
    whole = replace(
        given, **{name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    )
    with torch.inference_mode():
        wanted = [network(part) for network, part in zip(networks, parts, strict=True)]
        found = stacked(networks)(whole)
    for name in ('points', 'rotations', 'held', 'spread', 'off'):
        torch.testing.assert_close(
            getattr(found, name), torch.cat([getattr(motion, name) for motion in wanted])
        )
    for ability in ('yielding', 'touching'):  # no time is spent on what none of them has
        wants = any(getattr(network, ability) for network in networks)
        assert getattr(stacked(networks), ability) == wants
    assert (wanted[0].points[0, -1] - wanted[1].points[0, -1]).abs().max() > 1e-3
    none = replace(whole, **{name: getattr(whole, name)[:, :0] for name in names[:3]})
    assert stacked(networks)(none).points.shape == (2 * len(networks), STEPS + 1, 0, 3)


@pytest.mark.parametrize(('width', 'hidden'), [(32, 16), (48, 20)])
def test_a_wider_network_computes_the_same_at_first_and_hears_the_fingertips(
    network, width, hidden
):
    given = scene(3, 3)
    wider = network.widened(width, hidden).widened(width + 8, hidden).eval()
    with torch.inference_mode():
        before, after = network(given), wider(given)
    for name in ('points', 'rotations', 'held', 'spread', 'off'):
        torch.testing.assert_close(getattr(after, name), getattr(before, name))
    leaning = given.tools.clone()
    leaning[..., :3, :3] = torch.tensor([[1.0, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]])
    leaning[..., :3, 3] *= 0.1  # further away than 3 cm heights are cut off
    heard: list[torch.Tensor] = []
    wider.tool_edge.register_forward_pre_hook(lambda _, args: heard.append(args[-2]))
    wider(
        replace(
            given,
            points=0.1 * given.points,
            features=0.1 * given.features,
            tools=leaning,
            gaps=torch.full_like(given.gaps, 0.01),
        )
    )
    rise = heard[0][..., 0] - heard[0][..., 1]
    inside = heard[0].abs().amax(-1) < 3
    assert inside.any()
    # 1 cm along a finger's travel that leans by sine .6, up and down; in cm
    torch.testing.assert_close(rise[inside], torch.full_like(rise[inside], 1.2))
    with pytest.raises(ValueError, match='is 32 wide .* cannot shrink to 16'):
        network.widened(16, 16)


@pytest.mark.parametrize(
    ('way', 'place', 'gap', 'moved'),
    [
        (0, (0.0, 0.06), 0.0375, (0.0, 0.0075)),  # beside a finger that opens
        (0, (0.0, -0.06), 0.02, (0.0, 0.0)),  # not as far as that
        (1, (-0.025, 0.0), 0.02, (-0.005, 0.0)),  # across the fingers' travel
        (2, (0.0, 0.01), 0.025, (0.0, -0.005)),  # a finger closes on it
    ],
)
def test_an_object_yields_just_as_far_as_a_finger_would_reach_into_it(way, place, gap, moved):
    network = ObjectMotionNetwork(width=16, hidden=8, yielding=True).eval()
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    given, points = beside_fingers([place], gap, turn)
    with torch.inference_mode():
        before = network(given).points[0, 1] - points  # untrained, it holds everything still
        network.yields.bias[way] = 20.0
        after = network(given).points[0, 1] - points
    torch.testing.assert_close(before, torch.zeros(1, 3))
    torch.testing.assert_close(after @ turn, torch.tensor([[*moved, 0.0]]))


def test_an_object_yields_just_as_far_as_another_would_reach_into_it():
    network = ObjectMotionNetwork(width=16, hidden=8, yielding=True).eval()
    given, points = beside_fingers([(0.0, 0.06), (0.0, 0.105), (0.0, 0.3)], 0.0375, torch.eye(3))
    with torch.inference_mode():
        network.yields.bias[0] = network.gives_way.bias[0] = 20.0
        after = network(given).points[0, 1] - points
    # the first is pushed by 7.5 mm, 5 mm are between the two, and each gives way to the other
    expected = torch.tensor([[0, 0.005, 0], [0, 0.0025, 0], [0, 0, 0]])
    torch.testing.assert_close(after, expected)


def test_what_stops_a_tool_stops_what_it_carries():
    network = ObjectMotionNetwork(width=16, hidden=8, touching=True).eval()
    given, points = beside_fingers([(0.0, 0.0)], 0.02, torch.eye(3))
    tools = given.tools.repeat(1, 2, 1, 1, 1)[:, :3].clone()
    tools[0, 1:, 0, 2, 3] = torch.tensor([-0.05, -0.03])  # down by 5 cm, and up by 2 cm
    given = replace(given, tools=tools, gaps=torch.full((1, 3, 1), 0.02))
    with torch.inference_mode():
        network.gate.bias[:] = 20.0  # it holds the object
        free = network(given)
        network.off.bias[2] = 0.04 * 20  # something stops it 4 cm above where it is to go
        above = network(given)
        network.off.bias[:] = 0.0
        network.off.bias[7:] = 20.0  # something stops it where it is
        stopped = network(given)
    torch.testing.assert_close(free.points[0, :, 0, 2], torch.tensor([0.02, -0.03, -0.01]))
    torch.testing.assert_close(above.points[0, :, 0, 2], torch.tensor([0.02, 0.01, 0.03]))
    torch.testing.assert_close(above.off[0, :, 0, 2], torch.tensor([0.0, 0.04, 0.04]))
    torch.testing.assert_close(stopped.points[0, :, 0, 2], torch.tensor([0.02, 0.02, 0.02]))
    torch.testing.assert_close(stopped.off[0, :, 0, 2], torch.tensor([0.0, 0.05, 0.03]))
    tools[0, 2, 0, 2, 3] = -0.4
    with torch.inference_mode():
        pressed = network(replace(given, tools=tools))
    # but an arm that is pressed on does not stay behind by more than 15 cm
    torch.testing.assert_close(pressed.off[0, :, 0, 2], torch.tensor([0.0, 0.05, 0.15]))


def test_how_far_a_tool_is_off_its_way_leads_back_to_it():
    generator = torch.Generator().manual_seed(3)
    free = torch.eye(4, dtype=torch.float64).repeat(5, 2, 1, 1)
    free[..., :3, :3] = _rotation(torch.randn(5, 2, 3, generator=generator).double())
    free[..., :3, 3] = torch.randn(5, 2, 3, generator=generator)
    off = torch.randn(5, 2, 7, generator=generator).double()
    off[0] = 0.0
    gaps = torch.full((5, 2), 0.03, dtype=torch.float64)
    found = off_way(free @ _pose(off), gaps + off[..., 6], free, gaps)
    torch.testing.assert_close(found, off)


def beside_fingers(places, gap: float, turn: torch.Tensor) -> tuple[Scene, torch.Tensor]:
    """Objects 4 cm wide at places in a tool's frame, whose shut fingers open; their points."""
    tools = torch.eye(4).repeat(1, 2, 1, 1, 1)
    tools[..., :3, :3] = turn
    points = torch.tensor([[*place, 0.02] for place in places]) @ turn.T
    scene = Scene(
        points=points[None],
        features=torch.tensor([0.04] * 4 + [-0.02, 0.02, 0, 0, 0]).repeat(1, len(places), 2, 1),
        present=torch.ones(1, len(places), dtype=torch.bool),
        tools=tools,
        gaps=torch.tensor([0.0, gap])[None, :, None],
    )
    return scene, points


@pytest.mark.parametrize('touching', [False, True])
def test_padding_changes_nothing_and_rotations_stay_rotations(touching):
    network, given = lively(0, touching=touching), scene(2, 2)
    padded = replace(
        given,
        points=torch.cat([given.points, torch.zeros(1, 1, 3)], 1),
        features=torch.cat([given.features, torch.zeros(1, 1, 2, 9)], 1),
        present=torch.tensor([[True, True, False]]),
    )
    with torch.inference_mode():
        alone, among = network(given), network(padded)
    torch.testing.assert_close(among.points[:, :, :2], alone.points)
    assert (alone.points[:, -1] - alone.points[:, 0]).abs().max() > 1e-3
    product = alone.rotations @ alone.rotations.mT
    torch.testing.assert_close(product, torch.eye(3).expand_as(product), atol=1e-4, rtol=0)
    assert (alone.held.sum(-1) <= 1 + 1e-5).all() and (alone.spread.diff(dim=1) >= 0).all()


def test_a_motion_errs_by_what_the_network_expects(network):
    with torch.no_grad():
        network.scale.bias.fill_(-2.0)  # some 6 mm a step
    given, steps, count = scene(3, 3), STEPS, 400
    many = Scene(**{name: getattr(given, name).expand(count, *getattr(given, name).shape[1:])
                    for name in given.__slots__})  # fmt: skip
    errors = torch.zeros(count, steps, 3, 3)
    errors[1:, 0] = torch.randn(count - 1, 3, 3, generator=torch.Generator().manual_seed(2))
    with torch.inference_mode():
        motion, _ = network.roll(many, errors=errors)
        plain = network(given)
    torch.testing.assert_close(motion.points[:1], plain.points)
    apart = motion.points[1:, 1] - plain.points[:, 1]
    assert apart[..., 2].abs().max() < 1e-6  # nothing sinks into the table
    expected = plain.spread[0, 1] - plain.spread[0, 0]
    torch.testing.assert_close(apart.norm(dim=-1).mean(0), expected, rtol=0.1, atol=0.0)
    assert (motion.rotations[1:, 1] - plain.rotations[:, 1]).abs().amax() > 0.05


def test_a_shift_of_the_whole_scene_in_the_plane_shifts_the_answer(network):
    given, way = scene(2, 2), torch.tensor([0.3, -0.2, 0.0])
    tools = given.tools.clone()
    tools[..., :3, 3] += way
    with torch.inference_mode():
        here = network(given)
        there = network(replace(given, points=given.points + way, tools=tools))
    torch.testing.assert_close(there.points, here.points + way, atol=1e-5, rtol=0)


@pytest.mark.parametrize('kind', ['alone', 'response', 'two'])
def test_objects_go_on_from_chunk_to_chunk_and_unknown_ones_are_unknown(network, kind):
    robot = load_robot(share_path('config', 'robots', 'yam_bimanual.yaml'))
    each = np.full(len(robot.joint_names), 0.05)
    response = ArmResponse(
        joint_names=robot.joint_names,
        compliance=each,
        armature=each / 50,
        damping=each,
        lead=each,
    )
    member = Member(network=network)
    members = {
        'alone': [member],
        'response': [Member(network=network, response=response)],
        'two': [member, Member(network=network, response=response)],
    }[kind]
    rng = np.random.default_rng(0)
    positions = np.cumsum(rng.normal(0, 0.005, (41, len(robot.joint_names))), axis=0)
    tracked = TrackedObjects(
        model=ObjectMotionPredictor(members, robot),
        reference=np.array([[0.1, 0.2, 0.02], [np.nan] * 3]),
        features=np.full((2, 2, 9), 0.04),
    )
    (whole, *disturbed), _ = tracked.advance(positions)
    assert tracked.commands_a_step == 5 and len(whole.points) == 9
    (first, *parts), later = tracked.advance(positions[:21])
    (second, *more), _ = later.advance(positions[20:])
    assert len(disturbed) > 5
    for motion, part, rest in zip(disturbed, parts, more, strict=True):
        points = np.concatenate([part.points[:, 0], rest.points[1:, 0]])
        np.testing.assert_allclose(points, motion.points[:, 0], atol=1e-5)
    for motion in disturbed:  # of other places, told from where the object was found
        np.testing.assert_allclose(motion.points[0, 0], tracked.reference[0])
        assert np.abs(motion.points[:, 0] - whole.points[:, 0]).max() > 1e-6
    np.testing.assert_allclose(tracked.sizes[:, 0], np.full((13, 3), 0.04))
    np.testing.assert_allclose(first.points[:, 0], whole.points[:5, 0], atol=1e-6)
    np.testing.assert_allclose(second.points[:, 0], whole.points[4:, 0], atol=1e-6)
    assert np.isnan(whole.points[:, 1]).all() and np.isfinite(whole.points[:, 0]).all()


def test_members_share_the_motions_and_are_read_again(network, tmp_path):
    robot = load_robot(share_path('config', 'robots', 'yam_bimanual.yaml'))
    each = np.full(len(robot.joint_names), 0.05)
    response = ArmResponse(
        joint_names=robot.joint_names, compliance=each, armature=each, damping=each, lead=each
    )
    save_network(network, tmp_path / 'a', response)
    save_network(network, tmp_path / 'b')
    add_members(tmp_path / 'a', [tmp_path / 'b', tmp_path / 'b'])
    predictor = load_predictor(tmp_path / 'a', robot)
    first, *others = predictor.members
    assert first.response is not None and [m.response for m in others] == [None, None]
    assert np.concatenate(predictor.shares).tolist() == list(range(13))
    assert [len(share) for share in predictor.shares] == [5, 4, 4]
    save_network(ObjectMotionNetwork(9), tmp_path / 'one_view')
    with pytest.raises(CheckpointError, match=r"one_view' describes objects by 9 numbers"):
        add_members(tmp_path / 'a', [tmp_path / 'one_view'])
    with pytest.raises(CheckpointError, match=r"'.*nowhere' cannot be used"):
        add_members(tmp_path / 'a', [tmp_path / 'nowhere'])


def test_what_is_saved_is_read_again_and_damage_is_named(network, tmp_path):
    save_network(network, tmp_path / 'object_motion')
    read = load_network(tmp_path / 'object_motion')
    for name, value in network.state_dict().items():
        torch.testing.assert_close(read.state_dict()[name], value)
    (tmp_path / 'object_motion' / 'model.safetensors').write_bytes(b'no')
    with pytest.raises(CheckpointError, match=r'object_motion.*cannot be used'):
        load_network(tmp_path / 'object_motion')
