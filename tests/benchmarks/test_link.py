"""The link of the trials: what it does to frames, and that nothing of it stays."""

import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from reliability.commands import wait_for
from reliability.link import ACTOR, ADDRESSES, LEARNER, Direction, Link, NoLinkError, Quality

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
ECHO = """
import socket
with socket.socket(type=socket.SOCK_DGRAM) as udp:
    udp.bind(("", 7))
    print("bound", flush=True)
    while True:
        word, peer = udp.recvfrom(100)
        print(word.decode(), flush=True)
        udp.sendto(word, peer)
"""
SAY = """
import socket, sys
with socket.socket(type=socket.SOCK_DGRAM) as udp:
    udp.settimeout(float(sys.argv[3]))
    udp.sendto(sys.argv[2].encode(), (sys.argv[1], 7))
    print(udp.recv(100).decode())
"""


def test_frames_are_delayed_within_the_jitter_and_stay_in_order() -> None:
    direction = Direction(random.Random(0))
    direction.quality = Quality(delay_s=0.1, jitter_s=0.05)
    found = []
    for now_ms in range(1200):
        if now_ms < 1000 and now_ms % 10 == 0:
            direction.send(bytes([now_ms // 10]), now_ms / 1000)
        found += [(frame[0], now_ms) for frame in direction.arrived(now_ms / 1000)]
    assert [number for number, _ in found] == list(range(100))
    delays_ms = [now_ms - 10 * number for number, now_ms in found]
    assert min(delays_ms) >= 50
    assert max(delays_ms) <= 151
    assert max(delays_ms) - min(delays_ms) > 30


def test_the_share_of_lost_frames_is_what_was_asked_for() -> None:
    direction = Direction(random.Random(0))
    direction.quality = Quality(loss=0.02)
    for _ in range(10_000):
        direction.send(b"", 0.0)
    assert 9750 < len(list(direction.arrived(0.0))) < 9850


def test_what_is_sent_into_a_cut_is_lost_and_what_was_on_the_way_arrives() -> None:
    direction = Direction(random.Random(0))
    direction.quality = Quality(delay_s=1.0)
    direction.send(b"before", 0.0)
    direction.is_cut = True
    direction.send(b"during", 0.1)
    direction.is_cut = False
    direction.send(b"after", 0.2)
    assert list(direction.arrived(2.0)) == [b"before", b"after"]
    assert direction.next_s() == float("inf")


@pytest.fixture
def link() -> Iterator[Link]:
    made = Link()
    try:
        made.__enter__()
    except NoLinkError as error:
        pytest.skip(str(error))
    yield made
    made.__exit__()


def _say(link: Link, word: str, patience_s: float = 5.0) -> str:
    words = (*link.inside(ACTOR), sys.executable, "-S", "-c", SAY, ADDRESSES[LEARNER], word)
    done = subprocess.run([*words, str(patience_s)], capture_output=True, text=True, check=False)
    return done.stdout.strip()


def test_one_direction_can_be_cut_alone(link: Link) -> None:
    words = (*link.inside(LEARNER), sys.executable, "-S", "-c", ECHO)
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as echo:
        assert echo.stdout is not None
        try:
            assert echo.stdout.readline() == "bound\n"
            assert _say(link, "whole") == "whole"
            assert echo.stdout.readline() == "whole\n"
            link.cut(LEARNER)
            assert _say(link, "there", 0.2) == ""
            assert echo.stdout.readline() == "there\n"
            link.cut(ACTOR)
            assert _say(link, "lost", 0.2) == ""
            link.cut()
            assert _say(link, "again") == "again"
            assert echo.stdout.readline() == "again\n"
        finally:
            echo.kill()


def _left(pid: int) -> list[str]:
    return [each.name for each in Path("/run/netns").glob(f"a2s{pid}*")]


def test_nothing_stays_after_a_failure() -> None:
    try:
        with Link():
            assert len(_left(os.getpid())) == 2
            raise ZeroDivisionError
    except NoLinkError as error:
        pytest.skip(str(error))
    except ZeroDivisionError:
        assert _left(os.getpid()) == []


def _trial(**environ: str) -> "subprocess.Popen[str]":
    paths = os.pathsep.join([str(BENCHMARKS), os.environ["PYTHONPATH"]])
    return subprocess.Popen(
        [sys.executable, "-m", "reliability.links"],
        env={**os.environ, "PYTHONPATH": paths, **environ},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.long
def test_nothing_stays_after_a_signal(link: Link) -> None:
    with _trial() as trial:
        wait_for(lambda: len(_left(trial.pid)) == 2, "namespaces of the trial")
        trial.send_signal(signal.SIGTERM)
        trial.send_signal(signal.SIGINT)
        assert trial.wait(30.0) in (128 + signal.SIGTERM, 128 + signal.SIGINT)
        assert _left(trial.pid) == []


def test_no_link_has_one_line_of_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(NoLinkError, match=r"^[^\n]+; [^\n]+$"):
        Link().__enter__()


@pytest.mark.long
def test_the_trial_without_a_link_ends_with_that_line() -> None:
    with _trial(PATH="") as trial:
        _, said = trial.communicate()
    assert trial.returncode == 1
    assert said.startswith("links: ")
    assert said.count("\n") == 1
