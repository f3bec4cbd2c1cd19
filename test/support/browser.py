"""A headless Chromium that opens pages, for tests of what people see: DevTools over a pipe."""

from __future__ import annotations

import base64
import itertools
import json
import os
from pathlib import Path
import select
import shutil
import subprocess
import time
from typing import Any

import pytest

NAMES = ('chromium', 'chromium-browser', 'google-chrome')
SCREENSHOTS = Path(__file__).resolve().parents[2] / 'out' / 'screenshots'
#: a busy machine takes long
TIMEOUT_S = 240.0


class Browser:
    """One page of a browser of its own.

    Args:
        folder: for its profile.
    """

    def __init__(self, folder: Path) -> None:
        program = next((found for name in NAMES if (found := shutil.which(name))), None)
        if program is None:
            pytest.skip('there is no Chromium')
        ours_in, self._out = os.pipe()
        self._in, ours_out = os.pipe()
        flags = ['--headless=new', '--no-sandbox', '--disable-gpu', '--mute-audio']
        flags += ['--remote-debugging-pipe', f'--user-data-dir={folder}', '--no-first-run']
        # no page of a test needs the network, and the browser itself shall not try it
        flags += ['--disable-quic', '--disable-background-networking']
        flags += ['--disable-component-update', '--disable-sync']
        flags += ['--window-size=1300,1000', '--enable-unsafe-swiftshader', '--use-gl=angle']

        def connect() -> None:  # it reads file 3 and writes file 4
            os.dup2(ours_in, 1003)
            os.dup2(ours_out, 1004)
            os.dup2(1003, 3)
            os.dup2(1004, 4)

        self._process = subprocess.Popen(
            [program, *flags, 'about:blank'],
            preexec_fn=connect,
            close_fds=False,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(ours_in)
        os.close(ours_out)
        self._numbers, self._waiting, self._session = itertools.count(1), b'', ''
        target = self.call('Target.createTarget', url='about:blank')['targetId']
        attached = self.call('Target.attachToTarget', targetId=target, flatten=True)
        self._session = attached['sessionId']

    def call(self, method: str, **parameters: Any) -> Any:
        """Return the result of a DevTools method."""
        number = next(self._numbers)
        message = {'id': number, 'method': method, 'params': parameters}
        if self._session:
            message['sessionId'] = self._session
        os.write(self._out, json.dumps(message).encode() + b'\0')
        end = time.monotonic() + TIMEOUT_S
        while True:
            answer = self._receive(end)
            if answer.get('id') == number:
                assert 'error' not in answer, answer
                return answer['result']

    def _receive(self, end: float) -> dict[str, Any]:
        while b'\0' not in self._waiting:
            ready, _, _ = select.select([self._in], [], [], max(end - time.monotonic(), 0))
            assert ready, f'the browser says nothing for {TIMEOUT_S} s'
            self._waiting += os.read(self._in, 1 << 16)
        text, _, self._waiting = self._waiting.partition(b'\0')
        return json.loads(text)

    def open(self, address: str) -> None:
        """Open a page and wait until it is there."""
        self.call('Page.navigate', url=address)
        end = time.monotonic() + TIMEOUT_S
        while self.run('document.readyState + location.href').startswith('complete') is False:
            assert time.monotonic() < end
            time.sleep(0.2)

    def run(self, script: str) -> Any:
        """Return the value of a script, or of the promise that it gives."""
        found = self.call(
            'Runtime.evaluate', expression=script, awaitPromise=True, returnByValue=True
        )
        assert 'exceptionDetails' not in found, found
        return found['result'].get('value')

    def choose(self, name: str, option: str) -> None:
        """Choose an option of a drop-down by its text."""
        self.run(
            f'{{const s = document.getElementById({json.dumps(name)}); s.value = '
            f'[...s.options].find(o => o.text === {json.dumps(option)}).value; 0}}'
        )

    def shown(self) -> list[str]:
        """Return the headings of the cards that are to be seen."""
        return self.run(
            "[...document.querySelectorAll('.card')].filter(c => c.offsetParent !== null)"
            ".map(c => c.querySelector('summary').innerText)"
        )

    def play(self, number: int = 0) -> tuple[int, float]:
        """Play a video for a moment; return its width [px] and where it stands [s]."""
        width, time_s = self.run(
            'new Promise((done, fail) => {const v = '
            f"document.querySelectorAll('video')[{number}];"
            "v.closest('details').open = true; v.muted = true;"
            "v.addEventListener('error', () => fail(v.error.message));"
            "v.addEventListener('timeupdate', () => v.currentTime > 0 && "
            'done([v.videoWidth, v.currentTime])); v.load(); v.play().catch(fail);})'
        )
        return width, time_s

    def picture(self, path: Path) -> None:
        """Write what is to be seen as a PNG."""
        path.write_bytes(base64.b64decode(self.call('Page.captureScreenshot')['data']))

    def keep(self, name: str) -> None:
        """Write what is to be seen to `out/screenshots`, for people to look at."""
        SCREENSHOTS.mkdir(parents=True, exist_ok=True)
        self.picture(SCREENSHOTS / f'{name}.png')

    def close(self) -> None:
        """End it."""
        self._process.terminate()
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._in)
        os.close(self._out)
