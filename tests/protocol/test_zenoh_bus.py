"""What only a real network has: endpoints, deadlines, and peers that die and come back."""

import itertools
import logging
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from queue import SimpleQueue

import pytest

from a2s.protocol import zenoh_session
from a2s.protocol.errors import MalformedMessageError, UnreachableError, UsageError
from a2s.protocol.zenoh_bus import ZenohBus

DEADLINE_S = 20.0
HELLO, LIVE = "a2s/r/hello", "a2s/r/live/actor/h-1"


@pytest.fixture
def endpoint() -> str:
    """Find a port of this machine on which nobody listens."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{free.getsockname()[1]}"


def connect(endpoint: str) -> ZenohBus:
    """Connect to a learner that is there."""
    return ZenohBus.connect(endpoint, lambda: False)


def listen(endpoint: str) -> ZenohBus:
    """Open a learner that answers a hello with its own bytes."""
    learner = ZenohBus.listen(endpoint)
    learner.answer(HELLO, lambda question: question)
    return learner


def ask_until_answered(bus: ZenohBus, key: str, payload: bytes) -> bytes:
    """Ask again on silence, as actors do."""
    end = time.monotonic() + DEADLINE_S
    while (answer := bus.ask(key, payload, timeout_s=5.0)) is None:
        assert time.monotonic() < end, "never answered"
        threading.Event().wait(0.01)
    return answer


class Way:
    """A way to an endpoint, which is closed for what comes back after so many bytes.

    Attributes:
        endpoint: Of the near end.
        closes_at: After so many bytes it waits until it ``is_open`` again.
        carried: Bytes that came back.
        is_closed: Set when it waits.
    """

    def __init__(self, endpoint: str) -> None:
        host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
        self._there = (host, int(port))
        self._here = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._here.getsockname()[1]}"
        self.closes_at, self.carried = sys.maxsize, 0
        self.is_closed, self.is_open = threading.Event(), threading.Event()
        self._stack = ExitStack()

    def __enter__(self) -> "Way":
        threads = self._stack.enter_context(ThreadPoolExecutor(3))
        self._stack.enter_context(self._here)
        threads.submit(self._serve, threads)
        return self

    def __exit__(self, *_: object) -> None:
        self.is_open.set()
        self._stack.close()

    def _serve(self, threads: ThreadPoolExecutor) -> None:
        near, _ = self._here.accept()
        far = socket.create_connection(self._there)
        threads.submit(self._carry, near, far)
        threads.submit(self._carry_back, far, near)

    def _carry(self, near: socket.socket, far: socket.socket) -> None:
        with near, far, suppress(OSError):
            while data := near.recv(1 << 16):
                far.sendall(data)

    def _carry_back(self, far: socket.socket, near: socket.socket) -> None:
        with near, far, suppress(OSError):
            while data := far.recv(1 << 16):
                if self.carried >= self.closes_at:
                    self.is_closed.set()
                    self.is_open.wait()
                near.sendall(data)
                self.carried += len(data)


@pytest.mark.parametrize(
    "endpoint",
    [
        "", "7447", "127.0.0.1:7447", "tcp/127.0.0.1", "tcp/:7447", "tcp/127.0.0.1:",
        "tcp/127.0.0.1:0", "tcp/127.0.0.1:65536", "tcp/127.0.0.1:http", "tcp://127.0.0.1:7447",
        "http/127.0.0.1:7447", "udp/127.0.0.1:7447", "tcp/127.0.0.1:7447\n",
        "tcp/127.0.0.1:7447?rel=0", "tcp/127.0.0.1:7447#iface=lo", " tcp/127.0.0.1:7447",
        "unixsock-stream/",
    ],
)  # fmt: skip
def test_a_malformed_endpoint_is_refused_before_the_network_is_touched(endpoint: str) -> None:
    """The message shows what was typed, and a good one."""
    for call in (ZenohBus.listen, connect):
        with pytest.raises(UsageError) as caught:
            call(endpoint)
        assert str(caught.value) == (
            f"endpoint: found {endpoint!r}, expected PROTOCOL/HOST:PORT, "
            "for example tcp/127.0.0.1:7447"
        )


def test_a_port_in_use_is_said_in_one_line(endpoint: str) -> None:
    """In the words of the operating system, with what to do; the port's owner is not harmed."""
    with closing(listen(endpoint)):
        with pytest.raises(UsageError) as caught:
            ZenohBus.listen(endpoint)
        assert str(caught.value) == (
            f"cannot listen on {endpoint}: Address already in use; "
            "choose another endpoint with --listen tcp/HOST:PORT"
        )
        with closing(connect(endpoint)) as actor:
            assert ask_until_answered(actor, HELLO, b"1") == b"1"


@pytest.mark.parametrize("host", ["192.0.2.1", "no-such-host.invalid"])
def test_an_address_that_is_not_ours_is_said_in_one_line(host: str) -> None:
    """192.0.2.1 belongs to nobody (RFC 5737), and .invalid to no name server (RFC 2606)."""
    with pytest.raises(UsageError, match=rf"^cannot listen on tcp/{host}:7447: ") as caught:
        ZenohBus.listen(f"tcp/{host}:7447")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


