"""The describer against a server that truly speaks the protocol; see chat_server.py."""

from __future__ import annotations

import base64
from datetime import datetime, timedelta, UTC
from email.utils import format_datetime
import json
import pickle
import socket
import time

import cv2
import numpy as np
import pytest

from mtv_world_ros.core.errors import ConfigError, DescriptionError
from mtv_world_ros.vision.describers.describer import DescribedObject
from mtv_world_ros.vision.describers.openai_chat import OpenAIChat, OpenAIConfig, retry_after
from mtv_world_ros.vision.describers.vlm import DescriptionCache, VlmDescriber
from test.support.chat_server import (
    after,
    break_off,
    ChatServer,
    completion,
    dribble,
    error,
    knows_only,
)

pytest.importorskip('openai')

FRAME = np.random.default_rng(0).integers(0, 256, (18, 24, 3), np.uint8)
INSTRUCTION = 'put the red block into the bowl'
KEY = 'sk-secret-1234'
BLOCK = {
    'id': 'red_block',
    'name': 'red block',
    'colour': 'red',
    'category': 'block',
    'role': 'manipuland',
    'box': [100, 200.5, 300, 400],
}
BOWL = {
    'id': 'bowl',
    'name': 'bowl',
    'colour': None,
    'category': 'bowl',
    'role': 'container',
    'box': None,
}
GOOD = completion(json.dumps({'objects': [BLOCK, BOWL]}))
WITHOUT_ROLE = completion(
    json.dumps({'objects': [{key: BLOCK[key] for key in BLOCK if key != 'role'}]})
)


@pytest.fixture(autouse=True)
def environment(monkeypatch):
    monkeypatch.setenv('TEST_VLM_KEY', KEY)
    monkeypatch.setenv('NO_PROXY', '127.0.0.1')


def describer(server, cache=None, **options) -> VlmDescriber:
    values = {
        'model': 'test-vlm',
        'base_url': server if isinstance(server, str) else server.base_url,
        'key_variable': 'TEST_VLM_KEY',
        'timeout_s': 30.0,
        'retry_budget_s': 5.0,
        'first_wait_s': 0.02,
    }
    chat = OpenAIChat(OpenAIConfig(**{**values, **options}))
    return VlmDescriber(chat, None if cache is None else DescriptionCache(cache))


def describe(server, **options) -> tuple[DescribedObject, ...]:
    return describer(server, **options).describe(FRAME, INSTRUCTION)


def failure(server, **options) -> DescriptionError:
    with pytest.raises(DescriptionError) as caught:
        describe(server, **options)
    return caught.value


def formats(server) -> list[str | None]:
    return [request.get('response_format', {}).get('type') for request in server.requests]


def test_a_good_answer_becomes_objects():
    with ChatServer(GOOD) as server:
        found = describe(server)
    assert found == (
        DescribedObject(
            id='red_block',
            name='red block',
            colour='red',
            category='block',
            role='manipuland',
            box=(100.0, 200.5, 300.0, 400.0),
        ),
        DescribedObject(id='bowl', name='bowl', category='bowl', role='container'),
    )


def test_the_request_shows_the_exact_frame_and_asks_for_the_schema_at_temperature_0():
    with ChatServer(GOOD) as server:
        describe(server)
    (request,) = server.requests
    assert (request['model'], request['temperature']) == ('test-vlm', 0)
    assert server.headers[0]['Authorization'] == f'Bearer {KEY}'
    (message,) = request['messages']
    image, text = message['content']
    assert INSTRUCTION in text['text']
    kind, _, data = image['image_url']['url'].partition(',')
    assert kind == 'data:image/png;base64'
    png = np.frombuffer(base64.b64decode(data), np.uint8)
    shown = cv2.imdecode(png, cv2.IMREAD_COLOR)
    assert shown is not None
    np.testing.assert_array_equal(shown[..., ::-1], FRAME)
    assert request['response_format']['json_schema']['strict'] is True


def test_the_schema_keeps_to_what_strict_servers_accept():
    """Every object closed and every key required: OpenAI's guide to structured outputs."""
    with ChatServer(GOOD) as server:
        describe(server)
    stack = [server.requests[0]['response_format']['json_schema']['schema']]
    num_objects = 0
    while stack:
        part = stack.pop()
        if part['type'] == 'object':
            num_objects += 1
            assert part['additionalProperties'] is False
            assert sorted(part['required']) == sorted(part['properties'])
            stack += part['properties'].values()
        elif 'items' in part:
            stack.append(part['items'])
    assert num_objects == 2


def test_no_objects_is_an_answer():
    with ChatServer(completion('{"objects": []}')) as server:
        assert describe(server) == ()
    assert len(server.requests) == 1


@pytest.mark.parametrize(
    'text',
    [
        'Here you are:\n```json\n%s\n```\nAnything else?',
        '<think>{"objects": "the bowl?"} no.</think>\n%s',
    ],
)
def test_text_around_the_json_does_no_harm(text):
    with ChatServer(completion(text % json.dumps({'objects': [BOWL]}))) as server:
        assert [item.name for item in describe(server)] == ['bowl']


