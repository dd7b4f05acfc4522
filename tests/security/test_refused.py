"""Who is not let in, over real zenoh: each is told why, and what to do, in one line."""

import re
import socket
import socketserver
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from secured import free_port

from a2s.protocol import refusal
from a2s.protocol.certificates import Authority
from a2s.protocol.errors import RefusedError, UnreachableError
from a2s.protocol.identity import ANYBODY, Identity, Security
from a2s.protocol.keys import Keys
from a2s.protocol.zenoh_bus import ZenohBus

NOW = datetime.now(UTC)
LONG_AGO = NOW - timedelta(days=30)
Attempt = tuple[str, Identity]


def held(folder: Path, side: str = "connect") -> Identity:
    """What a peer that does not check its own files shows."""
    settings = {
        "root_ca_certificate": "ca.pem", f"{side}_certificate": "cert.pem",
        f"{side}_private_key": "key.pem",
    }  # fmt: skip
    tls = {f"transport/link/tls/{name}": str(folder / file) for name, file in settings.items()}
    return Identity("somebody", folder, {**tls, "transport/link/tls/enable_mtls": True})


@pytest.fixture(scope="module")
def attempts(certs: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Attempt]]:
    """Learners and peers that do not fit: where each connects, and as whom."""
    place = tmp_path_factory.mktemp("refused")
    ours, theirs = Authority.read(certs, NOW), Authority.new(NOW)
    hosts = ["127.0.0.1"]

    def folder(name: str, files: dict[str, bytes]) -> Path:
        (place / name).mkdir()
        for file, data in files.items():
            (place / name / file).write_bytes(data)
        return place / name

    (place / "users").write_text("actor:secret\nviewer:other\n")
    (place / "wrong").write_text("actor:wrong\n")
    with ExitStack() as stack:

        def listen(identity: Identity, kind: str = "tls") -> str:
            endpoint = f"{kind}/127.0.0.1:{free_port()}"
            stack.enter_context(closing(ZenohBus.listen(endpoint, identity)))
            return endpoint

        users = Security(password_file=str(place / "users"))
        actor = Security(tls=str(certs / "actor")).peer("actor")
        real = listen(Security(tls=str(certs)).listener(Keys("r"), "tls/127.0.0.1:1"))
        old = listen(held(folder("old", ours.issue("learner", hosts, 7, LONG_AGO)), "listen"))
        far = listen(held(folder("far", ours.issue("learner", ["far"], 7, NOW)), "listen"))
        rogue = listen(held(certs / "actor-lab1", "listen"))
        plain = listen(ANYBODY, "tcp")
        locked = listen(users.listener(Keys("r"), "tcp/127.0.0.1:1"), "tcp")
        foreign = folder("foreign", theirs.issue("actor", [], 7, NOW))
        trusting = folder("trusting", theirs.issue("actor", [], 7, NOW))
        (trusting / "ca.pem").write_bytes((certs / "ca.pem").read_bytes())
        expired = folder("expired", ours.issue("actor", [], 7, LONG_AGO))
        wrong = Security(password_file=str(place / "wrong")).peer("actor")
        yield {
            "no certificate": (real.replace("tls", "tcp"), ANYBODY),
            "foreign authority": (real, held(foreign)),
            "foreign certificate": (real, held(trusting)),
            "expired": (real, held(expired)),
            "expired learner": (old, actor),
            "learner elsewhere": (far, actor),
            "an actor poses as the learner": (rogue, actor),
            "learner without tls": (plain.replace("tcp", "tls"), actor),
            "wrong password": (locked, wrong),
            "no password": (locked, ANYBODY),
            "password for nothing": (plain, users.peer("actor")),
        }


@pytest.fixture(scope="module")
def told(attempts: dict[str, Attempt]) -> dict[str, str]:
    """What each was told; all try at once, for an attempt takes a second or more."""

    def attempt(name: str) -> str:
        endpoint, identity = attempts[name]
        with pytest.raises((RefusedError, UnreachableError)) as caught:
            ZenohBus.connect(endpoint, lambda: False, identity).close()
        assert isinstance(caught.value, UnreachableError) is (name == "learner without tls")
        return str(caught.value).replace(f"{endpoint}", "ENDPOINT")

    with ThreadPoolExecutor(len(attempts)) as pool:
        return dict(zip(attempts, pool.map(attempt, attempts), strict=True))


