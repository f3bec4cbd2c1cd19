"""The policy kind `scripted`: checks and makes scripted policies, and names their faults."""

from __future__ import annotations

from pathlib import Path

from mtv_world_ros.core.errors import PolicyError
from mtv_world_ros.policies.policy import EpisodeOrigin, Policy
from mtv_world_ros.policies.scripted_settings import ScriptedPolicySettings
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.simulation.expert.expert import Expert
from mtv_world_ros.simulation.expert.scripted_policy import policy_of_recording, scripted_policy
from mtv_world_ros.simulation.faults.catalogue import parse_variant, refuse_test_kinds
from mtv_world_ros.simulation.scenes.tasks import stored_or_named

__all__ = ['check', 'fault_kinds', 'make', 'refuse_test_kinds']


def check(settings: ScriptedPolicySettings) -> None:
    """Check the name of a variant.

    Raises:
        PolicyError: there is no such policy, or a fault's size is out of range.
    """
    parse_variant(settings.variant)


def make(settings: ScriptedPolicySettings, origin: EpisodeOrigin, robot: RobotModel) -> Policy:
    """Return the policy of a variant for an episode's task and scene.

    Raises:
        PolicyError: neither a recording nor task and scene are known.
    """
    variant, expert = settings.variant, Expert(robot)
    if origin.recording:
        return policy_of_recording(variant, Path(origin.recording), expert, settings.hold_s)
    task, scene_seed = origin.task, origin.scene_seed
    if not task or scene_seed < 0:
        raise PolicyError(
            f"policy '{variant}' knows its scene instead of looking at it: set 'task' and "
            "'scene_seed' to those of the recorded episode"
        )
    kind = stored_or_named(origin.task_definition, task, f"definition of task '{task}'")
    return scripted_policy(variant, kind, scene_seed, expert, hold_s=settings.hold_s)


def fault_kinds(variant: str) -> tuple[str, ...]:
    """Return the fault kinds of a variant.

    Raises:
        PolicyError: it has an unknown fault.
    """
    return parse_variant(variant).kinds
