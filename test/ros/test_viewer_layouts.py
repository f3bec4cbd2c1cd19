"""Foxglove layouts and the RViz configuration show topics that are there, with their types."""

import json
import re

import pytest
import yaml

from mtv_world_ros.core.files import share_path

FOLDER = share_path('config', 'viewers')
FILES = ('foxglove_live.json', 'foxglove_recording.json', 'world_model.rviz')
TYPES = {
    'imageTopic': ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'),
    'calibrationTopic': ('sensor_msgs/msg/CameraInfo',),
}
#: what docs/viewing.md tells to do for a namespace
SED = re.compile(r'([" ])/(world_model|low|high|robot_description)')


def panels(layout):
    if isinstance(layout, str):
        return [layout]
    assert layout['direction'] in ('row', 'column')
    return panels(layout['first']) + panels(layout['second'])


def shown(text, name):
    """Topics that a layout shows, each with the types that fit."""
    if name.endswith('.rviz'):
        found = []
        for display in yaml.safe_load(text)['Visualization Manager']['Displays']:
            for key in ('Topic', 'Description Topic'):
                if key in display:
                    kinds = TYPES['imageTopic'][:1] if key == 'Topic' else ('std_msgs/msg/String',)
                    found.append((display[key]['Value'], kinds))
        return found
    layout = json.loads(text)
    assert sorted(panels(layout['layout'])) == sorted(layout['configById'])
    found = [
        (topic, TYPES[key])
        for panel in layout['configById'].values()
        for key, topic in panel.get('imageMode', {}).items()
    ]
    for panel in layout['configById'].values():
        found += [(topic, TYPES['calibrationTopic']) for topic in panel.get('topics', ())]
        for layer in panel.get('layers', {}).values():
            found.append((layer['topic'], ('std_msgs/msg/String',)))
        paths = [path['value'] for path in panel.get('paths', ())]
        paths += [panel[key] for key in ('topicPath', 'topicToRender') if key in panel]
        found += [(path.split('.')[0], None) for path in paths]
    return found


def check(found, topics):
    for topic, kinds in found:
        assert topic in topics, (topic, sorted(topics))
        if kinds is not None:
            assert set(kinds) & set(topics[topic]), topic
        if topic.endswith('/compressed'):
            assert 'sensor_msgs/msg/CompressedImage' in topics[topic]


@pytest.mark.parametrize('namespace', ['', '/robot1'])
def test_live_layouts_show_topics_of_a_running_node(namespace, tmp_path, ros):
    client = ros.Client()
    rules = (f'__ns:={namespace}',) if namespace else ()
    process = ros.start_node(tmp_path, remaps=rules)
    try:
        graph = {}

        def is_complete():
            graph.update(dict(client.node.get_topic_names_and_types()))
            return f'{namespace}/world_model/success' in graph

        client.wait(is_complete, "the node's topics", timeout_s=180.0)
        client.spin_for(0.5)
        graph.update(dict(client.node.get_topic_names_and_types()))
    finally:
        process.stop()
        client.close()
    for name in ('foxglove_live.json', 'world_model.rviz'):
        text = (FOLDER / name).read_text()
        found = shown(SED.sub(rf'\1{namespace}/\2', text), name)
        assert len(found) > 8
        check(found, graph)


def test_every_file_is_named_in_the_page_and_none_else_is_there():
    page = share_path('docs', 'viewing.md').read_text()
    assert sorted(path.name for path in FOLDER.iterdir()) == sorted(FILES)
    assert all(name in page for name in FILES)
    assert SED.pattern in page


def test_images_of_the_bundled_episode_and_of_recordings_are_compressed():
    found = shown((FOLDER / 'foxglove_recording.json').read_text(), 'foxglove_recording.json')
    images = [topic for topic, kinds in found if kinds == TYPES['imageTopic']]
    assert len(images) == 6 and all(topic.endswith('/image_raw/compressed') for topic in images)
