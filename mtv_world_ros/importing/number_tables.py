"""Tables of numbers: CSV and JSON files, as programs and spreadsheets write them.

T rows, C columns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import csv
from dataclasses import dataclass, field
import json
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.core.bounded_input import parse_json, placeholder, read_bytes, read_text
from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.errors import ConfigError, EpisodeError

#: separators of columns, in the order in which they are tried
SEPARATORS = {',': 'a comma', ';': 'a semicolon', '\t': 'a tab', '|': 'a bar'}


@dataclass(frozen=True, slots=True, kw_only=True)
class NumberTable:
    """Columns of numbers.

    Attributes:
        path: file that holds them.
        values: (T, C) numbers; NaN where a cell holds none.
        names: names of the C columns, empty where they have none.
        keys: content of the file, by key or column name.
        notes: deviations of the file from a plain table and how they were read, one line each.
        cells: text of cells that hold no number, by row and column.
    """

    path: Path
    values: FloatArray
    names: tuple[str, ...]
    keys: Mapping[str, Any]
    notes: tuple[str, ...] = ()
    cells: Mapping[tuple[int, int], str] = field(default_factory=dict)

    def check_numbers(self, columns: Sequence[int]) -> None:
        """Check that all cells of some columns are finite numbers.

        Raises:
            EpisodeError: names the first cell that is none, or a name that several columns have.
        """
        for column in columns:
            if self.names and self.names.count(self.names[column]) > 1:
                raise EpisodeError(
                    f"'{self.path}' has several columns '{self.names[column]}'; give each its own "
                    'name'
                )
        wrong = ~np.isfinite(self.values[:, list(columns)])
        if not wrong.any():
            return
        row, at = map(int, np.argwhere(wrong)[0])
        column = columns[at]
        text = self.cells.get((row, column), f'{self.values[row, column]:g}')
        name = f"'{self.names[column]}'" if self.names else str(column)
        raise EpisodeError(
            f"'{self.path}': row {row + 1} of column {name} is '{text}', must be a number"
        )


def read_table(path: Path, features: Sequence[str]) -> NumberTable:
    """Read a table.

    Args:
        path: CSV with a head, or JSON: an object of lists.
        features: keys of the JSON file whose columns are wanted, side by side; of a CSV file all
            columns are.

    Raises:
        EpisodeError: the file is missing, or no such table.
    """
    if problem := placeholder(path):
        raise EpisodeError(f"'{path}' {problem}")
    try:
        text, notes = _read_text(path)
        if path.suffix.lower() != '.json':
            return _read_csv(text, path, notes)
        keys = parse_json(text, str(path))
        if not isinstance(keys, Mapping):
            raise TypeError(f'it holds a {type(keys).__name__}, must be keys with lists')
        tables = [_json_columns(keys, feature, path) for feature in features]
    except (ConfigError, OSError, ValueError, TypeError, csv.Error, json.JSONDecodeError) as error:
        raise EpisodeError(f"'{path}' cannot be read as a table of numbers: {error}") from error
    lengths = {name: len(table) for name, table in zip(features, tables, strict=True)}
    if len(set(lengths.values())) > 1:
        raise EpisodeError(f"'{path}': rows by key are {lengths}, must be as many")
    return NumberTable(path=path, values=np.concatenate(tables, axis=1), names=(), keys=keys)


def _json_columns(keys: Mapping[str, Any], feature: str, path: Path) -> FloatArray:
    """Return the (T, C) values of a key; a list of numbers is one column."""
    if feature not in keys:
        raise EpisodeError.unknown(f"'{path}' has no", feature, keys, listed='; it has')
    table = np.asarray(keys[feature], float)
    if table.ndim == 1:
        table = table[:, None]
    if table.ndim != 2 or len(table) < 2:
        raise EpisodeError(f"'{path}': '{feature}' is {table.shape}, must be (rows, columns)")
    return table


def _read_text(path: Path) -> tuple[str, list[str]]:
    """Return the text of a table, and how it was read where it is not UTF-8.

    Raises:
        OSError, ValueError: see `read_text`; a spreadsheet is no text.
    """
    try:
        return read_text(path, 'json_bytes'), []
    except UnicodeDecodeError:
        data = read_bytes(path, 'json_bytes')
        if b'\0' in data:
            raise ValueError('it is no text; export the spreadsheet as CSV') from None
        return data.decode('cp1252', errors='replace'), ['its text is in Windows-1252']


def _read_csv(text: str, path: Path, notes: list[str]) -> NumberTable:
    lines = [line for line in text.splitlines() if line.strip(' \t,;|')]
    if lines and lines[0].lower().startswith('sep='):  # written by spreadsheet programs
        lines = lines[1:]
    separator, (head, *rows) = _split(lines, path)
    names = [name.strip() for name in head]
    names[0] = names[0].removeprefix('#').strip()
    used = [k for k in range(len(names)) if names[k] or any(row[k].strip() for row in rows)]
    names, rows = [names[k] for k in used], [[row[k] for k in used] for row in rows]
    if len(rows) < 2:
        raise EpisodeError(f"'{path}' has {len(rows)} rows of numbers, must have two or more")
    values, cells, has_commas = _numbers(rows)
    odd = [*notes]
    odd += [f'columns are separated by {SEPARATORS[separator]}'] if separator != ',' else []
    odd += ['numbers have a decimal comma'] if has_commas else []
    said = (f"'{path.name}': {' and '.join(odd)}; it was read that way",) if odd else ()
    keys = dict(zip(names, values.T, strict=True))
    return NumberTable(
        path=path, values=values, names=tuple(names), keys=keys, notes=said, cells=cells
    )


def _split(lines: Sequence[str], path: Path) -> tuple[str, list[list[str]]]:
    """Return the separator that gives all lines as many cells, and the cells."""
    if not lines:
        raise EpisodeError(f"'{path}' is empty")
    best: tuple[str, list[list[str]]] = ',', []
    for separator in SEPARATORS:
        rows = list(csv.reader(lines, delimiter=separator))
        if len(rows[0]) > 1 and all(len(row) == len(rows[0]) for row in rows):
            return separator, rows
        if not best[1] or len(rows[0]) > len(best[1][0]):
            best = separator, rows
    separator, rows = best
    uneven = next((k for k, row in enumerate(rows) if len(row) != len(rows[0])), None)
    if uneven is None:  # one column
        return ',', rows
    commas = ''
    if separator == ',' and len(rows[uneven]) > len(rows[0]):
        commas = (
            '. If numbers have a decimal comma, export the table with a semicolon between columns'
        )
    raise EpisodeError(
        f"'{path}': line {uneven + 1} has {len(rows[uneven])} cells and the head "
        f'{len(rows[0])}, separated by {SEPARATORS[separator]}{commas}'
    )


def _numbers(rows: list[list[str]]) -> tuple[FloatArray, dict[tuple[int, int], str], bool]:
    """Return values (T, C), the text of cells that hold none, and whether commas are decimal."""
    try:
        return np.array(rows, float), {}, False
    except ValueError:
        pass
    values = np.full((len(rows), len(rows[0])), np.nan)
    cells: dict[tuple[int, int], str] = {}
    has_commas = False
    for k, row in enumerate(rows):
        for column, cell in enumerate(row):
            text = cell.strip().replace('\u2212', '-')  # minus sign of text processing
            is_comma = text.count(',') == 1 and '.' not in text
            try:
                values[k, column] = float(text.replace(',', '.') if is_comma else text)
                has_commas = has_commas or is_comma
            except ValueError:
                cells[k, column] = cell.strip()
    return values, cells, has_commas
