"""A small web server for one live page: the page, its scene, a stream of frames, and controls."""

from __future__ import annotations

import contextlib
import errno
import json
import socket
import threading
from collections.abc import Iterator
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from twirl_mjx.view.page import live_page
from twirl_mjx.view.stage import Stage, play

PORT = 8900
"""Tried first; a free one is taken where it is in use."""
LONGEST_REQUEST = 10_000
"""Bytes of what a page may ask for."""
PATIENCE_S = 5.0
"""s without a new frame, after which a stream says that it is alive."""


class _Frames:
    """The newest frame, and those who wait for it."""

    def __init__(self) -> None:
        self._ready = threading.Condition()
        self._text, self._number = "", 0

    def put(self, frame: dict[str, Any]) -> None:
        with self._ready:
            self._text, self._number = json.dumps(frame, separators=(",", ":")), self._number + 1
            self._ready.notify_all()

    def after(self, number: int) -> tuple[str, int]:
        """Return the newest frame and its number, once that is not ``number`` any more."""
        with self._ready:
            self._ready.wait_for(lambda: self._number != number, PATIENCE_S)
            return self._text, self._number


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, address: tuple[str, int], stage: Stage, title: str) -> None:
        self.stage, self.title, self.frames = stage, title, _Frames()
        super().__init__(address, _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing: a page that is closed breaks its connection."""
        del request, client_address


class _Handler(BaseHTTPRequestHandler):
    server: _Server  # pyright: ignore[reportIncompatibleVariableOverride]

    def log_message(self, format: str, *args: Any) -> None:
        """Write no line for every request."""
        del format, args

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        if not self._is_ours():
            return
        if path == "/":
            self._answer(HTTPStatus.OK, "text/html; charset=utf-8", live_page(self.server.title))
        elif path == "/scene":
            scene = json.dumps(self.server.stage.scene())
            self._answer(HTTPStatus.OK, "application/json", scene)
        elif path == "/events":
            self._stream()
        else:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", f"no page {path}")

    def do_POST(self) -> None:
        if not self._is_ours():
            return
        length = self.headers.get("Content-Length", "")
        is_json = self.headers.get("Content-Type", "").startswith("application/json")
        if not is_json or not length.isdecimal() or int(length) > LONGEST_REQUEST:
            self._answer(HTTPStatus.BAD_REQUEST, "text/plain", "expected a short JSON text")
            return
        try:
            asked = json.loads(self.rfile.read(int(length)))
            self.server.stage.do(asked["name"], asked.get("value"))
        except (ValueError, KeyError, TypeError, AttributeError, OSError) as error:
            self._answer(HTTPStatus.BAD_REQUEST, "text/plain; charset=utf-8", str(error))
        else:
            self._answer(HTTPStatus.OK, "text/plain", "done")

    def _is_ours(self) -> bool:
        """Refuse what another site's page asks for under a name that leads here."""
        origin = self.headers.get("Origin")
        if origin is None or origin.partition("://")[2] == self.headers.get("Host"):
            return True
        self._answer(HTTPStatus.FORBIDDEN, "text/plain", "only its own page may ask")
        return False

    def _answer(self, status: HTTPStatus, kind: str, text: str) -> None:
        content = text.encode()
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(content)

    def _stream(self) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "text/event-stream")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        number = 0
        with contextlib.suppress(OSError):  # the page is closed
            while True:
                text, new = self.server.frames.after(number)
                event = f"data: {text}\n\n" if new != number else ": still here\n\n"
                number = new
                self.wfile.write(event.encode())
                self.wfile.flush()


@contextlib.contextmanager
def serving(
    stage: Stage, title: str, *, host: str = "127.0.0.1", port: int | None = None
) -> Iterator[str]:
    """Play a stage for whoever opens the page.

    Args:
        stage: what moves.
        title: heading of the page.
        host: name or address of this machine to listen at.
        port: 0 for any free one; ``PORT``, or a free one where that is in use, by default.

    Yields:
        The address of the page.

    Raises:
        ValueError: The host is none of this machine, or the port is in use.
    """
    server = _bind(stage, title, host, port)
    stop = threading.Event()
    threads = [
        threading.Thread(target=play, args=(stage, server.frames.put, stop), daemon=True),
        threading.Thread(target=server.serve_forever, args=(0.1,), daemon=True),
    ]
    for thread in threads:
        thread.start()
    try:
        yield f"http://{host}:{server.server_port}/"
    finally:
        stop.set()
        server.shutdown()
        for thread in threads:
            thread.join()
        server.server_close()


def _bind(stage: Stage, title: str, host: str, port: int | None) -> _Server:
    try:
        return _Server((host, PORT if port is None else port), stage, title)
    except socket.gaierror as error:
        raise ValueError(f"--host {host}: {error.strerror} (nearest: 127.0.0.1)") from None
    except OSError as error:
        if error.errno == errno.EADDRINUSE and port is None:
            return _bind(stage, title, host, 0)
        reason = error.strerror or str(error)
        nearest = "--host 127.0.0.1" if error.errno == errno.EADDRNOTAVAIL else "--port 0"
        raise ValueError(f"cannot listen at {host}:{port}: {reason} (nearest: {nearest})") from None
