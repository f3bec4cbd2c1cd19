"""Parameters of the policy node: one table with defaults, ranges and what they mean."""

from __future__ import annotations

from dataclasses import dataclass, fields

from rclpy.node import Node

from mtv_world_ros.ros.parameters import Entry, MODES

_SECONDS = (0.001, 86400.0)
_FROM_0 = (0.0, 3600.0)
#: `PolicySettings` has a field for every row
TABLE: tuple[Entry, ...] = (
    Entry(
        'policy',
        'scripted',
        'Policy YAML, or the name of one in config/policies.',
        read_only=True,
    ),
    Entry(
        'checkpoint', 'bundled', "The world model's: says views, size and rate.", read_only=True
    ),
    Entry('robot_file', '', "As the world model's.", read_only=True),
    Entry('compressed_input', False, 'Real images come as JPEG or PNG.', read_only=True),
    Entry('world_model', '/world_model', "The world model node's name.", read_only=True),
    Entry('diagnostics_period_s', 0.5, 'Period of /diagnostics [s].', (0.05, 60.0), (), True),
    Entry('mode', 'imagine', 'Later observations: predictions or cameras.', choices=MODES),
    Entry('calibration_file', '', "As the world model's; read at ~/start."),
    Entry('instruction', '', 'What the policy is told.'),
    Entry('task', '', 'Task of the scene, for policies that know it (scripted).'),
    Entry('scene_seed', -1, 'Seed of the scene, for the same; -1 = none.', (-1, 2**62)),
    Entry('seed', 0, "Of the policy's own randomness.", (0, 2**31 - 1)),
    Entry('max_chunks', 0, 'An episode ends after so many; 0 = no limit.', (0, 10**6)),
    Entry('execute_s', 0.0, "Seconds of an answer to execute; 0 = the model's chunk.", _FROM_0),
    Entry('answer_timeout_s', 60.0, 'A later answer ends the episode [s].', _SECONDS),
    Entry('rollout_timeout_s', 300.0, 'A later end of a rollout ends the episode [s].', _SECONDS),
    Entry('frames_timeout_s', 10.0, 'Frames so late after their rollout are lost [s].', _SECONDS),
    Entry('observation_timeout_s', 30.0, 'Without observation an episode ends [s].', _SECONDS),
    Entry('max_image_age_s', 0.5, 'Older images are no observation [s].', _SECONDS),
    Entry('max_joint_state_age_s', 0.5, 'Nor are older joint states [s].', _SECONDS),
    Entry('max_view_skew_s', 0.05, 'Nor are views further apart [s].', _SECONDS),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicySettings:
    """Values of the parameters in `TABLE`, by the same names."""

    policy: str
    checkpoint: str
    robot_file: str
    compressed_input: bool
    world_model: str
    diagnostics_period_s: float
    mode: str
    calibration_file: str
    instruction: str
    task: str
    scene_seed: int
    seed: int
    max_chunks: int
    execute_s: float
    answer_timeout_s: float
    rollout_timeout_s: float
    frames_timeout_s: float
    observation_timeout_s: float
    max_image_age_s: float
    max_joint_state_age_s: float
    max_view_skew_s: float


def read(node: Node) -> PolicySettings:
    """The present values."""
    values = {f.name: node.get_parameter(f.name).value for f in fields(PolicySettings)}
    return PolicySettings(**values)  # type: ignore[arg-type]
