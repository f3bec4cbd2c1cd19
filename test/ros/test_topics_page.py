"""docs/topics.md lists what running nodes offer."""

from __future__ import annotations

from pathlib import Path

from test.support.fake_policy import load as load_policy
from test.support.fake_world_model import load as load_model
from test.support.pages import generator
from test.support.ros_nodes import ENVIRONMENT  # the domain of this process

ROOT = Path(__file__).resolve().parents[2]


def test_the_reference_of_topics_is_what_the_running_nodes_offer():
    assert ENVIRONMENT['ROS_DOMAIN_ID']
    written = (ROOT / 'docs' / 'topics.md').read_text()
    running = generator('topics_page').page(load_model, load_policy)
    assert running == written, 'write it again: python docs/topics_page.py'
