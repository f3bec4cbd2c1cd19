"""Makes the pictures of README and tutorials from what their commands wrote.

    python docs/tutorial_pictures.py FOLDER

FOLDER is where their lines were run: a clone of the repository, or the folder `docs0` that
`pytest test/docs/test_shell_lines.py --basetemp FOLDER` leaves (without `demo`). Pages and viewers
are opened in a headless Chromium. For `viewer_live` a node is started here.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
import http.server
import os
from pathlib import Path
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time

import cv2

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
from test.support.browser import Browser  # noqa: E402

#: largest width of a picture [px]
WIDTH = 900
#: opens the first card of a section that is the target of an address
_SHOW_FIRST = "document.querySelector(':target details')?.setAttribute('open', '')"
#: time for the first frames of a page's videos [s]
PAGE_WAIT_S = 5
#: pictures whose words would be too small then; these keep all colours
WIDE = ('demo', 'viewer', 'viewer_live')
#: colours of a picture: it is to be small
NUM_COLOURS = 256
FILES = {
    'demo': 'out/demo/contact_sheet.png',
    'tutorial_expert': 'out/judge/expert/episode_00000/contact_sheet.png',
    'tutorial_mine': 'out/judge/mine/episode_00000/contact_sheet.png',
    'tutorial_check': 'out/tutorial/check/low.png',
    'tutorial_imagined': 'out/tutorial/imagined/contact_sheet.png',
}
PAGES = {
    'tutorial_ranking': 'out/judge/ranking/ranking.html',
    'tutorial_scores': 'out/tutorial/scores/report.html',
    'ranking_page': 'out/judge/ranking/ranking.html#rollouts',
    'evaluation_page': 'out/tutorial/scores/report.html#episodes',
}
VIEWS = {
    'tutorial_live': 'out/judge/live.rrd',
    'viewer': 'out/tutorial/view.rrd',
    'tutorial_watched': 'out/tutorial/live.rrd',
    'viewer_live': 'out/live.rrd',
}
#: ROS domain in which the node of `viewer_live` runs, so that it meets no other
DOMAIN = '176'


def save(picture: Path, name: str) -> None:
    """Write a picture as docs/NAME.png, small if it may be."""
    from PIL import Image

    shown = cv2.imread(str(picture))
    assert shown is not None, f'{picture} is no picture'
    factor = 1.0 if name in WIDE else min(1.0, WIDTH / shown.shape[1])
    small = cv2.resize(shown, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    image = Image.fromarray(cv2.cvtColor(small, cv2.COLOR_BGR2RGB))
    out = ROOT / 'docs' / f'{name}.png'
    few = image.quantize(NUM_COLOURS, kmeans=2)  # without k-means orange becomes red
    (image if name in WIDE else few).save(out, optimize=True)
    sys.stdout.write(f'{out}: {out.stat().st_size // 1024} kB\n')


def page_picture(folder: Path, page: str, picture: Path) -> None:
    """Open a page of a folder."""
    with served(folder) as address, opened(picture.parent) as browser:
        browser.open(f'{address}/{page}')
        browser.run(_SHOW_FIRST)
        time.sleep(PAGE_WAIT_S)
        browser.picture(picture)


class served:
    """Serves a folder to this machine."""

    def __init__(self, folder: Path) -> None:
        handler: Callable[..., http.server.SimpleHTTPRequestHandler] = partial(
            http.server.SimpleHTTPRequestHandler, directory=str(folder)
        )
        self._server = http.server.ThreadingHTTPServer(('127.0.0.1', 0), handler)

    def __enter__(self) -> str:
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return f'http://127.0.0.1:{self._server.server_port}'

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()


class opened:
    """A browser that ends."""

    def __init__(self, folder: Path) -> None:
        self._browser = Browser(Path(tempfile.mkdtemp(dir=folder)))

    def __enter__(self) -> Browser:
        return self._browser

    def __exit__(self, *_: object) -> None:
        self._browser.close()


def free_ports() -> tuple[int, int]:
    """Return two ports that nobody serves: an earlier viewer would be the picture."""
    with socket.socket() as page, socket.socket() as data:
        for one in (page, data):
            one.bind(('127.0.0.1', 0))
        return page.getsockname()[1], data.getsockname()[1]


def viewer_picture(file: Path, picture: Path, wait_s: float) -> None:
    """Open a file in Rerun's viewer for browsers."""
    page, data = free_ports()
    command = [sys.executable, '-m', 'rerun', str(file), '--serve-web', '--port', str(data)]
    command += ['--web-viewer-port', str(page)]
    quiet = subprocess.DEVNULL
    viewer = subprocess.Popen(command, stdout=quiet, stderr=quiet, start_new_session=True)
    try:
        time.sleep(5)
        assert viewer.poll() is None, f'the viewer of {file} ended'
        with opened(picture.parent) as browser:
            browser.open(f'http://127.0.0.1:{page}/?url=rerun%2Bhttp://127.0.0.1:{data}/proxy')
            time.sleep(wait_s)
            browser.picture(picture)
    finally:
        os.killpg(viewer.pid, signal.SIGTERM)  # the viewer is a child of its Python
        viewer.wait()


def record_live(folder: Path) -> None:
    """Record what `mtv-world view --live` shows while the node imagines the bundled episode."""
    environment = {**os.environ, 'ROS_DOMAIN_ID': DOMAIN}
    parameters = ['place:=simulator/nominal', 'compressed_input:=true']
    parameters += ['calibration_file:=resource/demo_episode/calibration.yaml']
    commands = [
        ['world_model', '--ros-args', *(w for p in parameters for w in ('-p', p))],
        ['mtv-world', 'view', '--live', '--overwrite', '--save', VIEWS['viewer_live']],
    ]
    run = partial(subprocess.Popen, cwd=folder, env=environment)
    programs = Path(sys.executable).parent
    started = [run([str(programs / name), *words]) for name, *words in commands]
    try:
        replay = ['replay', 'resource/demo_episode', '--lock-step']
        assert run([str(programs / 'mtv-world'), *replay]).wait() == 0, 'the replay failed'
    finally:
        for process in reversed(started):
            process.send_signal(signal.SIGINT)
            process.wait()


def main() -> None:
    """Make them all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('folder', type=Path)
    parser.add_argument('--only', nargs='*', help='names of pictures')
    parser.add_argument('--wait', type=float, default=60.0, help='for the viewer to draw [s]')
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as made:
        for name, file in {**FILES, **PAGES, **VIEWS}.items():
            if options.only and name not in options.only:
                continue
            source, picture = options.folder / file, Path(made) / f'{name}.png'
            if name in FILES:
                picture = source
            elif name in PAGES:
                page_picture(options.folder, file, picture)
            else:
                if name == 'viewer_live':
                    record_live(options.folder)
                viewer_picture(source, picture, options.wait)
            save(picture, name)


if __name__ == '__main__':
    main()
