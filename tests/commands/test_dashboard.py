"""``a2s dashboard``: targets as a user writes them, and learners that do not answer."""

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from email.utils import formatdate
from http.client import HTTPException
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest
from prometheus_client import CollectorRegistry, Gauge

from a2s.commands.dashboard import address, fetch, recall, scrape
from a2s.learner.page.history import History
from a2s.learner.page.server import Server
from a2s.protocol.errors import UsageError


@pytest.mark.parametrize(
    ("target", "expected"),
    [
        ("127.0.0.1:9464", "http://127.0.0.1:9464/metrics"),
        ("far.example:80", "http://far.example:80/metrics"),
        ("[::1]:9464", "http://[::1]:9464/metrics"),
        ("http://host:1/", "http://host:1/metrics"),
        ("https://host/runs/a/metrics", "https://host/runs/a/metrics"),
    ],
)
def test_an_address_is_completed(target: str, expected: str) -> None:
    assert address(target) == expected


@pytest.mark.parametrize(
    "target", ["host", "host:port", "ftp://host:1", ":9464", "", "[::1", "host:1/a b"]
)
def test_what_is_no_address_is_refused(target: str) -> None:
    with pytest.raises(UsageError, match="expected HOST:PORT of a learner's metrics"):
        address(target)


@pytest.fixture
def learner() -> Iterator[Server]:
    """What a learner serves, with a past of two samples."""
    registry, history = CollectorRegistry(), History()
    Gauge("a2s_learner_kl", "", registry=registry).set(0.5)
    Gauge("a2s_learner_q_mean", "", registry=registry).set(float("nan"))
    for second in (1.0, 2.0):
        history.take(second, registry.collect())
    server = Server([history], "127.0.0.1", 0, "--port", registry)
    yield server
    server.close()


def test_a_dashboard_that_begins_late_knows_what_the_learner_remembers(learner: Server) -> None:
    url, history = address(f"127.0.0.1:{learner.port}"), History()
    recall(history, url)
    scrape(history, url)
    told = history.since(0.0)
    assert told["t"][:2] == pytest.approx([1.0, 2.0], abs=1.0)  # by its own clock
    assert told["series"]["a2s_learner_kl"] == [0.5, 0.5, 0.5]
    assert history.is_up


def test_a_learner_that_does_not_answer_is_down(learner: Server) -> None:
    url, history = address(f"127.0.0.1:{learner.port}"), History()
    scrape(history, url)
    learner.close()
    scrape(history, url)
    assert not history.is_up
    recall(history, url)  # and has no past
    assert len(history.since(0.0)["t"]) == 1


@pytest.mark.parametrize(
    "said", [b"SSH-2.0-x\r\n", b"HTTP/1.1 200 OK\r\nContent-Length: 99\r\n\r\n{"]
)
def test_a_peer_that_speaks_otherwise_is_down_and_no_more(said: bytes) -> None:
    """Something else listens there, or a learner that dies while it answers."""
    history = History()
    history.is_up = True
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def answer_twice() -> None:
            for _ in range(2):
                peer, _ = listener.accept()
                with peer:
                    peer.recv(4096)
                    peer.sendall(said)

        thread = threading.Thread(target=answer_twice)
        thread.start()
        url = address(f"127.0.0.1:{listener.getsockname()[1]}")
        recall(history, url)
        scrape(history, url)
        thread.join()
    assert not history.is_up
    assert history.since(0.0) == {"t": [], "series": {}}


@contextmanager
def _serving(body: str, behind_s: float = 0.0) -> Iterator[str]:
    """Serve this, by a clock that is behind."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.wfile.write(body.encode())

        def date_time_string(self, timestamp: float | None = None) -> str:
            del timestamp
            return formatdate(time.time() - behind_s, usegmt=True)

        def log_message(self, *_: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield address(f"127.0.0.1:{server.server_port}")
        finally:
            server.shutdown()
            thread.join()


@pytest.mark.parametrize(
    "body",
    [
        'a2s_learner_kl{a="b", ="c"} 1\n',
        '{"now": 1.0, "runs": [{"t": [1.0], "series": {"a2s_learner_kl": ["high"]}}]}',
        "[" * 100_000,
    ],
)
def test_a_peer_that_serves_something_else_is_down_and_no_more(body: str) -> None:
    history = History()
    with _serving(body) as url:
        recall(history, url)
        scrape(history, url)
    assert not history.is_up
    assert history.since(0.0) == {"t": [], "series": {}}


def test_when_an_actor_was_heard_is_told_by_the_clock_of_this_machine() -> None:
    """Else the actors of a learner whose clock is behind would seem to be silent."""
    history, behind_s, name = History(), 3600.0, "a2s_learner_actor_heard_timestamp_seconds"
    text = f"# TYPE {name} gauge\n{name} {time.time() - behind_s}\n"
    with _serving(text, behind_s) as url:
        scrape(history, url)
    told = history.since(0.0)
    assert told["series"][name] == pytest.approx(told["t"], abs=30.0)


@pytest.mark.parametrize("said", [b"HTTP/1.1 200 OK\r\nX: ", b"HTTP/1.1 200 OK\r\n\r\n"])
def test_a_peer_that_drips_is_cut_off(said: bytes) -> None:
    """A byte now and then, within the header or after it, for as long as somebody listens."""
    gone = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def drip() -> None:
            peer, _ = listener.accept()
            with peer, suppress(OSError):
                peer.sendall(said)
                while not gone.wait(0.05):
                    peer.sendall(b"x")

        thread = threading.Thread(target=drip, daemon=True)
        thread.start()
        url = address(f"127.0.0.1:{listener.getsockname()[1]}")

        def read() -> None:
            with suppress(HTTPException, OSError):  # what is cut off may be reset
                fetch(url, total_s=0.2)

        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        reader.join(20)
        gone.set()
        thread.join()
    assert not reader.is_alive()
