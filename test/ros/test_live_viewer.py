"""`mtv-world view --live`: what a node and cameras publish, in a file of the viewer."""

import re
import signal
import subprocess
import sys
import time

import pytest
from std_msgs.msg import Float64

from test.support.in_process import PATIENCE_S

pytest.importorskip('rerun')


def chunks_of(file):
    """What `rerun rrd print` says of a file: its bytes are compressed, and may split a name."""
    command = [sys.executable, '-m', 'rerun', 'rrd', 'print', str(file)]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout


@pytest.mark.slow
def test_topics_are_shown_as_they_appear(ros, tmp_path):
    file = tmp_path / 'live.rrd'
    command = [sys.executable, '-m', 'mtv_world_ros.cli', 'view', '--live', '--save', str(file)]
    log = tmp_path / 'errors.txt'
    with log.open('w') as errors_to:
        process = subprocess.Popen(
            command, env=ros.ENVIRONMENT, stdout=subprocess.PIPE, stderr=errors_to, text=True
        )
    client = ros.Client()

    def send():
        stamp_ns = client.now_ns()
        client.publish('/low/image_raw', ros.make_image('low', stamp_ns))
        ahead = ros.make_image('low', stamp_ns + 200_000_000)
        client.publish('/world_model/low/predicted/image_raw', ahead)
        client.publish('/world_model/success', Float64(data=0.75))
        client.publish('/instruction', ros.STRING(data='stack the blocks'))
        broken = ros.make_image('high', stamp_ns)
        broken.encoding = 'no encoding'
        client.publish('/high/image_raw', broken)

    def is_shown():
        shown = chunks_of(file)
        return refused.search(log.read_text()) and all(path in shown for path in wanted)

    wanted = {f'/live/{path} ' for path in ('low/real', 'low/imagined', 'success', 'words')}
    refused = re.compile('[1-9][0-9]* messages cannot be shown; the last, of /high/image_raw')
    try:
        end = time.monotonic() + PATIENCE_S
        send()
        while not is_shown():
            assert time.monotonic() < end and process.poll() is None
            client.spin_for(1.0)
            send()  # what was sent before the viewer's readers knew the publishers is lost
    finally:
        client.close()
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=PATIENCE_S)
    errors = log.read_text()
    assert process.returncode == 0, errors
    assert f'written: {file}\nCtrl-C ends it' in said
    assert refused.search(errors)
    assert 'Traceback' not in errors
    shown = chunks_of(file)
    assert all(path in shown for path in wanted) and 'high/real' not in shown


def test_live_and_paths_exclude_each_other(capsys):
    from mtv_world_ros.cli import main

    for words in (['view'], ['view', 'somewhere', '--live']):
        assert main(words) == 1
        assert 'give one PATH or more to show, or --live' in capsys.readouterr().err
