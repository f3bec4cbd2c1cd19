"""Limits on what comes from outside, and readers that keep to them before they do any work.

Bags, images, YAML, JSON, checkpoints, messages and answers of servers are read through here. A
limit that is too low for you is raised with an environment variable, e.g.
`MTV_WORLD_MAX_IMAGE_PIXELS=200000000`.
"""

from __future__ import annotations

import codecs
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
import errno
from io import BytesIO
import json
import math
import os
from pathlib import Path
import re
import stat
import struct
import sys
from typing import Any, BinaryIO
import zipfile
import zlib

import numpy as np
import yaml

from mtv_world_ros.core.errors import CheckpointError, ConfigError

PREFIX = 'MTV_WORLD_MAX_'
#: plain YAML values may be numbers, whose digits cost quadratic time
_LONGEST_NUMBER = 4_000
#: characters of a template, as of a path on Linux (PATH_MAX)
_LONGEST_TEMPLATE = 4_096
#: a field, braces that stand for themselves, or a lone brace with what follows
_FIELD = re.compile(
    r'\{\{|\}\}|\{(?P<name>[A-Za-z_]\w*)(?::(?P<width>\d{1,2})d)?\}|\{[^{}]*\}?|\}'
)
_LOADER: Any = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
_MERGE = 'tag:yaml.org,2002:merge'


class _UniqueKeys(_LOADER):
    """A loader that refuses a key that a mapping has twice: the first would be lost unsaid."""

    def get_single_node(self) -> yaml.Node | None:
        """Return the root of the text, before merges are written out."""
        root = super().get_single_node()
        left, known = [root], set[int]()
        while left:
            node = left.pop()
            if not isinstance(node, yaml.CollectionNode) or id(node) in known:
                continue
            known.add(id(node))
            if isinstance(node, yaml.MappingNode):
                _check_keys(node)
                left += [part for row in node.value for part in row]
            else:
                left += node.value
        return root


def _check_keys(node: yaml.MappingNode) -> None:
    first: dict[tuple[str, str], int] = {}
    for key, _ in node.value:
        if isinstance(key, yaml.ScalarNode) and key.tag != _MERGE:
            line = key.start_mark.line + 1
            if (key.tag, key.value) in first:
                before = first[key.tag, key.value]
                raise yaml.YAMLError(f"'{key.value}' is there twice, in lines {before} and {line}")
            first[key.tag, key.value] = line


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """The largest sizes that are accepted from outside.

    Attributes:
        yaml_bytes: size of a YAML text.
        yaml_nodes: number of values in a YAML text, once aliases and merges are written out.
        urdf_bytes: size of a robot's URDF.
        urdf_links: number of links, or of joints, of a robot.
        chain_links: number of links of a robot in a row, from its root; parsers recurse over them.
        xml_elements: number of elements of a URDF or a COLLADA mesh.
        mesh_bytes: size of a mesh file.
        nesting: levels of lists, maps and elements, in YAML, JSON, XML and answers of policy
            servers.
        json_bytes: size of a JSON file; tokenizers have tens of megabytes.
        image_bytes: size of an image file in a message.
        image_pixels: number of pixels of an image, checked before it is decoded.
        jpeg_scans: number of scans of a progressive JPEG; each costs a pass over all pixels.
        video_bytes: size of a video once it is decoded.
        chunk_bytes: size of a bag's chunk once it is inflated, and of a message.
        plan_bytes: size of a trajectory in a message.
        message_bytes: size of a message that is no image and no trajectory.
        joint_names: number of joint names in a message.
        trajectory_points: number of points of a trajectory in a message.
        instruction_characters: length of an instruction.
        table_values: numbers and texts in the columns that are read of a parquet file.
        table_bytes: texts and images in these columns, each counted as often as it is repeated.
        answer_bytes: size of an answer of a policy server or of a language model.
        array_bytes: size of an array in an answer, and of all arrays in a file, inflated.
    """

    yaml_bytes: int = 4 * 2**20
    yaml_nodes: int = 200_000
    urdf_bytes: int = 16 * 2**20
    urdf_links: int = 2_000
    chain_links: int = 200
    xml_elements: int = 200_000
    mesh_bytes: int = 128 * 2**20
    nesting: int = 64
    json_bytes: int = 256 * 2**20
    image_bytes: int = 64 * 2**20
    image_pixels: int = 50_000_000
    jpeg_scans: int = 64
    video_bytes: int = 2**32
    chunk_bytes: int = 2**28
    plan_bytes: int = 32 * 2**20
    message_bytes: int = 2**18
    joint_names: int = 1_000
    trajectory_points: int = 20_000
    instruction_characters: int = 4_000
    table_values: int = 200_000_000
    table_bytes: int = 4 * 2**30
    answer_bytes: int = 64 * 2**20
    array_bytes: int = 256 * 2**20