def test_nobody_listening_is_said_and_waited_for_as_long_as_the_caller_wants(
    endpoint: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """An attempt takes about a second; a long wait says what it waits for."""
    monkeypatch.setattr(zenoh_session, "_PATIENCE_S", 0.0)
    attempts = itertools.count(1)
    begin = time.monotonic()
    with caplog.at_level(logging.WARNING), pytest.raises(UnreachableError) as caught:
        ZenohBus.connect(endpoint, lambda: next(attempts) < 2)
    assert next(attempts) == 3
    assert time.monotonic() - begin < 10.0
    nobody = rf"no learner at {endpoint} after \d s; "
    start = re.escape("start `a2s learner` (--resume goes on with a run)")
    help_ = f"{start}, or name its endpoint with --connect"
    assert re.fullmatch(nobody + help_, str(caught.value))
    (said,) = [record.getMessage() for record in caplog.records]
    assert re.fullmatch(f"{nobody}still trying, {start} there", said)


def test_a_learner_that_ends_meanwhile_is_no_refusal() -> None:
    """Its port still takes connections, and ends them: as that of one that wants a password."""
    listener = socket.create_server(("127.0.0.1", 0))

    def end() -> None:
        """End connections that speak; once it was looked at, also the listener."""
        was_looked_at = False
        while True:
            link, _ = listener.accept()
            with closing(link):
                link.settimeout(0.5)
                try:
                    speaks = bool(link.recv(1))
                except TimeoutError:
                    was_looked_at, speaks = True, False
                    link.settimeout(DEADLINE_S)
                    link.recv(1)
            if was_looked_at and speaks:
                listener.close()
                return

    ending = threading.Thread(target=end)
    ending.start()
    with pytest.raises(UnreachableError):
        ZenohBus.connect(f"tcp/127.0.0.1:{listener.getsockname()[1]}", lambda: False)
    ending.join()


def test_an_actor_may_be_started_before_its_learner(endpoint: str) -> None:
    """It keeps trying for as long as it is told to."""
    tried = threading.Event()

    def proceed() -> bool:
        tried.set()
        return True

    with ThreadPoolExecutor(1) as thread:
        connecting = thread.submit(ZenohBus.connect, endpoint, proceed)
        assert tried.wait(DEADLINE_S)
        with closing(listen(endpoint)), closing(connecting.result(DEADLINE_S)) as actor:
            assert ask_until_answered(actor, HELLO, b"1") == b"1"


def test_a_restarted_learner_is_found_again_by_the_same_client(endpoint: str) -> None:
    """Questions, subscriptions and presence go on; between the two, questions are silence."""
    notices: SimpleQueue[bytes] = SimpleQueue()
    present: SimpleQueue[tuple[str, bool]] = SimpleQueue()
    first = ZenohBus.listen(endpoint)
    with closing(first):
        first.answer(HELLO, lambda question: b"first")
        actor = connect(endpoint)
        with closing(actor):
            actor.subscribe("a2s/r/notice", notices.put)
            actor.declare_presence(LIVE)
            assert ask_until_answered(actor, HELLO, b"") == b"first"

            first.close()
            begin = time.monotonic()
            assert actor.ask(HELLO, b"", timeout_s=30.0) is None
            assert time.monotonic() - begin < 5.0

            with closing(ZenohBus.listen(endpoint)) as second:
                second.watch_presence("a2s/r/live/actor/*", lambda *seen: present.put(seen))
                second.answer(HELLO, lambda question: b"second")
                assert ask_until_answered(actor, HELLO, b"") == b"second"
                assert present.get(timeout=DEADLINE_S) == (LIVE, True)
                second.publish("a2s/r/notice", b"version 2")
                assert notices.get(timeout=DEADLINE_S) == b"version 2"


def test_a_handler_that_takes_too_long_is_silence_after_the_timeout(endpoint: str) -> None:
    """A learner that hangs does not hang its actors; its late answer is heard by nobody."""
    release, asked = threading.Event(), threading.Event()

    def answer(question: bytes) -> bytes:
        asked.set()
        release.wait(DEADLINE_S)
        return question

    with closing(ZenohBus.listen(endpoint)) as learner:
        learner.answer("a2s/r/segment", answer)
        with closing(connect(endpoint)) as actor:
            try:
                asked_at = time.monotonic()
                assert actor.ask("a2s/r/segment", b"1", timeout_s=0.5) is None
                assert 0.4 < time.monotonic() - asked_at < 10.0
                assert asked.is_set()
            finally:
                release.set()
            assert ask_until_answered(actor, "a2s/r/segment", b"2") == b"2"


def test_a_killed_peer_is_seen_as_leaving(endpoint: str) -> None:
    """However a connection ends; here with SIGKILL, which runs no code of ours."""
    program = (
        "import sys, threading\n"
        "from a2s.protocol.zenoh_bus import ZenohBus\n"
        "bus = ZenohBus.connect(sys.argv[1], lambda: False)\n"
        "bus.declare_presence(sys.argv[2])\n"
        "threading.Event().wait(60)\n"
    )
    present: SimpleQueue[tuple[str, bool]] = SimpleQueue()
    with closing(ZenohBus.listen(endpoint)) as learner:
        learner.watch_presence("a2s/r/live/actor/*", lambda *seen: present.put(seen))
        with subprocess.Popen([sys.executable, "-c", program, endpoint, LIVE]) as process:
            try:
                assert present.get(timeout=DEADLINE_S) == (LIVE, True)
            finally:
                process.kill()
            assert present.get(timeout=5.0) == (LIVE, False)  # before the lease of 10 s


def test_a_peer_that_reads_no_more_does_not_keep_us_from_closing(endpoint: str) -> None:
    """Nor from ending: the interpreter waits for every thread but a daemon."""
    program = (
        "import sys, threading\n"
        "from a2s.protocol.zenoh_bus import ZenohBus\n"
        "bus = ZenohBus.connect(sys.argv[1], lambda: False)\n"
        "bus.subscribe(sys.argv[2], print)\n"
        "bus.declare_presence(sys.argv[2])\n"
        "threading.Event().wait(60)\n"
    )
    present: SimpleQueue[tuple[str, bool]] = SimpleQueue()
    learner = ZenohBus.listen(endpoint)
    learner.watch_presence(LIVE, lambda *seen: present.put(seen))
    with subprocess.Popen([sys.executable, "-c", program, endpoint, LIVE]) as process:
        try:
            assert present.get(timeout=DEADLINE_S) == (LIVE, True)
            process.send_signal(signal.SIGSTOP)
            for _ in range(8):  # more than fits into its link
                learner.publish(LIVE, bytes(1 << 20))
            learner.close()
            assert [each.daemon for each in threading.enumerate() if each.name == "close"] == [True]
        finally:
            process.kill()


def test_what_is_fetched_lets_others_pass(endpoint: str) -> None:
    """Also those who ask later, on a way where it would take long."""
    is_asked, size = threading.Event(), 32 << 20

    def small(question: bytes) -> bytes:
        is_asked.set()
        return question

    with (
        closing(ZenohBus.listen(endpoint)) as learner,
        Way(endpoint) as way,
        closing(connect(way.endpoint)) as actor,
        ThreadPoolExecutor() as thread,
    ):
        learner.answer("a2s/r/large", lambda _: bytes(size))
        learner.answer("a2s/r/small", small)
        ask_until_answered(actor, "a2s/r/small", b"")
        is_asked.clear()
        way.closes_at = way.carried + (1 << 20)
        large = thread.submit(actor.fetch, "a2s/r/large", DEADLINE_S)
        assert way.is_closed.wait(DEADLINE_S)
        answer = actor.begin_asking("a2s/r/small", b"s", DEADLINE_S)
        assert is_asked.wait(DEADLINE_S)
        way.is_open.set()
        assert answer() == b"s"
        assert way.carried < size // 2
        assert large.result(DEADLINE_S) == bytes(size)


def test_who_reads_nothing_holds_up_those_alone_who_wait_for_the_same(endpoint: str) -> None:
    """And nobody who has something to say, if answers are given in turn."""
    with (
        closing(ZenohBus.listen(endpoint)) as learner,
        Way(endpoint) as way,
        closing(connect(way.endpoint)) as silent,
        closing(connect(endpoint)) as actor,
    ):
        learner.answer_in_turn("a2s/r/large", lambda _: bytes(32 << 20), bytes, 1000)
        learner.answer("a2s/r/small", lambda question: question)
        for each in (silent, actor):
            ask_until_answered(each, "a2s/r/small", b"s")
        way.closes_at = 0
        for _ in range(300):  # of which zenoh would have 256 wait
            silent.begin_asking("a2s/r/large", b"", DEADLINE_S)
        assert way.is_closed.wait(DEADLINE_S)
        actor.begin_asking("a2s/r/large", b"", DEADLINE_S)
        assert actor.ask("a2s/r/small", b"s", timeout_s=DEADLINE_S / 2) == b"s"


def test_a_unix_socket_will_do(tmp_path: Path) -> None:
    """On one machine, and for a container's sidecar."""
    endpoint = f"unixsock-stream/{tmp_path}/a2s.sock"
    with closing(listen(endpoint)), closing(connect(endpoint)) as actor:
        assert ask_until_answered(actor, HELLO, b"1") == b"1"


def test_junk_from_the_network_fills_no_log(
    endpoint: str, caplog: pytest.LogCaptureFixture
) -> None:
    came: SimpleQueue[bytes] = SimpleQueue()

    def refuse(payload: bytes) -> None:
        came.put(payload)
        raise MalformedMessageError("junk")

    with closing(listen(endpoint)) as learner, closing(connect(endpoint)) as actor:
        actor.subscribe("a2s/r/notice", refuse)
        while came.empty():  # until the subscription is known there
            learner.publish("a2s/r/notice", b"junk")
            threading.Event().wait(0.01)
        for _ in range(100):
            learner.publish("a2s/r/notice", b"junk")
        for _ in range(50):
            came.get(timeout=DEADLINE_S)
    assert [record.getMessage() for record in caplog.records] == ["junk"] * 10
