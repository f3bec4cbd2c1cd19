"""Where the installed files that are not code lie: config, launch and resource folders."""

from __future__ import annotations

from pathlib import Path
import sys

from mtv_world_ros.errors import ConfigError

PACKAGE = 'mtv_world_ros'


def _candidates() -> list[Path]:
    source = Path(__file__).resolve().parent.parent
    roots = [source] if (source / 'package.xml').is_file() else []
    try:
        from ament_index_python.packages import get_package_share_directory

        roots.append(Path(get_package_share_directory(PACKAGE)))
    except (ImportError, LookupError, OSError):
        pass
    return [*roots, Path(sys.prefix) / 'share' / PACKAGE]


def share_path(*parts: str) -> Path:
    """Returns the path of a bundled file or folder.

    Looks in the source tree, then in the ament share folder, then in the pip prefix.

    Raises:
        ConfigError: none of them holds it.
    """
    roots = _candidates()
    for root in roots:
        path = root.joinpath(*parts)
        if path.exists():
            return path
    searched = ', '.join(str(root) for root in roots)
    wanted = '/'.join(parts)
    raise ConfigError(f"'{wanted}' is not among the installed files; looked in {searched}")
