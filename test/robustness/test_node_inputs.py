"""The short part of `python -m robustness.node_inputs`."""

from __future__ import annotations

import json
from pathlib import Path
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed (pip install .[ros])')


@pytest.mark.slow
def test_no_input_of_a_peer_ends_blinds_or_silences_the_node():
    """In a process of its own: Fast DDS reads settings once, and tests have the package's."""
    done = subprocess.run(
        [sys.executable, '-m', 'robustness.node_inputs', '--cases', '60'],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [row['attack'] for row in rows][-2:] == ['fuzz', 'end'] and len(rows) == 11
