"""The node asks a vision-language model over HTTP which objects there are."""

import base64
import json

import cv2
import numpy as np
import pytest
from sensor_msgs.msg import Image
from std_msgs.msg import String

from mtv_world_ros.ros.messages.image_messages import to_rgb
from test.support.chat_server import ChatServer, completion, error

pytest.importorskip('openai')

MASK = '/world_model/low/mask/image_raw'
BLUE = {
    'id': 'blue', 'name': 'blue block', 'colour': 'blue', 'category': 'block',
    'role': 'manipuland', 'box': None,
}  # fmt: skip
ANSWER = completion(json.dumps({'objects': [BLUE]}))


def configure(folder, server):
    file = folder / 'describer.yaml'
    file.write_text(
        f"kind: openai\nopenai: {{base_url: '{server.base_url}', model: test-vlm, "
        "key_variable: '', timeout_s: 10, retry_budget_s: 1}\n"
    )
    return f'describer:={file}'


def test_objects_that_the_model_names_are_found_and_reported(start, ros, tmp_path, monkeypatch):
    monkeypatch.setitem(ros.ENVIRONMENT, 'NO_PROXY', '127.0.0.1')
    client = ros.Client()
    with ChatServer(ANSWER, error(401, 'no')) as server:
        node = start(configure(tmp_path, server))
        client.connect_outputs({MASK: Image})
        client.connect_inputs(ros.INPUTS)
        client.publish('/instruction', String(data='tidy up'))
        client.wait_until_told(node, instruction='tidy up')
        assert client.imagine_one()['state'] == 'done'
        client.wait(lambda: len(client.received[MASK]) == ros.NUM_FRAMES, 'masks')
        (chunk,) = client.report_values('chunk')
        labels = to_rgb(client.received[MASK][0])
        client.publish('/instruction', String(data='tidy up at last'))
        client.wait_until_told(node, instruction='tidy up at last')
        ended = client.imagine_one()
    client.close()
    text, picture = asked(server.requests[0])
    assert 'tidy up' in text
    np.testing.assert_array_equal(picture, ros.make_pixels('low'))  # as it was seen
    assert chunk['mask_status.low.blue_block'] == 'ok'
    assert 'mask_status.low.red_block' not in chunk
    assert np.unique(labels).tolist() == [0, 1]
    assert len(server.requests) == 2
    # a model that does not answer is an error of that plan, the node goes on
    assert ended['state'] == 'rejected' and 'status 401' in ended['text'], ended


def asked(request):
    """Words and picture of a request."""
    image, text = request['messages'][0]['content']
    png = np.frombuffer(base64.b64decode(image['image_url']['url'].partition(',')[2]), np.uint8)
    picture = cv2.imdecode(png, cv2.IMREAD_COLOR)
    assert picture is not None
    return text['text'], picture[..., ::-1]
