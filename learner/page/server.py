"""Serves the live page, and the metrics that it shows, over HTTP; nothing can be changed by it."""

import json
import mimetypes
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs
from wsgiref.simple_server import WSGIRequestHandler, make_server

from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.exposition import ThreadingWSGIServer

from a2s.learner.page.history import EVERY_S, History
from a2s.protocol.serving import family_of, not_served

_STATIC = files("a2s.learner.page") / "static"
_PAGE = "index.html"
_POLICY = "default-src 'self'; img-src data:; style-src 'self' 'unsafe-inline'"
_ROOTS = {"", "/"}
_IDLE_S = 30.0

StartResponse = Callable[[str, list[tuple[str, str]]], Any]


class Server:
    """A server of the page at ``/`` and, with a ``registry``, of ``/metrics``.

    ``option`` is the one that names the port. Who says nothing for ``idle_s`` seconds is cut off.

    Attributes:
        port: Where it listens; a free port when 0 was wanted.

    Raises:
        UsageError: The port is taken, or the host is not this machine.
    """

    def __init__(
        self,
        histories: Sequence[History],
        host: str,
        port: int,
        option: str,
        registry: CollectorRegistry | None = None,
        idle_s: float = _IDLE_S,
    ) -> None:
        self._histories = histories
        self._metrics = None if registry is None else make_wsgi_app(registry)
        self._static = {
            f"/{file.name}": file.read_bytes() for file in _STATIC.iterdir() if file.is_file()
        }

        class Handler(_Silent):
            timeout = idle_s

        try:
            host.encode("idna")  # else bind may raise anything

            class Listening(ThreadingWSGIServer):
                address_family = family_of(host, port)

            self._server = make_server(host, port, self._answer, Listening, Handler)
        except (OSError, UnicodeError) as error:
            raise not_served(host, port, option, error) from None
        self.port = int(self._server.server_port)
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def _answer(self, environ: dict[str, Any], start: StartResponse) -> Iterable[bytes]:
        path = environ.get("PATH_INFO", "")
        if environ.get("REQUEST_METHOD") not in ("GET", "HEAD"):
            start("405 Method Not Allowed", [("Allow", "GET, HEAD")])
            return []
        if path == "/metrics" and self._metrics is not None:
            return self._metrics(environ, start)  # type: ignore[no-any-return]
        if path == "/data":
            since = parse_qs(environ.get("QUERY_STRING", "")).get("since", [""])[0]
            return _send(start, "application/json", self._data(since))
        path = f"/{_PAGE}" if path in _ROOTS else path
        if path not in self._static:
            start("404 Not Found", [("Content-Type", "text/plain; charset=utf-8")])
            return [b"nothing here; the page is at /\n"]
        kind = mimetypes.guess_type(path)[0] or "text/plain"
        return _send(start, kind, self._static[path])

    def _data(self, since: str) -> bytes:
        """Tell what is new since the latest sample of each run: seconds, one number a run."""
        known = [_number(text) for text in since.split(",")]
        known += [0.0] * len(self._histories)
        runs = [
            {
                "about": history.about,
                "place": history.place,
                "up": history.is_up,
                **history.since(since_s),
            }
            for history, since_s in zip(self._histories, known, strict=False)
        ]
        return json.dumps({"now": time.time(), "runs": runs}).encode()


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 0.0


class Sampler:
    """Takes a run's metrics every two seconds, until closed."""

    def __init__(self, take: Callable[[], None]) -> None:
        self._take, self._closed = take, threading.Event()
        self._thread = threading.Thread(target=self._run, name="sampler", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Take no more."""
        self._closed.set()
        self._thread.join()

    def _run(self) -> None:
        while True:
            self._take()
            if self._closed.wait(EVERY_S):
                return


class _Silent(WSGIRequestHandler):
    def handle(self) -> None:
        """Answer, unless the peer has become silent or left."""
        with suppress(OSError):
            super().handle()

    def log_message(self, *_: object) -> None:
        """Requests are no news."""


def _send(start: StartResponse, kind: str, body: bytes) -> list[bytes]:
    text = kind.startswith("text/") or kind.endswith(("javascript", "json"))
    start(
        "200 OK",
        [
            ("Content-Type", f"{kind}; charset=utf-8" if text else kind),
            ("Content-Length", str(len(body))),
            ("Cache-Control", "no-store"),
            ("Content-Security-Policy", _POLICY),
        ],
    )
    return [body]