@pytest.mark.parametrize(
    ('known', 'asked'),
    [
        (('json_schema', None), ['json_schema']),
        (('json_object', None), ['json_schema', 'json_object']),
        ((None,), ['json_schema', 'json_object', None]),
    ],
)
def test_a_server_that_refuses_a_format_is_asked_with_the_next_and_it_is_remembered(known, asked):
    with ChatServer(knows_only(*known, reply=GOOD)) as server:
        asking = describer(server)
        assert len(asking.describe(FRAME, INSTRUCTION)) == 2
        assert formats(server) == asked
        asking.describe(FRAME, 'another instruction')
        assert formats(server) == [*asked, asked[-1]]


def test_a_bad_request_that_is_not_about_the_format_is_reported():
    with ChatServer(error(400, 'this model takes no images')) as server:
        failed = failure(server)
    assert failed.status == 'rejected'
    assert 'this model takes no images' in str(failed)


@pytest.mark.parametrize(
    ('reply', 'status', 'words'),
    [
        (completion(None, refusal='I cannot help with that.'), 'refused', 'cannot help'),
        (completion('', finish_reason='content_filter'), 'refused', 'content filter'),
        (error(401, f'wrong key {KEY}'), 'rejected', "check the key in 'TEST_VLM_KEY'"),
        (error(404, "model 'test-vlm' not found"), 'rejected', "'model' and 'base_url'"),
        ((200, {'Content-Type': 'text/html'}, b'<html>login</html>'), 'invalid', 'base_url'),
        ((200, {}, b'{"choices": []}'), 'invalid', 'no chat completion'),
        ((200, {}, b'{"choices": [{"message": {"content": 3}}]}'), 'invalid', 'its content is 3'),
        (break_off, 'unreachable', 'broke off'),
    ],
)
def test_what_cannot_become_better_is_not_asked_again(reply, status, words):
    with ChatServer(reply) as server:
        failed = failure(server)
    assert failed.status == status
    assert words in str(failed)
    assert KEY not in str(failed)
    assert len(server.requests) == 1


def test_the_wait_that_a_rate_limit_names_is_honoured():
    with ChatServer(error(429, 'slow down', Retry_After='0.3'), GOOD) as server:
        assert len(describe(server)) == 2
    first, second = server.times
    assert second - first >= 0.3


def test_a_server_that_says_at_once_is_not_flooded():
    with ChatServer(error(429, 'again', Retry_After='0')) as server:
        failure(server, retry_budget_s=0.3, first_wait_s=0.1)
    assert len(server.requests) <= 4


def test_a_wait_beyond_the_budget_is_not_begun():
    with ChatServer(error(429, 'slow down', Retry_After='3600'), GOOD) as server:
        failed = failure(server)
    assert (failed.status, len(server.requests)) == ('rate_limited', 1)
    assert "'retry_budget_s' (5 s)" in str(failed)


def test_an_account_without_credit_is_not_asked_again():
    with ChatServer(error(429, 'buy more', code='insufficient_quota')) as server:
        assert failure(server).status == 'rate_limited'
    assert len(server.requests) == 1


def test_server_errors_are_retried_with_growing_waits_until_the_budget_ends():
    with ChatServer(error(503, 'overloaded')) as server:
        failed = failure(server, retry_budget_s=1.0, first_wait_s=0.05)
    assert failed.status == 'server_error'
    assert 'overloaded' in str(failed)
    # after 0.05 + 0.1 + 0.2 + 0.4 s another 0.8 s are too many
    assert 2 <= len(server.requests) <= 5
    waits = np.diff(server.times)
    assert np.all(waits >= 0.05 * 2 ** np.arange(len(waits)))


def test_a_server_that_recovers_is_waited_for():
    with ChatServer(error(500, 'oops'), error(502, 'oops'), GOOD) as server:
        assert len(describe(server)) == 2
    assert len(server.requests) == 3


@pytest.mark.parametrize('late', [after, dribble])
def test_a_slow_answer_is_a_timeout(late):
    with ChatServer(late(20, GOOD)) as server:
        began = time.monotonic()
        failed = failure(server, timeout_s=0.3)
        assert time.monotonic() - began < 10
    assert failed.status == 'timeout'
    assert "'timeout_s'" in str(failed)
    assert len(server.requests) == 1


def test_blanks_before_an_answer_in_time_do_no_harm():
    with ChatServer(dribble(0.1, GOOD)) as server:
        assert len(describe(server)) == 2


def test_a_server_that_is_not_there_is_unreachable():
    with socket.socket() as free:
        free.bind(('127.0.0.1', 0))
        url = f'http://127.0.0.1:{free.getsockname()[1]}/v1'
        failed = failure(url)
    assert failed.status == 'unreachable'
    assert url in str(failed)


def test_a_url_without_its_scheme_says_so():
    failed = failure('localhost:11434/v1')
    assert failed.status == 'unreachable'
    assert 'base_url' in str(failed)


