"""The parameter `adapter`: checked when it is set, exchanged between rollouts."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Protocol, runtime_checkable, TYPE_CHECKING

from rclpy.node import Node
from rclpy.parameter import Parameter

from mtv_world_ros.errors import CheckpointError, MtvWorldError
from mtv_world_ros.pipeline import WorldModel
from mtv_world_ros.ros.parameters import refusing

if TYPE_CHECKING:
    from mtv_world_ros.model.lora import Adapter

NAME = 'adapter'
NONE = 'none'


@runtime_checkable
class TakesAdapters(Protocol):
    """A world model whose LoRA adapter can be exchanged; see `DiffusionWorldModel`."""

    own_adapter: Path | None

    def read_adapter(self, path: Path | None) -> Adapter:
        """Returns an adapter that fits."""
        ...

    def use_adapter(self, adapter: Adapter) -> None:
        """Exchanges it."""
        ...


class AdapterSwitch:
    """Keeps the world model's adapter to what the parameter says.

    A value whose adapter cannot be read or is of another model refuses the parameter.

    Args:
        node: has the parameter.
        world_model: is to take it.
        run_between: runs a job between rollouts.

    Raises:
        MtvWorldError: the value at start-up cannot be used.
    """

    def __init__(
        self,
        node: Node,
        world_model: WorldModel,
        run_between: Callable[[Callable[[], None]], None],
    ) -> None:
        self._world_model, self._run_between = world_model, run_between
        self._log = node.get_logger()
        self._read: tuple[str, Adapter] | None = None
        value = str(node.get_parameter(NAME).value)
        #: the value that holds for rollouts that start now
        self.in_use = ''
        if value:
            self._use(value, self._load(value))
        self._node = node
        self._check = refusing(self._read_named)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._take)

    def close(self) -> None:
        """Listens to the parameter no more."""
        self._node.remove_on_set_parameters_callback(self._check)
        self._node.remove_post_set_parameters_callback(self._take)

    def _load(self, value: str) -> Adapter:
        model = self._world_model
        if not isinstance(model, TakesAdapters):
            raise CheckpointError(f"this world model takes no adapter, got '{value}'")
        if not value:
            return model.read_adapter(model.own_adapter)
        return model.read_adapter(None if value == NONE else Path(value))

    def _read_named(self, parameters: list[Parameter]) -> None:
        """Reads what is named, so that taking it cannot fail for what the user gave."""
        for parameter in parameters:
            if parameter.name == NAME:
                value = str(parameter.value)
                try:
                    self._read = (value, self._load(value))
                except (MtvWorldError, OSError, ValueError) as error:
                    raise CheckpointError(f'{NAME}: {error}') from error

    def _take(self, parameters: list[Parameter]) -> None:
        if self._read is not None and any(parameter.name == NAME for parameter in parameters):
            self._run_between(partial(self._exchange, *self._read))
            self._read = None

    def _exchange(self, value: str, adapter: Adapter) -> None:
        try:
            self._use(value, adapter)
        except Exception as error:  # such as out of memory: the one before stays
            self._log.error(f"adapter '{value}' is not used, '{self.in_use}' stays: {error}")

    def _use(self, value: str, adapter: Adapter) -> None:
        assert isinstance(self._world_model, TakesAdapters)
        self._world_model.use_adapter(adapter)
        self.in_use = value
        self._log.info(f'adapter: {value or "that of the checkpoint, if it has one"}')
