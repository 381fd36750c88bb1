"""The live page over HTTP, from the standard library's server, to this machine only.

`GET /` is the page, `GET /picture?after=N` waits for the first picture after number N,
and `POST /do` takes a command in JSON.
"""

from __future__ import annotations

import json
import sys
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Protocol
from urllib.parse import parse_qs, urlsplit

HOST = "127.0.0.1"
_NAMES = (HOST, "localhost")
_LONGEST = 65536  # [bytes]
_PATIENCE = 1.0
"""Longest wait for a new picture, after which there is an empty answer [s]."""


class Served(Protocol):
    """A simulation, as the server shows it."""

    @property
    def ended(self) -> bool:
        """Whether there will be no more pictures."""

    def page(self) -> str:
        """The page."""

    def picture(self, after: int, patience: float) -> bytes:
        """The first picture after number `after`; empty if there is none in time."""

    def do(self, command: Any) -> int:
        """Takes a command; returns its number. Raises a ValueError if it is none."""


class _Threads(ThreadingHTTPServer):
    """A server with one thread per connection, silent about those that break off."""

    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Reports an error, unless the browser has only closed its connection."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class Server:
    """A server in threads of this process; `url` is its address."""

    def __init__(self, port: int) -> None:
        """Takes the port; browsers wait until `serve`.

        Raises:
            OSError: The port is taken.
        """

        class Handler(_Handler):
            pass

        self._handler = Handler
        self._thread: threading.Thread | None = None
        try:
            self._server = _Threads((HOST, port), Handler)
        except OSError as error:
            raise OSError(
                error.errno,
                f"no page at port {port} ({error.strerror}): port=0 takes one that is "
                "free",
            ) from error
        self.url = f"http://{HOST}:{self._server.server_address[1]}/"

    def serve(self, served: Served) -> None:
        """Starts to answer."""
        self._handler.shown = served
        # A short interval: closing waits for it.
        loop = lambda: self._server.serve_forever(poll_interval=0.05)
        self._thread = threading.Thread(target=loop, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stops serving, and frees the port."""
        if self._thread is not None:
            self._server.shutdown()
            self._thread.join()
        self._server.server_close()


class _Handler(BaseHTTPRequestHandler):
    """One connection of a browser."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    shown: Served

    def do_GET(self) -> None:
        """Answers with the page, or with a picture."""
        asked = urlsplit(self.path)
        if not self._allowed():
            return
        if asked.path == "/":
            self._answer(self.shown.page().encode(), "text/html; charset=utf-8")
        elif asked.path == "/picture":
            after = parse_qs(asked.query).get("after", [""])[0]
            number = _whole(after.removeprefix("-"))
            if number is None:
                self._refuse("after must be a number of a picture")
                return
            number = -number if after.startswith("-") else number
            picture = self.shown.picture(number, _PATIENCE)
            if self.shown.ended:
                self.close_connection = True
                self._refuse("the simulation has ended", HTTPStatus.GONE)
                return
            self._answer(picture, "application/octet-stream")
        else:
            self._refuse("there is no such page", HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        """Takes a command; answers with its number."""
        length = _whole(self.headers.get("Content-Length", ""))
        if length is None or length > _LONGEST:
            self.close_connection = True
            self._refuse(f"a command has at most {_LONGEST} bytes")
            return
        body = self.rfile.read(length)
        if not self._allowed():
            return
        # Browsers ask before they send this type from another site's page.
        if self.headers.get_content_type() != "application/json":
            self._refuse("a command must be application/json")
            return
        try:
            number = self.shown.do(json.loads(body))
        except RecursionError:
            self._refuse("a command is nested too deeply")
            return
        except ValueError as error:
            self._refuse(str(error))
            return
        except RuntimeError as error:
            self.close_connection = True
            self._refuse(str(error), HTTPStatus.GONE)
            return
        self._answer(json.dumps({"number": number}).encode(), "application/json")

    def _allowed(self) -> bool:
        """Whether the request is from this machine's own page; answers if not."""
        origin = self.headers.get("Origin")
        hosts = [_host("//" + self.headers.get("Host", ""))]
        hosts += [] if origin is None else [_host(origin)]
        if all(host in _NAMES for host in hosts):
            return True
        self._refuse("this page is for this machine only", HTTPStatus.FORBIDDEN)
        return False

    def _refuse(self, why: str, status: HTTPStatus = HTTPStatus.BAD_REQUEST) -> None:
        self._answer(why.encode(), "text/plain; charset=utf-8", status)

    def _answer(
        self, body: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK
    ) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Writes nothing."""


def _whole(text: str) -> int | None:
    """A number of at most 15 digits; `None` for any other text."""
    return int(text) if text.isdecimal() and len(text) <= 15 else None


def _host(address: str) -> str | None:
    """Host of an address, `None` if it has none."""
    try:
        return urlsplit(address).hostname
    except ValueError:
        return None
