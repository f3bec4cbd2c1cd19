"""The notices of third parties name a licence for everything that is handed on."""

from __future__ import annotations

from pathlib import Path
import subprocess
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope='module')
def notices():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / 'docs'))
        return __import__('third_party_page')


@pytest.fixture(scope='module')
def listed(notices):
    """The notices, which take a look into every installed file."""
    return tuple(notices.notices())


def test_every_package_is_on_the_page_with_its_licence(listed):
    text = (ROOT / 'docs' / 'third_party.md').read_text(encoding='utf-8')
    missing = [one.name for one in listed if f'| `{one.name}` |' not in text]
    assert missing == [], 'run python docs/third_party_page.py'
    assert 'not stated' not in text and '|  |  |' not in text


def test_packages_that_carry_the_gpl_say_so(listed):
    libraries = {one.name: ' '.join(one.libraries) for one in listed}
    assert 'x264, GPL-2.0-or-later' in libraries['av'] and 'x265' in libraries['av']
    assert 'OpenSSL' in libraries['opencv-python-headless']
    others = {name for name, text in libraries.items() if 'GPL' in text}
    assert others <= {'av', 'opencv-python-headless'}


def test_no_package_itself_is_under_a_licence_that_binds_this_one(listed):
    bound = [one for one in listed if 'GPL' in one.licence]
    assert all('LGPL' in one.licence for one in bound), bound


@pytest.mark.parametrize(
    ('output', 'errors', 'status', 'said'),
    [
        ('{"dependencies": [{"name": "a", "version": "1", "vulns": []}]}', '', 0, '0 advisories'),
        (
            (
                '{"dependencies": [{"name": "a", "version": "1", "vulns": '
                '[{"id": "CVE-1", "fix_versions": ["2"]}]}]}'
            ),
            '',
            1,
            'a 1: CVE-1; fixed in 2',
        ),
        (
            '{"dependencies": [{"name": "a", "skip_reason": "no such package"}]}',
            '',
            2,
            'a: not checked: no such package',
        ),
        ('', 'no network', 2, 'advisories were not checked: no network'),
    ],
)
def test_advisories_say_what_was_found_and_when_it_could_not_be_done(
    notices, monkeypatch, output, errors, status, said
):
    answer = SimpleNamespace(stdout=output, stderr=errors)
    monkeypatch.setattr(subprocess, 'run', lambda *words, **more: answer)
    found, lines = notices.advisories()
    assert found == status and any(said in line for line in lines)
