"""Every number with a fraction that users or files give has a smallest and a largest value."""

from __future__ import annotations

from collections.abc import Iterator
import importlib
from math import nan
import pkgutil
from typing import Annotated, Any, get_args, get_origin

from annotated_types import BaseMetadata
from pydantic import Field, ValidationError
from pydantic.fields import FieldInfo
import pytest

import mtv_world_ros
from mtv_world_ros.core.config import ListOf, Schema
from mtv_world_ros.success.calibration import HorizonCurve

LOWER, UPPER = ('ge', 'gt'), ('le', 'lt')


def _schemas() -> list[type[Schema]]:
    for module in pkgutil.walk_packages(mtv_world_ros.__path__, 'mtv_world_ros.'):
        if not module.name.endswith('__main__'):
            importlib.import_module(module.name)
    found, new = set[type[Schema]](), [Schema]
    while new:
        new = [kind for parent in new for kind in parent.__subclasses__() if kind not in found]
        found.update(new)
    return [kind for kind in found if kind.__module__.startswith('mtv_world_ros.')]


def _flat(metadata: Any) -> Iterator[BaseMetadata]:
    for row in metadata:
        yield from _flat(row.metadata) if isinstance(row, FieldInfo) else (row,)


def _ranges(annotation: Any, metadata: tuple[Any, ...] = ()) -> Iterator[bool]:
    """For every `float` in an annotation: whether both of its ends are given."""
    if get_origin(annotation) is Annotated:
        inner, *more = get_args(annotation)
        yield from _ranges(inner, (*metadata, *more))
    elif annotation is float:
        rows = list(_flat(metadata))
        yield all(
            any(getattr(row, name, None) is not None for row in rows for name in names)
            for names in (LOWER, UPPER)
        )
    else:
        for inner in get_args(annotation):
            yield from _ranges(inner, metadata)


def _without_range(kind: type[Schema]) -> list[str]:
    return [
        f'{kind.__module__}.{kind.__name__}.{name}'
        for name, field in kind.model_fields.items()
        if not all(_ranges(field.annotation, tuple(field.metadata)))
    ]


def test_every_number_of_every_schema_has_a_range():
    schemas = _schemas()
    assert len(schemas) > 50
    assert not [name for kind in schemas for name in _without_range(kind)]


def test_a_number_without_a_range_is_noticed():
    class Wrong(Schema):
        fine: Annotated[float, Field(ge=0, le=1)] | None = None
        high: float = Field(default=0.0, ge=0)
        rows: dict[str, ListOf[tuple[str, float]]] = {}
        union: int | float = 0
        whole: int = 0

    assert [name.rsplit('.')[-1] for name in _without_range(Wrong)] == ['high', 'rows', 'union']


def test_what_is_not_known_may_be_no_number_but_not_out_of_range():
    curve = {'period_s': 0.2, 'segmenter': 'colour', 'num_episodes': 3, 'lower': [nan, 0.0]}
    assert HorizonCurve.model_validate({**curve, 'values': [nan, 0.5]}).values[1] == 0.5
    for wrong in (1.5, float('inf')):
        with pytest.raises(ValidationError):
            HorizonCurve.model_validate({**curve, 'values': [nan, wrong]})
