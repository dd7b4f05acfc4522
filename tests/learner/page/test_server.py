"""The server of the live page: files, data, metrics, and nothing else."""

import json
import socket
import urllib.error
import urllib.request
from collections.abc import Iterator

import pytest
from prometheus_client import CollectorRegistry, Gauge

from a2s.learner.page.history import History
from a2s.learner.page.server import Sampler, Server
from a2s.protocol.errors import UsageError
from a2s.protocol.serving import url_of

WEIGHT_LIMIT = 150_000


@pytest.fixture
def server() -> Iterator[Server]:
    """A server of one run with two samples."""
    registry, history = CollectorRegistry(), History()
    Gauge("a2s_learner_kl", "", registry=registry).set(0.5)
    for second in (1.0, 2.0):
        history.take(second, registry.collect())
    made = Server([history], "127.0.0.1", 0, "--port", registry)
    yield made
    made.close()


def _read(server: Server, path: str) -> bytes:
    with urllib.request.urlopen(f"http://127.0.0.1:{server.port}{path}", timeout=10) as reply:
        return bytes(reply.read())


def test_the_page_and_what_it_needs_are_light(server: Server) -> None:
    """All that a browser loads, from here alone."""
    page = _read(server, "/").decode()
    assert page == _read(server, "/index.html").decode()
    needed = [part.split('"')[0] for part in page.replace('src="', 'href="').split('href="')[1:]]
    loaded = [name for name in needed if not name.startswith("data:") and name != "metrics"]
    assert sorted(loaded) == ["page.css", "page.js", "uPlot.css", "uPlot.js"]
    assert sum(len(_read(server, f"/{name}")) for name in loaded) + len(page) < WEIGHT_LIMIT
    assert b"MIT" in _read(server, "/uPlot-LICENSE.txt")


@pytest.mark.parametrize(
    ("query", "times"), [("", [1.0, 2.0]), ("?since=1", [2.0]), ("?since=soon", [1.0, 2.0])]
)
def test_data_are_what_is_new(server: Server, query: str, times: list[float]) -> None:
    (run,) = json.loads(_read(server, f"/data{query}"))["runs"]
    assert run["t"] == times
    assert run["series"] == {"a2s_learner_kl": [0.5] * len(times)}
    assert run["up"]


def test_metrics_are_at_their_usual_place(server: Server) -> None:
    assert b"\na2s_learner_kl 0.5\n" in _read(server, "/metrics")


@pytest.mark.parametrize(
    "path", ["/nothing", "/../server.py", "/%2e%2e/server.py", "/static/page.js"]
)
def test_there_is_nothing_else(server: Server, path: str) -> None:
    with pytest.raises(urllib.error.HTTPError) as caught:
        _read(server, path)
    assert caught.value.code == 404
    caught.value.close()


def test_a_port_that_is_taken_is_named_with_the_option(server: Server) -> None:
    with pytest.raises(UsageError, match=rf"^port {server.port}: .*; choose another with --port"):
        Server([], "127.0.0.1", server.port, "--port")


@pytest.mark.parametrize("host", ["nosuch.invalid", "a..b", "\u00fc..b", "192.0.2.1"])
def test_a_host_that_is_not_here_is_named_with_its_option(host: str) -> None:
    """192.0.2.1 is of documentation, and nobody's."""
    with pytest.raises(UsageError, match=rf"^--metrics-host: found '{host}', expected an address"):
        Server([], host, 0, "--metrics-port")


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost"])
def test_it_is_served_where_its_address_says(host: str) -> None:
    server = Server([], host, 0, "--port")
    with urllib.request.urlopen(url_of(host, server.port, "/"), timeout=10) as reply:
        assert b"<title>" in reply.read()
    server.close()


def test_who_says_nothing_is_cut_off_and_who_asks_is_answered(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Not even a thread is kept for a browser that has fallen asleep, and nothing is said of it."""
    server = Server([], "127.0.0.1", 0, "--port", idle_s=0.1)
    for said in (b"", b"GET / HTTP/1.1\r\nHost"):
        with socket.create_connection(("127.0.0.1", server.port), timeout=20) as asleep:
            asleep.sendall(said)
            assert asleep.recv(1) == b""
    assert b"<title>" in _read(server, "/")
    server.close()
    assert capsys.readouterr().err == ""


def test_a_sampler_takes_at_once_and_stops() -> None:
    taken: list[int] = []
    sampler = Sampler(lambda: taken.append(1))
    sampler.close()
    assert taken == [1]
