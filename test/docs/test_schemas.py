"""Tables of keys on the pages are complete: every key that a user may write is there."""

from pathlib import Path

from mtv_world_ros.simulation.collect.dataset_readme import KEYS

DOCS = Path(__file__).resolve().parents[2] / 'docs'


def test_every_key_of_an_episodes_metadata_is_on_its_page():
    text = (DOCS / 'episodes.md').read_text()
    assert not {key for key in KEYS if f'`{key}`' not in text}
