"""Classes that users choose by name: of the package, of an entry point, or `module:Class`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
import sys
from typing import Any

from mtv_world_ros.core.entry_points import registered
from mtv_world_ros.core.errors import ConfigError, MtvWorldError
from mtv_world_ros.core.extras import extra_of, install_command


@dataclass(frozen=True, slots=True, kw_only=True)
class Registry:
    """Named classes of one kind; one is imported when it is chosen.

    Attributes:
        kind: kind of the classes, for error texts, e.g. `control`.
        bundled: name -> `module:Class` of the package.
        group: group of the entry points of other packages.
        setting: option or key that chooses one, e.g. `video.control`.
        required: attributes that a class must have.
        made_required: attributes that an instance must have, see `create`.
        protocol: name of the protocol that describes these names.
        others: further valid values of the setting, for error texts; empty = there are none.
    """

    kind: str
    bundled: Mapping[str, str]
    group: str
    setting: str
    required: tuple[str, ...] = ()
    made_required: tuple[str, ...] = ()
    protocol: str = ''
    others: str = ''

    def names(self) -> list[str]:
        """Return the registered names: the package's, then those of entry points."""
        return [*self.bundled, *sorted(set(registered(self.group)) - set(self.bundled))]

    def check(self, name: str) -> str:
        """Return a name that is registered, or of the form `module:Class`.

        Raises:
            ConfigError: it is neither.
        """
        known = self.names()
        if ':' not in name and name not in known:
            also = f', or to {self.others}' if self.others else ''
            raise ConfigError.unknown(
                self.kind,
                name,
                known,
                is_not=' is not registered',
                listed='; registered are',
                advice=f'. Set {self.setting} to one of them, to the name of an entry point of '
                f"the group '{self.group}', or to module:Class{also}",
            )
        return name

    def load(self, name: str) -> Any:
        """Return the class, or other object, that a name stands for.

        Args:
            name: registered, or `module:Class`.

        Raises:
            ConfigError: there is none of this name, it cannot be imported, or it lacks something.
        """
        self.check(name)
        if ':' in name:
            target = name
        elif name in self.bundled:
            target = self.bundled[name]
        else:
            target = registered(self.group)[name].value
        module, _, attribute = target.partition(':')
        try:
            found: Any = import_module(module)
            for part in filter(None, attribute.split('.')):
                found = getattr(found, part)
        except SystemExit as error:
            raise ConfigError(
                f"{self.kind} '{name}' cannot be imported: '{module}' is a script that ends the "
                "program; put what it runs under if __name__ == '__main__'"
            ) from error
        except Exception as error:  # a third-party module may raise anything
            raise ConfigError(
                f"{self.kind} '{name}' cannot be imported: {error or type(error).__name__}"
                f'{self._remedy(error)}'
            ) from error
        missing = [part for part in self.required if not hasattr(found, part)]
        if missing:
            raise ConfigError(
                f"{self.kind} '{name}': '{target}' lacks {', '.join(missing)}; see "
                f'{self.protocol} for what a {self.kind} has'
            )
        return found

    def create(self, name: str, *options: Any) -> Any:
        """Return an instance: of `create(*options)` of the class, else of the class without any.

        Raises:
            ConfigError: as `load`, or it cannot be created, or lacks something.
        """
        found = self.load(name)
        try:
            made = found.create(*options) if hasattr(found, 'create') else found()
        except MtvWorldError:
            raise
        except Exception as error:  # a third-party class may raise anything
            raise ConfigError(
                f"{self.kind} '{name}' cannot be created ({type(error).__name__}: {error})"
            ) from error
        missing = [part for part in self.made_required if not hasattr(made, part)]
        if missing:
            raise ConfigError(
                f"{self.kind} '{name}' is a {type(made).__name__}, which lacks "
                f'{", ".join(missing)}; see {self.protocol} for what a {self.kind} has'
            )
        return made

    def _remedy(self, error: Exception) -> str:
        package = getattr(error, 'name', None) if isinstance(error, ModuleNotFoundError) else None
        if package is not None and extra_of(package):
            return f'; install it with: {install_command([package])}'
        if package is not None and find_spec(package.partition('.')[0]) is None:
            return (
                f"; install the package that has '{package}', or add its folder to PYTHONPATH "
                f'(now {len(sys.path)} folders)'
            )
        return ''
