"""Parquet tables of other people, read within limits of their size."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from mtv_world_ros.core.bounded_input import (
    check_limit,
    LimitError,
    limits,
    placeholder,
    require_regular,
)
from mtv_world_ros.core.errors import (
    EpisodeError,
    MissingPackageError,
)


def read_table(file: Path, **options: Any) -> Any:
    """Return a pyarrow table; `options` are those of `pyarrow.parquet.read_table`.

    Raises:
        EpisodeError: it cannot be read, or is larger than the limits.
    """
    pyarrow, parquet = pyarrow_modules()
    try:
        require_regular(file)
        _check_table(parquet.read_metadata(file), file, options.get('columns'))
        return parquet.read_table(file, **options)
    except (OSError, pyarrow.ArrowException) as error:
        reason = placeholder(file) or ' '.join(str(error).split())
        raise EpisodeError(f"cannot read '{file}': {reason}") from error


def _check_table(metadata: Any, file: Path, columns: Sequence[str] | None) -> None:
    """Check the size of a table: a few kilobytes may state billions of equal values or texts.

    Raises:
        EpisodeError: there are too many.
    """
    parts = [metadata.row_group(number) for number in range(metadata.num_row_groups)]
    read = [
        column
        for part in parts
        for column in map(part.column, range(part.num_columns))
        if columns is None or _is_of(column.path_in_schema, columns)
    ]
    count = sum(column.num_values for column in read)
    texts = [column for column in read if column.physical_type == 'BYTE_ARRAY']
    least = sum(column.total_uncompressed_size for column in texts)
    repeated = [c for c in texts if c.has_dictionary_page]
    most = least + sum(c.num_values * c.total_uncompressed_size for c in repeated)
    try:
        check_limit('table_values', count, f"'{file}'")
        check_limit('table_bytes', least, f"'{file}'")
        if most > limits().table_bytes:
            paths = sorted({column.path_in_schema for column in texts})
            check_limit('table_bytes', text_bytes(file, paths), f"'{file}'")
    except LimitError as error:
        raise EpisodeError(str(error)) from error


def _is_of(path: str, columns: Sequence[str]) -> bool:
    """Return True if a path in the schema belongs to a column; names of columns may have dots."""
    return any(path == name or path.startswith(f'{name}.') for name in columns)


def text_bytes(file: Path, paths: Sequence[str]) -> int:
    """Return the size of texts and images in these columns of a table.

    A table stores a repeated text once. It is read that way here, as reading it row by row fills
    the memory.
    """
    _, parquet = pyarrow_modules()
    table = parquet.ParquetFile(file, read_dictionary=list(paths))
    batches = table.iter_batches(columns=list(paths))
    return sum(_array_bytes(column) for batch in batches for column in batch.columns)


def _array_bytes(array: Any) -> int:
    """Return the size of the texts in an array, and in the arrays that it consists of."""
    pyarrow, _ = pyarrow_modules()
    compute: Any = import_module('pyarrow.compute')
    types, kind = pyarrow.types, array.type
    if types.is_dictionary(kind):
        lengths = compute.binary_length(array.dictionary)
        return int(compute.sum(lengths.take(array.indices.drop_null())).as_py() or 0)
    if types.is_struct(kind):
        return sum(_array_bytes(array.field(number)) for number in range(kind.num_fields))
    if types.is_list(kind) or types.is_large_list(kind):
        return _array_bytes(array.flatten())
    if any(check(kind) for check in (types.is_string, types.is_binary)):
        return int(compute.sum(compute.binary_length(array.cast(pyarrow.binary()))).as_py() or 0)
    return 0


def pyarrow_modules() -> tuple[Any, Any]:
    """Return `pyarrow` and `pyarrow.parquet`, which are optional."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise MissingPackageError('a LeRobot data set', 'pyarrow') from error
    return pyarrow, parquet