def limits() -> Limits:
    """Return the limits as the environment sets them.

    Raises:
        ConfigError: a variable is not a positive whole number.
    """
    values = {}
    for field in fields(Limits):
        variable = PREFIX + field.name.upper()
        text = os.environ.get(variable)
        if text is not None:
            if not (text.isascii() and text.isdigit() and len(text) < 16 and int(text) > 0):
                raise ConfigError(
                    f"environment variable '{variable}' is '{text}'; it must be a positive "
                    'whole number'
                )
            values[field.name] = int(text)
    return Limits(**values)


class LimitError(ValueError):
    """Something from outside is larger than is allowed."""


def check_limit(name: str, value: int, what: str) -> None:
    """Check the size of `what`, e.g. `the image`, against the field `name` of `Limits`.

    Raises:
        LimitError: the value is larger; names the environment variable that allows more.
    """
    most = getattr(limits(), name)
    if value > most:
        unit = name.rsplit('_', 1)[-1]
        raise LimitError(
            f'{what} has {value} {unit}; at most {most} are read (the environment variable '
            f'{PREFIX}{name.upper()} allows more)'
        )


def read_bytes(path: Path | str, limit: str) -> bytes:
    """Return the content of a regular file within a field of `Limits`; never blocks on a pipe.

    Raises:
        OSError: the file cannot be read, or is no regular file.
        LimitError: the file is too large.
    """
    with _open_regular(path) as (file, size):
        check_limit(limit, size, f"'{path}'")
        return file.read(size)