REFUSED = {
    "no certificate": "ENDPOINT: what listens there wants a certificate; name the folder of one "
    "with --tls DIR",
    "foreign authority": r"ENDPOINT: the learner's certificate is not of the authority \S+/ca.pem; "
    "copy the folder that `a2s certs` made",
    "foreign certificate": r"ENDPOINT: \S+/cert.pem is of another authority than the learner's; "
    "make a new one with `a2s certs` where the authority is",
    "expired": r"ENDPOINT: \S+/cert.pem is expired, by the learner's clock; compare the clocks, or "
    "make a new one with `a2s certs` where the authority is",
    "expired learner": "ENDPOINT: the learner's certificate is not valid now; compare the clocks, "
    "or make a new one with `a2s certs` where the authority is and start the learner",
    "learner elsewhere": "ENDPOINT: the learner's certificate is not for 127.0.0.1; connect by a "
    "name that it has, or make it anew with `a2s certs --host 127.0.0.1`",
    "an actor poses as the learner": "ENDPOINT: what listens there has no learner's certificate; "
    "it is not the learner",
    "learner without tls": r"no learner at ENDPOINT after \d+ s, though something listens there: "
    r"it may hang, or be without --tls; start `a2s learner` \(--resume goes on with a run\), or "
    "name its endpoint with --connect",
    "wrong password": "ENDPOINT: what listens there does not let user 'actor' with this password "
    "in; .*",
    "no password": "ENDPOINT: what listens there does not let this peer in; .*--password-file.*",
    "password for nothing": "ENDPOINT: what listens there does not let user 'actor' .*",
}


def test_a_tunnel_without_a_learner_behind_it_is_no_refusal() -> None:
    """It takes a connection and ends it; an actor waits for its learner there as elsewhere."""
    with socketserver.ThreadingTCPServer(
        ("127.0.0.1", 0), socketserver.BaseRequestHandler
    ) as tunnel:
        thread = threading.Thread(target=tunnel.serve_forever)
        thread.start()
        try:
            with pytest.raises(
                UnreachableError, match=r"^no learner at tcp/127\.0\.0\.1:\d+ after"
            ):
                ZenohBus.connect(f"tcp/127.0.0.1:{tunnel.server_address[1]}", lambda: False)
        finally:
            tunnel.shutdown()
            thread.join()


@pytest.mark.parametrize("name", REFUSED)
def test_who_is_not_let_in_is_told_why_in_one_line(told: dict[str, str], name: str) -> None:
    assert re.fullmatch(REFUSED[name], told[name])


def test_a_name_that_is_not_listed_is_met_with_silence(certs: Path, tmp_path: Path) -> None:
    """Its certificate is good, and it can do nothing: so is one kept out that was lost."""
    own = Security(tls=str(certs))
    endpoint, keys = f"tls/127.0.0.1:{free_port()}", Keys("r")
    (certs / "learner" / "names.txt").write_text("actor\nviewer\n")
    try:
        identity = own.listener(keys, endpoint)
    finally:
        (certs / "learner" / "names.txt").write_text("actor\nviewer\nactor-lab1\n")
    with closing(ZenohBus.listen(endpoint, identity)) as learner:
        learner.answer(keys.status, lambda _: b"told")
        learner.declare_presence(keys.live_learner)
        for name, answer in (("actor", b"told"), ("actor-lab1", None)):
            peer = Security(tls=str(certs / name)).peer("actor")
            with closing(ZenohBus.connect(endpoint, lambda: False, peer)) as bus:
                assert bus.present(keys.live_learner, 5.0) == ([keys.live_learner] * bool(answer))
                assert bus.ask(keys.status, b"", 5.0) == answer


@pytest.mark.parametrize(
    ("endpoint", "expected"),
    [("tcp/a..b:7447", False), ("tcp/127.0.0.1:7447", True), ("tls/[::1]:7447", True)],
)
def test_a_host_without_an_address_is_told_from_one_without_a_learner(
    endpoint: str, expected: bool
) -> None:
    assert refusal.has_address(endpoint) is expected


def test_a_host_that_takes_no_connection_is_not_said_to_listen() -> None:
    with socket.create_server(("127.0.0.1", 0), backlog=0) as full:
        host, port = full.getsockname()
        waiting = [socket.socket() for _ in range(4)]  # as many as it takes to fill its queue
        for each in waiting:
            each.setblocking(False)
            each.connect_ex((host, port))
        assert not refusal.is_awaited(f"tcp/{host}:{port}")
        for each in waiting:
            each.close()
