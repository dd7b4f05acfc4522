"""``a2s dashboard``: the live page of several runs, from their ``/metrics``, wherever they are."""

import json
import socket
import time
import urllib.request
from collections.abc import Sequence
from contextlib import ExitStack, closing, suppress
from email.utils import parsedate_to_datetime
from functools import partial
from http.client import HTTPConnection, HTTPException, HTTPResponse, HTTPSConnection
from threading import Timer
from typing import Any
from urllib.parse import urlsplit, urlunsplit

import typer
from prometheus_client.parser import text_string_to_metric_families

from a2s.commands.process import LEARNER_METRICS_PORT, Stop, serve_on
from a2s.learner.page.history import History
from a2s.learner.page.server import Sampler, Server
from a2s.protocol.errors import UsageError
from a2s.protocol.serving import url_of

PORT = 9466
_TIMEOUT_S = 1.5  # without a byte
_TOTAL_S = 5.0
_SCHEMES = ("http", "https")
# What comes of the words of something else than a learner.
_STRANGE = (HTTPException, ValueError, LookupError, TypeError, AttributeError, RecursionError)


def show(targets: Sequence[str], host: str, port: int | None, stop: Stop) -> None:
    """Serve the page until stopped.

    A target is ``HOST:PORT`` of a learner's metrics, or the whole address; none: the usual one of
    this machine.

    Raises:
        UsageError: A target cannot be one, or the port is taken.
    """
    addresses = [address(target) for target in targets or [f"127.0.0.1:{LEARNER_METRICS_PORT}"]]
    with ExitStack() as stack:
        histories = [History(urlsplit(url).netloc) for url in addresses]
        for history, url in zip(histories, addresses, strict=True):
            recall(history, url)
            stack.enter_context(closing(Sampler(partial(scrape, history, url))))
        server = serve_on(port, PORT, lambda number: Server(histories, host, number, "--port"))
        stack.enter_context(closing(server))
        typer.echo(f"a2s dashboard: {url_of(host, server.port, '/')}")
        for url in addresses:
            typer.echo(f"  of          {url}")
        stop.wait()


def address(target: str) -> str:
    """Complete the address of a learner's metrics.

    Raises:
        UsageError: It has no host or port, or another scheme than HTTP.
    """
    whole = target if "://" in target else f"http://{target}"
    try:
        parts = urlsplit(whole)
        is_usable = parts.scheme in _SCHEMES and parts.hostname and (parts.port or "://" in target)
    except ValueError:  # the port is no number, or a bracket is missing
        is_usable = False
    if not is_usable or any(letter.isspace() for letter in target):
        raise UsageError(
            f"a2s dashboard: found {target!r}, expected HOST:PORT of a learner's metrics"
        )
    return urlunsplit(parts._replace(path=parts.path if len(parts.path) > 1 else "/metrics"))


def fetch(url: str, total_s: float = _TOTAL_S) -> tuple[bytes, float]:
    """Fetch what is there, within this time in all; and by how many seconds its clock is ahead.

    Raises:
        OSError: Nobody answers, or with an error.
        HTTPException: Something else answers, or it takes too long.
    """
    opener = urllib.request.build_opener(_Hurried(total_s))
    with opener.open(url, timeout=_TIMEOUT_S) as reply:
        said = reply.headers["Date"]
        ahead_s = parsedate_to_datetime(said).timestamp() - time.time() if said else 0.0
        return bytes(reply.read()), ahead_s


class _Watched(HTTPConnection):
    """Is cut off in the end: a peer may send a byte now and then for ever."""

    def __init__(self, *place: Any, total_s: float, **settings: Any) -> None:
        super().__init__(*place, **settings)
        self._total_s = total_s

    def connect(self) -> None:
        super().connect()
        watch = Timer(self._total_s, _cut, [self.sock])
        watch.daemon = True
        watch.start()


class _WatchedSecurely(_Watched, HTTPSConnection):
    """The same over TLS."""


class _Hurried(urllib.request.HTTPSHandler, urllib.request.HTTPHandler):
    def __init__(self, total_s: float) -> None:
        super().__init__()
        self._total_s = total_s

    def http_open(self, req: urllib.request.Request) -> HTTPResponse:
        return self.do_open(partial(_Watched, total_s=self._total_s), req)

    def https_open(self, req: urllib.request.Request) -> HTTPResponse:
        return self.do_open(partial(_WatchedSecurely, total_s=self._total_s), req)


def _cut(connection: socket.socket) -> None:
    with suppress(OSError):  # it has ended
        connection.shutdown(socket.SHUT_RDWR)


def scrape(history: History, url: str) -> None:
    """Take what the learner says now; nothing where it does not answer."""
    try:
        text, ahead_s = fetch(url)
        history.take(time.time(), text_string_to_metric_families(text.decode()), ahead_s)
    except (OSError, *_STRANGE):
        history.is_up = False


def recall(history: History, url: str) -> None:
    """Take over what the learner's own page remembers, if it has one."""
    data = url.removesuffix("metrics") + "data"
    try:
        told = json.loads(fetch(data)[0])
        (run,), ahead_s = told["runs"], told["now"] - time.time()  # its clock is another
        names = list(run["series"])
        past = []
        for now_s, *values in zip(run["t"], *run["series"].values(), strict=True):
            found = zip(names, values, strict=True)
            past.append((now_s - ahead_s, {n: float(v) for n, v in found if v is not None}))
    except (OSError, *_STRANGE):
        return  # it has none: the history begins now
    for then_s, samples in past:
        history.add(then_s, samples)
