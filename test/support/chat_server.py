"""A chat completions server for tests: real HTTP over a socket, answers from a script."""

from __future__ import annotations

from collections.abc import Callable
from email.message import Message
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
import json
import threading
import time
from typing import Any

#: status, headers, body
Reply = tuple[int, dict[str, str], bytes]
#: does the sending itself
Sender = Callable[[BaseHTTPRequestHandler], None]


class ChatServer:
    """Sends the scripted replies in order, the last one again and again.

    A reply is a `Reply`, a `Sender`, or what `knows_only` returns.

    Attributes:
        requests: the JSON bodies that came, in order.
        headers: the headers that came with them.
        times: when they came [s].
    """

    def __init__(self, *replies: Any) -> None:
        self.replies = replies
        self.requests: list[dict[str, Any]] = []
        self.headers: list[Message] = []
        self.times: list[float] = []
        self._server = ThreadingHTTPServer(('127.0.0.1', 0), self._handler())
        self._server.daemon_threads = True
        self.base_url = f'http://127.0.0.1:{self._server.server_port}/v1'

    def __enter__(self) -> ChatServer:
        threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        script = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = 'HTTP/1.1'

            def do_POST(self) -> None:
                body = json.loads(self.rfile.read(int(self.headers['Content-Length'])))
                if self.path != '/v1/chat/completions':
                    send(self, error(404, f'no such path: {self.path}'))
                    return
                script.times.append(time.monotonic())
                script.headers.append(self.headers)
                script.requests.append(body)
                reply = script.replies[min(len(script.requests), len(script.replies)) - 1]
                if getattr(reply, 'wants_request', False):
                    reply = reply(body)
                if callable(reply):
                    reply(self)
                else:
                    send(self, reply)

            def log_message(self, format: str, *args: Any) -> None:
                pass

        return Handler


def send(handler: BaseHTTPRequestHandler, reply: Reply) -> None:
    status, headers, body = reply
    handler.send_response(status)
    for name, value in {'Content-Type': 'application/json', **headers}.items():
        handler.send_header(name, value)
    handler.send_header('Content-Length', str(len(body)))
    handler.end_headers()
    handler.wfile.write(body)


def completion(content: str | None, *, finish_reason: str = 'stop', **message: Any) -> Reply:
    """What a server sends with status 200; form as in OpenAI's API reference."""
    choice = {
        'index': 0,
        'message': {'role': 'assistant', 'content': content, **message},
        'finish_reason': finish_reason,
    }
    body = {
        'id': 'chatcmpl-1',
        'object': 'chat.completion',
        'created': 1_700_000_000,
        'model': 'test-vlm',
        'choices': [choice],
        'usage': {'prompt_tokens': 1, 'completion_tokens': 1, 'total_tokens': 2},
    }
    return 200, {}, json.dumps(body).encode()


def error(status: int, message: str, *, code: str | None = None, **headers: str) -> Reply:
    """What a server sends when it fails."""
    body = {'error': {'message': message, 'type': 'test', 'param': None, 'code': code}}
    named = {name.replace('_', '-'): value for name, value in headers.items()}
    return status, named, json.dumps(body).encode()


def knows_only(*formats: str | None, reply: Reply) -> Callable[[dict], Reply]:
    """Refuse requests whose `response_format` is of another type, as older servers do."""

    def choose(request: dict) -> Reply:
        wanted = request.get('response_format', {}).get('type')
        if wanted in formats:
            return reply
        return error(400, f"response_format.type '{wanted}' is not supported")

    choose.wants_request = True
    return choose


def after(seconds: float, reply: Reply) -> Sender:
    """Send nothing for a while."""

    def late(handler: BaseHTTPRequestHandler) -> None:
        time.sleep(seconds)
        _unless_gone(lambda: send(handler, reply))

    return late


def dribble(seconds: float, reply: Reply) -> Sender:
    """Send blanks for a while, to keep the connection alive, and then the answer."""

    def slowly(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(200)
        handler.send_header('Content-Type', 'application/json')
        handler.send_header('Connection', 'close')
        handler.end_headers()
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if not _unless_gone(lambda: handler.wfile.write(b'\n')):
                return
            time.sleep(0.02)
        _unless_gone(lambda: handler.wfile.write(reply[2]))
        handler.close_connection = True

    return slowly


def break_off(handler: BaseHTTPRequestHandler) -> None:
    """Announce more than it sends."""
    handler.send_response(200)
    handler.send_header('Content-Type', 'application/json')
    handler.send_header('Content-Length', '1000')
    handler.end_headers()
    handler.wfile.write(b'{"choices": ')
    handler.close_connection = True


def _unless_gone(action: Callable[[], object]) -> bool:
    try:
        action()
    except OSError:  # the client gave up, as it should
        return False
    return True