@contextmanager
def _open_regular(path: Path | str) -> Iterator[tuple[BinaryIO, int]]:
    """Yield the file and its size [bytes]; OSError if it is no regular one."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with open(descriptor, 'rb') as file:
        status = os.fstat(descriptor)
        if stat.S_ISDIR(status.st_mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, 'it is no regular file', str(path))
        yield file, status.st_size


def require_regular(*paths: Path | str) -> None:
    """Check files that a library opens by their paths, before it blocks on a pipe.

    Args:
        paths: files; of a folder all files directly in it. A missing path is left to the reader.

    Raises:
        OSError: one is a pipe, a device or a socket.
    """
    for path in map(Path, paths):
        for file in path.iterdir() if path.is_dir() else [path]:
            if file.exists() and not (file.is_file() or file.is_dir()):
                raise OSError(errno.EINVAL, 'it is no regular file', str(file))


#: beginning of a file that is enough to tell a placeholder [bytes]
_HEAD_BYTES = 512


def placeholder(path: Path | str) -> str:
    """Return the reason why a file is a placeholder, with the remedy; empty if it is none.

    Repositories that were cloned without Git LFS hold pointers, and failed downloads HTML pages.
    """
    try:
        with _open_regular(path) as (file, _):
            return placeholder_content(file.read(_HEAD_BYTES))
    except OSError:  # whoever reads it names that
        return ''


def placeholder_content(data: bytes) -> str:
    """Return the reason why a file of this content is a placeholder; empty if it is none."""
    head = data[:_HEAD_BYTES].lstrip().lower()
    if head.startswith(b'version https://git-lfs.github.com/'):
        return "is a pointer of Git LFS, not the file: run 'git lfs pull' in its repository"
    if head.startswith((b'<!doctype html', b'<html')):
        return 'is an HTML page, not the file: its download failed; fetch the file itself'
    return ''


def read_text(path: Path | str, limit: str) -> str:
    """Return the text of a regular file, in UTF-8, or UTF-16 with its mark; see `read_bytes`.

    The byte order mark that editors and spreadsheet programs write is no part of the text.
    """
    data = read_bytes(path, limit)
    is_utf16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return data.decode('utf-16' if is_utf16 else 'utf-8-sig')


def read_json(path: Path | str) -> Any:
    """Return the values of a JSON file.

    Raises:
        OSError: the file cannot be read, or is no regular file.
        ValueError: the file is too large, too deeply nested, or not JSON.
    """
    return parse_json(read_bytes(path, 'json_bytes'), f"'{path}'")


def parse_json(text: str | bytes, what: str) -> Any:
    """Return the values of a JSON text whose size was checked.

    Raises:
        ValueError: the text is not JSON, or too deeply nested.
    """
    try:
        return json.loads(text, parse_int=_whole_number)
    except RecursionError:
        raise LimitError(f'{what} is nested too deeply') from None


def _whole_number(digits: str) -> int:
    """Return an integer of no more digits than a float can hold."""
    if len(digits) > sys.float_info.max_10_exp:
        raise LimitError(f'a whole number has {len(digits)} digits')
    return int(digits)


def fill_template(template: object, values: Mapping[str, int | str]) -> str:
    """Return a template's text with its fields filled in, e.g. `episode_{episode_index:06d}.mp4`.

    Fields are `{name}`, or `{name:6d}` and `{name:06d}` for whole numbers; `{{` and `}}` stand for
    braces. Python's own format strings reach attributes of objects and make texts of any length.

    Args:
        template: template from a file.
        values: values of the fields.

    Raises:
        ValueError: it is no text, too long, or has another field or format, or a lone brace.
    """
    if not isinstance(template, str):
        raise ValueError(f'it is {type(template).__name__}, no text')
    if len(template) > _LONGEST_TEMPLATE:
        raise LimitError(
            f'it has {len(template)} characters; at most {_LONGEST_TEMPLATE} are read'
        )

    def filled(match: re.Match[str]) -> str:
        part, name, width = match[0], match['name'], match['width']
        if part in ('{{', '}}'):
            return part[0]
        if name not in values:
            known = ', '.join(f'{{{key}}}' for key in values)
            raise ValueError(f"'{part}' is no field of it; fields are {known}")
        if width is None:
            return str(values[name])
        if not isinstance(values[name], int):
            raise ValueError(f"'{part}': {name} is no whole number; write {{{name}}}")
        return f'{values[name]:{width}d}'

    return _FIELD.sub(filled, template)


def read_arrays(
    path: Path | str, limit: str = 'array_bytes', without: Collection[str] = ()
) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz file by name; inflated they are within a field of `Limits`.

    Args:
        path: the file.
        limit: field of `Limits`.
        without: members of the archive that are not read.

    Raises:
        OSError: the file cannot be read, or is no regular file.
        ValueError: it is too large once inflated, damaged, or holds objects (pickles).
    """
    try:
        with _open_regular(path) as (file, _), zipfile.ZipFile(file) as archive:
            members = [one for one in archive.infolist() if one.filename not in without]
            check_limit(limit, sum(member.file_size for member in members), f"'{path}', inflated,")
            return {
                member.filename.removesuffix('.npy'): _array(archive.read(member))
                for member in members
            }
    except (
        zipfile.BadZipFile, zlib.error, struct.error, EOFError, NotImplementedError, RuntimeError,
        ArithmeticError, SyntaxError, MemoryError, LookupError, TypeError,
    ) as error:  # fmt: skip
        raise ValueError(f'{type(error).__name__}: {error}') from error


