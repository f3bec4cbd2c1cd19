"""What a result was made with: command, date, machine, versions."""

from __future__ import annotations

import argparse
from datetime import datetime
from importlib import metadata
import os
from pathlib import Path
import platform
import shlex


def provenance(arguments: argparse.Namespace) -> dict[str, str]:
    """Returns the lines that go with a result of the running command, by heading."""
    return {
        'command': shlex.join(['mtv-world', *arguments.command_line]),
        'date': datetime.now().astimezone().isoformat(timespec='seconds'),
        'machine': machine(),
        'versions': ', '.join(
            f'{name} {metadata.version(name)}' for name in ('mtv_world_ros', 'torch', 'numpy')
        ),
    }


def machine() -> str:
    """Returns processor, number of cores, operating system."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path('/proc/cpuinfo')
    if cpuinfo.is_file():
        names = [row for row in cpuinfo.read_text().splitlines() if row.startswith('model name')]
        model = names[0].split(':', 1)[1].strip() if names else model
    return f'{model}, {os.cpu_count()} cores, {platform.system()} {platform.machine()}'
