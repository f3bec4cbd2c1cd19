"""A file of policies to rank: any kind of policy, each under a name of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import hashlib
import json
from os.path import isfile
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from pydantic import Field, model_validator

from mtv_world_ros.core.config import expected, ListOf, read_yaml, Schema, Seconds, validated
from mtv_world_ros.core.data_types import JointTrajectory, Observation
from mtv_world_ros.core.errors import ConfigError, MtvWorldError, PolicyError, PolicyServerError
from mtv_world_ros.core.files import bundled
from mtv_world_ros.policies.kinds import policy_config, settings_class
from mtv_world_ros.policies.policy import EpisodeOrigin, Policy, PolicySettings
from mtv_world_ros.policies.scripted_settings import ScriptedPolicySettings
from mtv_world_ros.ranking.server_process import PORT, ServerProcess
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.simulation.expert.expert import Expert
from mtv_world_ros.simulation.expert.scripted_policy import scripted_policy
from mtv_world_ros.simulation.scenes.tasks import own_definition, Task, tasks_named

#: names are parts of file names
_NAME = r'^[A-Za-z0-9][A-Za-z0-9._-]*$'
#: settings that do not distinguish policies
_TIMEOUTS = ('timeout_s', 'setup_timeout_s', 'start_timeout_s')


class PolicyEntry(Schema):
    """One policy of the file."""

    name: Annotated[
        str, Field(pattern=_NAME), expected('letters, digits and . _ -, e.g. act_late')
    ] = Field(description='name under which its results are listed')
    policy: str | dict[str, Any] = Field(
        description='a scripted policy, a policy file, or what stands in one (`kind: ...`)'
    )
    change: dict[str, Any] = Field(
        default={}, description='values that differ from those of `policy`, nested as there'
    )
    command: ListOf[str] = Field(
        default=(),
        description='program and arguments that start the server; `{port}` is a free port',
    )
    start_timeout_s: Seconds = Field(
        default=120.0, description='longest wait until the server listens [s]'
    )
    tasks: ListOf[str] = Field(
        default=(),
        description='tasks that it is ranked on, names or YAML files; empty = all of `--tasks`',
    )

    @model_validator(mode='after')
    def _passes_the_port(self) -> Self:
        if self.command and not any(PORT in part for part in self.command):
            raise ValueError(f"'command' must have {PORT} where the server's port belongs")
        return self


class PolicyList(Schema):
    """A file of policies."""

    basic: ClassVar = ('policies',)

    policies: ListOf[PolicyEntry] = Field(min_length=1, description='policies that are ranked')


@dataclass(frozen=True, slots=True, kw_only=True)
class ListedPolicy:
    """A policy of the file, ready to be made.

    Attributes:
        name: name under which its results are listed.
        config: the policy's configuration.
        command: starts its server; empty = it has none, or it runs already.
        start_timeout_s: longest wait until the server listens [s].
        tasks: tasks that it is ranked on; empty = all that the ranking has.
        definition: changes with everything that decides what the policy does.
    """

    name: str
    config: PolicySettings
    command: tuple[str, ...]
    start_timeout_s: float
    tasks: tuple[Task, ...]
    definition: str


def load_policy_list(path: Path, robot: RobotModel) -> tuple[ListedPolicy, ...]:
    """Read a file of policies; `config/rankings/example.yaml` describes its keys.

    Raises:
        ConfigError: it cannot be read, a key is unknown or missing, a value is wrong, two
            policies have one name, or the package of a client is missing.
        PolicyError: no such scripted policy.
    """
    values = validated(PolicyList, read_yaml(path, 'list of policies', '--policies'), str(path))
    names = [entry.name for entry in values.policies]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"{path}: two policies have the name '{name}'; give each its own")
    return tuple(_listed(entry, path, robot) for entry in values.policies)


def _listed(entry: PolicyEntry, path: Path, robot: RobotModel) -> ListedPolicy:
    where = f"{path}: policy '{entry.name}'"
    values = _merged(_values(entry.policy, path.parent), entry.change)
    address = settings_class(values, where).server_address
    if entry.command and address:
        values['server'] = address.format(port=0)
    config = policy_config(values, robot, where)
    config.check()
    if config.needs_recording:
        raise ConfigError(
            f"{where} is of kind '{config.kind}': it repeats an episode, and a ranking draws "
            'scenes of its own; `mtv-world imagine` runs it'
        )
    if entry.command and not address:
        raise ConfigError(
            f"{where} has a 'command', but is of kind '{config.kind}', which has no server; "
            'openpi and lerobot have one'
        )
    known = {key: value for key, value in values.items() if key not in _TIMEOUTS}
    text = json.dumps([known, entry.command], sort_keys=True, default=str)
    return ListedPolicy(
        name=entry.name,
        config=config,
        command=entry.command,
        start_timeout_s=entry.start_timeout_s,
        tasks=tasks_named(','.join(entry.tasks), path.parent),
        definition=hashlib.sha256(text.encode()).hexdigest()[:16],
    )


def _values(policy: str | dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the values of the policy's file; paths are relative to the list's folder."""
    if isinstance(policy, dict):
        return dict(policy)
    if policy.startswith('expert'):
        return {'kind': 'scripted', 'variant': policy}
    beside = folder / policy
    file = beside if isfile(beside) else bundled('policies', policy, 'policy')
    values = read_yaml(file, 'policy file', 'policy')
    if not isinstance(values, dict):
        raise ConfigError(f'{file}: expected keys and values')
    return values


