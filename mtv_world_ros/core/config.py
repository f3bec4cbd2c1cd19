"""Schemas of configuration: typed models whose errors name file, key and valid values.

A model is a `Schema`: frozen, strict (no text where a number belongs) and without unknown keys.
Defaults, ranges and descriptions stand in its fields and nowhere else.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
import re
from typing import Annotated, Any, ClassVar, Self, TYPE_CHECKING, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    model_validator,
    Strict,
    ValidationError,
    WrapValidator,
)
from pydantic_core import ErrorDetails, PydanticCustomError
import yaml

from mtv_world_ros.core.bounded_input import parse_yaml, read_text
from mtv_world_ros.core.errors import ConfigError, MtvWorldError, UnknownNameError

Item = TypeVar('Item')
Model = TypeVar('Model', bound='Schema')


def wrong(what: str, says: str = ', must be', parts: int = 1) -> PydanticCustomError:
    """Return the error of a value: `what` is valid, e.g. `in [0, 1]`.

    Args:
        what: the valid values in words.
        says: text between the value and `what`, where a value is named by its quoted key.
        parts: number of keys of the value's path that are quoted.
    """
    return PydanticCustomError('expected', '{what}', {'what': what, 'says': says, 'parts': parts})


def expected(what: str, says: str = ', must be', parts: int = 1) -> WrapValidator:
    """Return an annotation: whatever is wrong with a value of its field, the error is `wrong`."""

    def checked(value: Any, validate: Any) -> Any:
        try:
            return validate(value)
        except ValidationError:
            raise wrong(what, says, parts) from None

    return WrapValidator(checked)


#: a YAML list
ListOf = Annotated[tuple[Item, ...], Strict(False)]
#: [s]; longer than a day is a wrong unit
Seconds = Annotated[float, Field(gt=0, le=86_400)]
#: a duration that may be none [s]
Wait = Annotated[float, Field(ge=0, le=86_400)]
#: [m]; larger than a room
Length = Annotated[float, Field(gt=0, le=100)]
#: a multiple of a usual value
Factor = Annotated[float, Field(gt=0, le=1000)]
#: of statistics and joint units: encoder ticks, degrees, percent
Number = Annotated[float, Field(ge=-1e6, le=1e6)]
#: a part of a rotation
Quaternion = Annotated[float, Field(ge=-1000, le=1000)]
#: a number of frames, pixels, steps, ...; more takes memory and time without end
Count = Annotated[int, Field(ge=1, le=1_000_000)]
Pair = Annotated[
    tuple[Number, Number], Strict(False), expected('a list of 2 numbers of at most 1e6 either way')
]
#: a coordinate [m]; farther away is a wrong unit
Metres = Annotated[float, Field(ge=-100, le=100)]
Point = Annotated[
    tuple[Metres, Metres, Metres],
    Strict(False),
    expected('x, y, z in metres, each of at most 100 either way'),
]
Share = Annotated[float, Field(ge=0, le=1), expected('in [0, 1]')]


#: no length, time, count or weight in any unit that files use is larger; seeds and stamps are
_VAST = 1e10


def _vast(value: Any) -> Iterator[float]:
    """Yield the numbers with a fraction that are beyond `_VAST`, in lists and maps as well."""
    if isinstance(value, float) and abs(value) > _VAST:
        yield value
    elif isinstance(value, Mapping):
        yield from chain.from_iterable(map(_vast, value.values()))
    elif isinstance(value, tuple | list):
        yield from chain.from_iterable(map(_vast, value))


class Schema(BaseModel):
    """Base of all configuration.

    Attributes:
        section: way in which errors name a value: None = by its quoted key; a text = by its dotted
            path, which begins with this text if the model is made by itself.
        basic: keys that most users set; pages and help texts show them first.
        removed: keys of earlier versions, with what holds now, for the error that names them.
    """

    model_config = ConfigDict(frozen=True, extra='forbid', strict=True, allow_inf_nan=False)
    section: ClassVar[str | None] = None
    basic: ClassVar[tuple[str, ...]] = ()
    removed: ClassVar[Mapping[str, str]] = {}

    if not TYPE_CHECKING:

        def __init__(self, **values: Any) -> None:
            try:
                super().__init__(**values)
            except ValidationError as failed:
                raise ConfigError(_explain(failed, type(self))) from failed

        # so that nested models are validated by the outer one, whose error has the whole path
        __init__.__pydantic_base_init__ = True

    @model_validator(mode='before')
    @classmethod
    def _has_known_keys(cls, values: Any) -> Any:
        if isinstance(values, cls):
            return values
        if not isinstance(values, Mapping):
            raise ValueError(f'expected keys and values, got {values!r}')
        known = [field.alias or name for name, field in cls.model_fields.items()]
        for key in values:
            if key in cls.removed:
                raise ValueError(f"key '{key}' is gone: {cls.removed[key]}; delete the key")
            if key not in known:
                raise UnknownNameError('unknown key', str(key), known, listed='; known are')
        return values

    @model_validator(mode='after')
    def _has_no_vast_number(self) -> Self:
        for name in type(self).model_fields:
            found = next(_vast(getattr(self, name)), None)
            if found is not None:
                raise ValueError(
                    f"'{name}' holds {found:g}; no number here is beyond {_VAST:g} either way"
                )
        return self

    def replace(self, **changes: Any) -> Self:
        """Return a copy with changed values.

        Raises:
            ConfigError: a changed value is wrong.
        """
        # what was left to its default stays so
        held = {name: getattr(self, name) for name in self.model_fields_set}
        return type(self)(**{**held, **changes})


def validated(
    kind: type[Model],
    values: Any,
    where: str,
    *,
    context: Mapping[str, Any] | None = None,
    error: type[MtvWorldError] = ConfigError,
) -> Model:
    """Return the model that plain values describe.

    Args:
        kind: class of the model.
        values: plain values, e.g. of a YAML file.
        where: beginning of the error text, e.g. the file.
        context: values that validators use, e.g. the robot.
        error: raised instead of `ConfigError`.

    Raises:
        ConfigError: an unknown or missing key, or a wrong value.
    """
    try:
        return kind.model_validate(values, context=context or {})
    except ValidationError as failed:
        raise error(f'{where}: {_explain(failed, kind)}') from failed


#: what is valid, by pydantic's type of error
_VALID = {
    'greater_than_equal': 'at least {ge:g}',
    'less_than': 'below {lt:g}',
    'less_than_equal': 'at most {le:g}',
    'finite_number': 'a finite number',
    'float_type': 'a finite number',
    'int_type': 'a whole number',
    'bool_type': 'true or false',
    'string_type': 'a text',
    'tuple_type': 'a list',
    'dict_type': 'keys and values',
    'mapping_type': 'keys and values',
    'expected': '{what}',
}


def _explain(failed: ValidationError, kind: type[Schema]) -> str:
    """Return the first error: key, value and what would be valid."""
    error = failed.errors(include_url=False)[0]
    if error['type'] == 'value_error':  # a validator's own text
        where = _path(error['loc']) or kind.section
        return ': '.join(filter(None, (where, str(error.get('ctx', {})['error']))))
    if error['type'] == 'missing':
        return _inside(error, f"key '{error['loc'][-1]}' is missing")
    if kind.section is None:
        return _inside(error, _quoted(error))
    return _dotted(error, kind.section)


def _quoted(error: ErrorDetails) -> str:
    """Return e.g. `'gripper_open' is 'wide', must be a finite number`."""
    name, value = f"'{error['loc'][-1]}'", error['input']
    if error['type'] == 'expected':
        context = error.get('ctx', {})
        name = _path(error['loc'][-context['parts'] :])
        return f"'{name}' is {value!r}{context['says']} {context['what']}"
    if error['type'] == 'tuple_type':
        return f'{name} is {value!r}; {name} must be a list'
    if error['type'] == 'literal_error':
        known = _choices(error)
        return str(UnknownNameError(f'{name} is', value, known, listed='; valid are'))
    return f'{name} is {value!r}, must be {_valid(error)}'


def _dotted(error: ErrorDetails, section: str) -> str:
    """Return e.g. `optimizer.steps is 0; it must be at least 1`."""
    name, value = '.'.join(filter(None, (section, _path(error['loc'])))), error['input']
    if error['type'] == 'literal_error':
        return str(UnknownNameError(name, value, _choices(error)))
    return f'{name} is {value!r}; it must be {_valid(error)}'


def _inside(error: ErrorDetails, text: str) -> str:
    return ': '.join(filter(None, (_path(error['loc'][:-1]), text)))


def _path(loc: Sequence[int | str]) -> str:
    """Return e.g. `tools[0].link`."""
    parts = (f'[{part}]' if isinstance(part, int) else f'.{part}' for part in loc)
    return ''.join(parts).removeprefix('.')


def _choices(error: ErrorDetails) -> list[str]:
    return re.findall(r"'([^']*)'", error.get('ctx', {})['expected'])


def _valid(error: ErrorDetails) -> str:
    context = error.get('ctx', {})
    if error['type'] == 'greater_than':
        return f'above {context["gt"]:g}' if context['gt'] else 'positive'
    template = _VALID.get(error['type'])
    return error['msg'] if template is None else template.format(**context)  # no text of a file


def read_yaml(
    path: Path | str, what: str, setting: str, *, error: type[MtvWorldError] = ConfigError
) -> Any:
    """Return the plain values of a file.

    Args:
        path: the file.
        what: kind of file, e.g. `robot file`.
        setting: name of the parameter or option that gives the file, e.g. `robot_file`.
        error: raised instead of `ConfigError`.

    Raises:
        ConfigError: the file cannot be read, or is not YAML.
    """
    try:
        return parse_yaml(read_text(path, 'yaml_bytes'))
    except FileNotFoundError as missing:
        raise error(f"{what} '{path}' does not exist; set '{setting}' to one") from missing
    except yaml.YAMLError as broken:
        raise error(f"{what} '{path}' cannot be read, it is not valid YAML: {broken}") from broken
    except (OSError, ValueError) as unread:
        raise error(f"{what} '{path}' cannot be read: {unread}; set '{setting}'") from unread
