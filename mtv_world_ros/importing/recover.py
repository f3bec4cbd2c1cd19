"""Makes whole bags of recordings that were killed, cut off or left behind on a full disk."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.data.bag.copying import copy_companions, copy_metadata, write_copies
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.bag.writer import BagWriter

#: folders of recordings in progress: .<name>.<random>.tmp
_HIDDEN = '.*.tmp'


@dataclass(frozen=True, slots=True, kw_only=True)
class Recovered:
    """A bag that was made whole.

    Attributes:
        source: the damaged bag, which stays as it is.
        path: the recovered bag.
        num_messages: number of messages by topic.
        seconds: seconds from the first message to the last.
        lost: one line for each part that could not be read.
    """

    source: Path
    path: Path
    num_messages: dict[str, int]
    seconds: float
    lost: tuple[str, ...]


def find_damaged(path: Path) -> list[Path]:
    """Bags to recover: `path` itself, the hidden folders of that name, or those in the folder.

    Raises:
        EpisodeError: there is no bag to recover.
    """
    is_bag = path.is_file() or any(path.glob('*.mcap'))
    found = [path] if is_bag else []
    if not is_bag:
        hidden = [*path.parent.glob(f'.{path.name}{_HIDDEN[1:]}'), *path.glob(_HIDDEN)]
        found = sorted(folder for folder in hidden if any(folder.glob('*.mcap')))
    if not found:
        raise EpisodeError(
            f"there is nothing to recover in '{path}': it is no bag, and no hidden folder "
            f"'.{path.name}.*.tmp' lies beside or in it"
        )
    return found


def recover(source: Path, out: Path | None = None) -> Recovered:
    """Copy every whole message, and the other files of the folder, into a new bag with an index.

    Args:
        source: folder or MCAP file; it is not changed.
        out: folder to make; by default the name the recording would have had, or that with
            `_recovered` if it is taken.

    Raises:
        EpisodeError: `source` cannot be read or has no whole message before it is cut off, or
            the new bag cannot be written.
    """
    path = out or _default_path(source)
    reader = BagReader(source, as_recorded=True)
    counts: dict[str, int] = {}
    first_ns, last_ns = 2**63, 0
    with BagWriter(path) as writer:
        for message in write_copies(reader, writer, reader.messages()):
            counts[message.topic] = counts.get(message.topic, 0) + 1
            first_ns, last_ns = min(first_ns, message.stamp_ns), max(last_ns, message.stamp_ns)
        if reader.truncated and not counts:
            raise EpisodeError(
                f"nothing can be recovered of '{source}', which has no whole message: "
                f'{reader.truncated}'
            )
        copy_metadata(reader, writer)
        copy_companions(source, writer.folder)
    lost = [reader.truncated] if reader.truncated else []
    return Recovered(
        source=source,
        path=path,
        num_messages=counts,
        seconds=max(last_ns - first_ns, 0) / 1e9,
        lost=(*lost, *(problem for problem in reader.problems if 'metadata.yaml' not in problem)),
    )


def _default_path(source: Path) -> Path:
    name = source.stem if source.is_file() else source.name
    if name.startswith('.') and name.endswith('.tmp'):
        name = name[1:].rsplit('.', 2)[0]
    path = source.with_name(name)
    return path.with_name(f'{name}_recovered') if path.exists() else path