def _merged(values: Mapping[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values with changes, nested ones too."""
    merged = dict(values)
    for key, value in change.items():
        before = merged.get(key)
        if isinstance(before, Mapping) and isinstance(value, Mapping):
            value = _merged(before, value)
        merged[key] = value
    return merged


def tasks_of(policies: Sequence[ListedPolicy], others: Sequence[Task]) -> tuple[Task, ...]:
    """Return the tasks that policies are ranked on where the user names none.

    Args:
        policies: the file's policies.
        others: tasks of those policies that state none.
    """
    found = {task.name: task for policy in policies for task in policy.tasks or others}
    return tuple(found.values())


def check_tasks(policies: Sequence[ListedPolicy], tasks: Sequence[Task]) -> None:
    """Refuse policies that would be ranked on nothing, or on another task of the same name.

    Args:
        policies: policies that are ranked.
        tasks: tasks of the ranking.

    Raises:
        ConfigError: a policy is for other tasks than those of the ranking, or defines such a task
            differently.
    """
    wanted = {task.name: task for task in tasks}
    for policy in policies:
        for task in policy.tasks:
            if wanted.get(task.name, task) != task:
                raise ConfigError(
                    f"policy '{policy.name}' is for a task '{task.name}' that differs from the "
                    'one of this name that --tasks or another policy gives; give one of the two '
                    'another name in its file'
                )
        names = [task.name for task in policy.tasks]
        if names and not set(names) & set(wanted):
            raise ConfigError(
                f"policy '{policy.name}' is for the tasks {', '.join(names)}, --tasks is "
                f"'{','.join(wanted)}'; name one of its tasks, or leave it out"
            )


def check_single_clients(policies: Sequence[ListedPolicy], workers: int) -> None:
    """Refuse servers that several workers would talk to and that know one client only.

    Raises:
        ConfigError: a LeRobot server is given by its address, and there are several workers.
    """
    for policy in policies:
        if workers > 1 and policy.config.serves_one_client and not policy.command:
            server = getattr(policy.config, 'server', '')
            raise ConfigError(
                f"a server of kind '{policy.config.kind}' serves one client, '{server}' of policy "
                f"'{policy.name}' would get {workers}; give a 'command' that starts one for every "
                'worker, or --workers 1'
            )


@dataclass(slots=True)
class ListedPolicies:
    """Makes the policies of a file; picklable until the first one is made.

    Attributes:
        policies: the file's policies.
        logs: folder for the logs of the servers that are started.
    """

    policies: tuple[ListedPolicy, ...]
    logs: Path
    _made: dict[str, Policy] = field(default_factory=dict)

    def __call__(self, name: str, task: Task, seed: int, expert: Expert) -> Policy:
        """Return the policy of a name; those that know their scene are made for it."""
        listed = next(policy for policy in self.policies if policy.name == name)
        config = listed.config
        if isinstance(config, ScriptedPolicySettings):
            return scripted_policy(config.variant, task, seed, expert, hold_s=config.hold_s)
        origin = EpisodeOrigin(
            task=task.name, task_definition=own_definition(task), scene_seed=seed
        )
        if config.is_made_for_episode:
            return GuardedPolicy(listed, self.logs, origin, expert.robot)
        if name not in self._made:
            self._made[name] = GuardedPolicy(listed, self.logs, EpisodeOrigin(), expert.robot)
        return self._made[name]


class GuardedPolicy:
    """A user's policy; any exception in it is raised as a `PolicyError` with its name.

    Its server, if it is started here, runs when an episode begins, and is started again after it
    died or did not answer in time.

    Args:
        listed: the policy.
        logs: folder for the logs of its server.
        origin: origin of its episode, if the policy is made for one.
        robot: the robot that it moves.
    """

    def __init__(
        self, listed: ListedPolicy, logs: Path, origin: EpisodeOrigin, robot: RobotModel
    ) -> None:
        self.name = listed.name
        self._origin, self._robot = origin, robot
        self._config = listed.config
        self._policy: Any = None
        self._server = (
            ServerProcess(listed.name, listed.command, logs, listed.start_timeout_s)
            if listed.command
            else None
        )

    def reset(self, *, seed: int) -> None:
        """Begin an episode; start the server, and make the policy, where that is not done."""
        self._guarded(lambda: self._begin(seed))

    def act(self, observation: Observation, instruction: str) -> JointTrajectory | None:
        """Return the policy's answer.

        Raises:
            PolicyError: it raised something, or its answer is no trajectory.
        """
        answer = self._guarded(lambda: self._policy.act(observation, instruction))
        if answer is not None and not isinstance(answer, JointTrajectory):
            raise PolicyError(
                f"policy '{self.name}' answered with a {type(answer).__name__}; expected a "
                'JointTrajectory, or None at the end of the episode'
            )
        if self._server is not None:
            self._server.answered()
        return answer

    def _begin(self, seed: int) -> None:
        if self._server is not None and self._server.ensure():
            self._close()
            config = self._config
            address = config.server_address.format(port=self._server.port)
            self._config = config.model_copy(update={'server': address})
        if self._policy is None:
            self._policy = self._config.make(self._origin, self._robot)
        self._policy.reset(seed=seed)

    def _close(self) -> None:
        policy, self._policy = self._policy, None
        if policy is not None and hasattr(policy, 'close'):
            policy.close()

    def _guarded(self, call: Any) -> Any:
        try:
            return call()
        except PolicyServerError as error:
            self._close()
            if self._server is not None:
                self._server.stop()
            raise PolicyError(f"policy '{self.name}': {error}") from error
        except MtvWorldError as error:
            raise PolicyError(f"policy '{self.name}': {error}") from error
        except Exception as error:  # code of the user's
            raise PolicyError(
                f"policy '{self.name}' raised {type(error).__name__}: {error}"
            ) from error
