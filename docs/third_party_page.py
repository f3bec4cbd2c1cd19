"""Writes the notices of third parties: `python docs/third_party_page.py`.

The page lists what a container with this package and ROS hands on: every distribution that
`pip install mtv_world_ros[ros]` brings, its licence, and the native libraries inside its wheel.
`python docs/third_party_page.py --advisories` asks pip-audit for published vulnerabilities of the
pinned versions, and says where that could not be done (status 2).
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import Distribution, distribution, PackageNotFoundError
import json
from pathlib import Path
import re
import subprocess
import sys
from typing import NamedTuple
from xml.etree import ElementTree

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PAGE = Path(__file__).parent / 'third_party.md'
PINS = ROOT / 'requirements' / 'constraints.txt'
PACKAGE, EXTRAS = 'mtv_world_ros', ('ros',)
#: native libraries whose licence binds who hands them on, or that need updates of their own:
#: start of the file name -> what to know
WATCHED = {
    'libx264': 'x264, GPL-2.0-or-later',
    'libx265': 'x265, GPL-2.0-or-later',
    'libavcodec': 'FFmpeg; GPL where it is built with x264 or x265',
    'libcrypto': 'OpenSSL',
    'libssl': 'OpenSSL',
}
_HEAD = """\
# Third-party notices

What a container with this package and ROS hands on: `pip install mtv_world_ros[ros]` with the
pinned versions, without torch's own notices, which its wheel has in `torch-*.dist-info`. Each
wheel has its licence texts in its `.dist-info` folder. Native libraries are those inside the
wheel. Who hands on x264 or x265, as the wheel of `av` does, hands on software under the GPL: offer
its source, or build PyAV on an FFmpeg without them. An OpenSSL inside a wheel gets no updates from
the system; this package opens no TLS connection with OpenCV. This page is written by
`python docs/third_party_page.py`; `make advisories` asks pip-audit for vulnerabilities of the
pinned versions, and says so where that could not be done.

| package | version | licence | native libraries to know |
|---|---|---|---|
"""
_CLASSIFIER = 'License :: OSI Approved :: '
#: licence texts in place of a name are longer than this [characters]
_LONGEST_NAME = 60


class Notice(NamedTuple):
    """A distribution that is handed on."""

    name: str
    version: str
    licence: str
    libraries: tuple[str, ...]


def closure() -> dict[str, Distribution]:
    """Return the distributions that the package needs, by normalised name, without itself."""
    found: dict[str, Distribution] = {}
    waiting: list[tuple[str, tuple[str, ...]]] = [(PACKAGE, EXTRAS)]
    seen: set[tuple[str, tuple[str, ...]]] = set()
    while waiting:
        name, extras = waiting.pop()
        if (canonicalize_name(name), extras) in seen:
            continue
        seen.add((canonicalize_name(name), extras))
        try:
            there = distribution(name)
        except PackageNotFoundError:
            continue  # of another platform
        found[canonicalize_name(name)] = there
        for text in there.requires or ():
            needed = Requirement(text)
            marker = needed.marker
            if marker is None or any(marker.evaluate({'extra': one}) for one in ('', *extras)):
                waiting.append((needed.name, tuple(sorted(needed.extras))))
    found.pop(canonicalize_name(PACKAGE))
    return dict(sorted(found.items()))


def notices() -> Iterator[Notice]:
    """Yield the notice of each distribution."""
    for name, there in closure().items():
        files = {Path(str(file)).name for file in there.files or ()}
        known = {
            f'{text} ({file})'
            for file in files
            for start, text in WATCHED.items()
            if file.startswith(start)
        }
        yield Notice(name, there.version, licence_of(there), tuple(sorted(known)))


def licence_of(there: Distribution) -> str:
    """Return the licence of a distribution by its metadata; `not stated` if it names none."""
    metadata = there.metadata
    for key in ('License-Expression', 'License'):
        text = str((metadata.get_all(key) or [''])[0]).strip()
        if text and text.upper() != 'UNKNOWN' and len(text) <= _LONGEST_NAME:
            return text
    named = [
        line.removeprefix(_CLASSIFIER)
        for line in metadata.get_all('Classifier') or ()
        if line.startswith(_CLASSIFIER)
    ]
    if named:
        return ', '.join(named)
    if metadata.get_all('License-File'):
        return 'see its licence text'
    return licence_of_ros_package(metadata['Name']) or 'not stated'


def licence_of_ros_package(name: str) -> str:
    """Return the licences that the package.xml of a ROS wheel names; empty if it has none."""
    folder = re.sub(r'^ros-(jazzy-)?', '', name).replace('-', '_')
    file = Path(sys.prefix) / 'share' / folder / 'package.xml'
    if not file.is_file():
        return ''
    return ', '.join(node.text or '' for node in ElementTree.parse(file).iter('license'))


def page() -> str:
    """Return the text of the page."""
    rows = [
        f'| `{one.name}` | {one.version} | {one.licence} | {"; ".join(one.libraries)} |'
        for one in notices()
    ]
    return _HEAD + '\n'.join([*rows, ''])


def advisories() -> tuple[int, list[str]]:
    """Return published vulnerabilities of the pinned versions by pip-audit: status and lines.

    Status 0: none is published; 1: some are; 2: it could not be found out, with the reason.
    """
    words = ['-m', 'pip_audit', '--no-deps', '--disable-pip', '-f', 'json', '-r', str(PINS)]
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False)
    try:
        packages = json.loads(done.stdout)['dependencies']
    except (ValueError, LookupError):
        last = (done.stderr.strip().splitlines() or ['no answer'])[-1]
        why = f'{last}. It needs the package pip-audit and a network'
        return 2, [f'advisories were not checked: {why}']
    found = [(one, item) for one in packages for item in one.get('vulns', ())]
    lines = [
        f'{one["name"]} {one["version"]}: {item["id"]}; fixed in '
        f'{", ".join(item.get("fix_versions", ())) or "no version so far"}'
        for one, item in found
    ]
    skipped = [one for one in packages if 'skip_reason' in one]
    lines += [f'{one["name"]}: not checked: {one["skip_reason"]}' for one in skipped]
    lines.append(f'{len(packages)} pinned: {len(found)} advisories, {len(skipped)} not checked')
    return 1 if found else 2 if skipped else 0, lines


if __name__ == '__main__':
    if sys.argv[1:] == ['--advisories']:
        status, said = advisories()
        sys.stdout.write('\n'.join([*said, '']))
        sys.exit(status)
    PAGE.write_text(page(), encoding='utf-8')
