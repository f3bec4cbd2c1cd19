"""Parameters of the node `policy`."""

from __future__ import annotations

from mtv_world_ros.ros.parameters import at_start, Mode, NodeSettings, parameter

_SECONDS = (0.001, 86400.0)


class PolicySettings(NodeSettings):
    """Parameters of the node `policy`; checkpoint and robot must be the world model's."""

    policy: str = at_start('scripted', 'Policy YAML, or the name of one in `config/policies`.')
    world_model: str = at_start('/world_model', "The world model node's name.")
    diagnostics_period_s: float = at_start(0.5, 'Period of /diagnostics [s].', (0.05, 60.0))
    mode: Mode = parameter(
        'imagine', 'Later observations: `imagine` = predictions, `observe` = cameras.'
    )
    instruction: str = parameter('', 'The instruction that the policy gets.')
    task: str = parameter('', 'Task of the scene, for policies that know it (scripted).')
    scene_seed: int = parameter(-1, 'Seed of the scene, for the same; -1 = none.', (-1, 2**62))
    recording: str = parameter('', 'Episode folder, for policies that repeat it (recorded).')
    recording_ns: int = parameter(
        0, 'Stamp in it at which the episode begins, for the same [ns].', (0, 2**62)
    )
    seed: int = parameter(0, "Seed of the policy's own randomness.", (0, 2**31 - 1))
    max_chunks: int = parameter(
        0, 'An episode ends after this number of chunks; 0 = no limit.', (0, 10**6)
    )
    execute_s: float = parameter(
        0.0,
        'Part of an answer that is executed before the policy is asked again [s]; 0 = one chunk.',
        (0.0, 3600.0),
    )
    answer_timeout_s: float = parameter(60.0, 'A later answer ends the episode [s].', _SECONDS)
    rollout_timeout_s: float = parameter(
        300.0, 'A later end of a rollout ends the episode [s].', _SECONDS
    )
    frames_timeout_s: float = parameter(
        10.0, 'Frames that arrive later after their rollout are lost [s].', _SECONDS
    )
    observation_timeout_s: float = parameter(
        30.0, 'An episode ends without an observation for this time [s].', _SECONDS
    )