def test_a_broken_answer_is_repaired_by_quoting_what_was_wrong():
    with ChatServer(WITHOUT_ROLE, GOOD) as server:
        assert len(describe(server)) == 2
    question, answer, repair = server.requests[1]['messages']
    assert question == server.requests[0]['messages'][0]
    assert answer['role'] == 'assistant' and 'red block' in answer['content']
    assert repair['role'] == 'user' and "'role' is missing" in repair['content']


def test_an_answer_that_is_broken_twice_is_an_error_that_says_both():
    with ChatServer(completion('{"objects": ['), WITHOUT_ROLE) as server:
        failed = failure(server)
    assert failed.status == 'invalid'
    assert 'it is not JSON' in str(failed) and "'role' is missing" in str(failed)
    assert 'kind: list' in str(failed)
    assert len(server.requests) == 2


def test_a_cut_off_answer_says_so():
    with ChatServer(completion('{"objects": [{"id"', finish_reason='length')) as server:
        assert 'cut off at the token limit' in str(failure(server))


def test_what_is_in_the_cache_is_not_asked_for(tmp_path):
    with ChatServer(GOOD) as server:
        first = describe(server, cache=tmp_path)
        assert describe(server, cache=tmp_path) == first
        assert len(server.requests) == 1
        (file,) = tmp_path.iterdir()
        assert json.loads(file.read_text())['model'] == f'test-vlm at {server.base_url}'
        for changed in (
            lambda d: d.describe(FRAME[::-1], INSTRUCTION),
            lambda d: d.describe(FRAME.reshape(24, 18, 3), INSTRUCTION),
            lambda d: d.describe(FRAME, 'another instruction'),
        ):
            num_requests = len(server.requests)
            changed(describer(server, cache=tmp_path))
            assert len(server.requests) == num_requests + 1
        describe(server, cache=tmp_path, model='another-vlm')
        assert len(server.requests) == 5


def test_a_new_prompt_does_not_take_old_answers(tmp_path, monkeypatch):
    with ChatServer(GOOD) as server:
        describe(server, cache=tmp_path)
        monkeypatch.setattr('mtv_world_ros.vision.describers.vlm.PROMPT_VERSION', 'next')
        describe(server, cache=tmp_path)
    assert len(server.requests) == 2


def test_a_scene_without_objects_is_cached_and_a_failure_is_not(tmp_path):
    with ChatServer(error(401, 'no'), completion('{"objects": []}')) as server:
        assert failure(server, cache=tmp_path).status == 'rejected'
        assert not list(tmp_path.iterdir())
        assert describe(server, cache=tmp_path) == describe(server, cache=tmp_path) == ()
    assert len(server.requests) == 2


@pytest.mark.parametrize('damaged', [b'', b'{"objects": [{"name"', b'{"objects": 3}', b'\xff\xfe'])
def test_a_damaged_cache_file_is_replaced(tmp_path, damaged):
    with ChatServer(GOOD) as server:
        first = describe(server, cache=tmp_path)
        (file,) = tmp_path.iterdir()
        file.write_bytes(damaged)
        assert describe(server, cache=tmp_path) == first
        assert describe(server, cache=tmp_path) == first
    assert len(server.requests) == 2
    assert list(tmp_path.iterdir()) == [file]


def test_a_cache_folder_that_cannot_be_written_to_is_named(tmp_path):
    (tmp_path / 'file').touch()
    with ChatServer(GOOD) as server, pytest.raises(ConfigError, match="'cache' folder"):
        describe(server, cache=tmp_path / 'file' / 'cache')


def test_a_missing_key_names_the_environment_variable(monkeypatch):
    monkeypatch.delenv('TEST_VLM_KEY')
    with pytest.raises(ConfigError, match="'TEST_VLM_KEY' is not set"):
        describer('http://127.0.0.1:1/v1')


def test_a_server_that_needs_no_key_is_sent_none_of_the_users(monkeypatch):
    monkeypatch.setenv('OPENAI_API_KEY', KEY)
    with ChatServer(GOOD) as server:
        describe(server, key_variable='')
    assert KEY not in str(server.headers[0])


def test_retry_after_is_read_as_seconds_or_date():
    soon = datetime.now(UTC) + timedelta(seconds=100)
    assert retry_after({'retry-after': '7'}) == 7
    found = retry_after({'retry-after': format_datetime(soon, usegmt=True)})
    assert found == pytest.approx(100, abs=5)
    assert retry_after({'retry-after': 'Fri, 31 Dec 1999 23:59:59 GMT'}) == 0
    assert retry_after({'retry-after': '-3'}) == 0
    for nonsense in ('soon', 'nan', 'inf', ''):
        assert retry_after({'retry-after': nonsense}) is None
    assert retry_after({}) is None


def test_the_status_survives_a_change_of_process():
    copy = pickle.loads(pickle.dumps(DescriptionError('gone', 'timeout')))  # noqa: S301
    assert (str(copy), copy.status) == ('gone', 'timeout')