def _array(data: bytes) -> np.ndarray:
    """Return the array of an .npy file whose header states the size that it has."""
    stream = BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
    size = math.prod(shape) * dtype.itemsize
    if dtype.hasobject or min(shape, default=0) < 0 or size != len(data) - stream.tell():
        raise ValueError(f'an array of shape {shape} and type {dtype} in {len(data)} bytes')
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)


def check_finite(tensor: Any, name: str, file: Path) -> None:
    """Check that a tensor of torch holds finite numbers: a model with others gives wrong results.

    Raises:
        CheckpointError: a number is not finite.
    """
    if not tensor.is_floating_point() or tensor.numel() == 0:
        return
    # a value that is not finite makes the sum so, which takes a fortieth of the time of testing
    # each; the sum of finite values may overflow, and 8-bit formats have no sum
    values = tensor.float() if tensor.element_size() < 2 else tensor
    if math.isfinite(float(values.sum())):
        return
    wrong = int((~values.isfinite()).sum())
    if wrong:
        raise CheckpointError(
            f"tensor '{name}' of '{file}' holds {wrong} of {tensor.numel()} values that are no "
            'finite numbers; copy the file again, or train or export it anew'
        )


def check_weights(model: Any, folder: Path) -> None:
    """Check the tensors of a module of torch; see `check_finite`."""
    for name, tensor in model.state_dict().items():
        check_finite(tensor, name, folder)


def parse_yaml(text: str | bytes) -> Any:
    """Return the plain values of a YAML text.

    Raises:
        yaml.YAMLError: it is not YAML, or too large once aliases are written out.
    """
    try:
        check_limit('yaml_bytes', len(text), 'the text')
        _YamlCount().check(yaml.parse(text, Loader=_LOADER))
        return yaml.load(text, Loader=_UniqueKeys)  # noqa: S506
    except yaml.YAMLError:
        raise
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError) as error:
        # values that their tags do not fit, such as `!!timestamp x`
        raise yaml.YAMLError(str(error)) from error


class _YamlCount:
    """Counts the nodes of a YAML text with every alias expanded."""

    def __init__(self) -> None:
        self._sizes: dict[str, int] = {}  # by anchor; of those that are complete
        self._open: list[tuple[str | None, int]] = []  # anchor, count before it
        self._count = 0

    def check(self, events: Iterator[yaml.Event]) -> None:
        """Go through the events of a parser; raise LimitError."""
        most, deepest = limits().yaml_nodes, limits().nesting
        for event in events:
            self._take(event)
            if len(self._open) > deepest:
                raise LimitError(
                    f'it is nested in more than {deepest} levels (the environment variable '
                    f'{PREFIX}NESTING allows more)'
                )
            if self._count > most:
                raise LimitError(
                    f'it holds more than {most} values, with aliases written out (the environment '
                    f'variable {PREFIX}YAML_NODES allows more)'
                )

    def _take(self, event: yaml.Event) -> None:
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in self._sizes:
                raise LimitError(f"the alias '*{event.anchor}' stands for what it is in")
            self._count += self._sizes[event.anchor]
        elif isinstance(event, yaml.NodeEvent):
            self._count += 1
            self._begin(event)
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = self._open.pop()
            if anchor:
                self._sizes[anchor] = self._count - before

    def _begin(self, event: yaml.NodeEvent) -> None:
        self._sizes.pop(event.anchor or '', None)
        if not isinstance(event, yaml.ScalarEvent):
            self._open.append((event.anchor, self._count - 1))
        elif not event.style and len(event.value) > _LONGEST_NUMBER:
            raise LimitError(f'a plain value has {len(event.value)} characters; quote it')
        elif event.anchor:
            self._sizes[event.anchor] = 1
