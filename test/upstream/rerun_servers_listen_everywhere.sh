#!/usr/bin/env bash
# Where the servers of the Rerun SDK listen, in one release.
#
# Expected, written down before the run: serve_grpc and serve_web_viewer have no argument for an
# address, and listen on every one (0.0.0.0); the program of the same package takes --bind and
# listens there alone, page and data. It guards mtv_world_ros/viewing/viewer_process.py, which
# starts the program for that reason; once the functions take an address, it can go.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/env"
"$place/env/bin/pip" install -q --disable-pip-version-check rerun-sdk==0.41.0 psutil==7.2.2
"$place/env/bin/python" - <<'PYTHON'
import inspect
import os
from pathlib import Path
import subprocess
import time

import psutil
import rerun
import rerun_cli


def listening(pid):
    found = {}
    for connection in psutil.Process(pid).net_connections('tcp'):
        if connection.status == psutil.CONN_LISTEN:
            found[connection.laddr.port] = connection.laddr.ip
    return found


stream = rerun.RecordingStream('upstream')
data = stream.serve_grpc(grpc_port=18771)
rerun.serve_web_viewer(web_port=18770, open_browser=False, connect_to=data)
functions = listening(os.getpid())
print('functions', functions)
program = Path(rerun_cli.__file__).with_name('rerun')
ports = ['--port', '18773', '--web-viewer-port', '18772']
command = [program, '--serve-web', '--bind', '127.0.0.1', *ports]
with subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL) as process:
    end_s = time.monotonic() + 60
    while len(found := listening(process.pid)) < 2 and time.monotonic() < end_s:
        time.sleep(0.1)
    process.kill()
print('program', found)
for function in (rerun.serve_grpc, rerun.serve_web_viewer):
    names = ' '.join(inspect.signature(function).parameters)
    assert 'bind' not in names and 'host' not in names, f'changed: {function.__name__}({names})'
assert {functions.get(18770), functions.get(18771)} == {'0.0.0.0'}, 'changed: the functions'
assert found == {18772: '127.0.0.1', 18773: '127.0.0.1'}, 'changed: the program'
os._exit(0)
PYTHON
