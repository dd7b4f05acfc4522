"""What every transport keeps of the words in ``protocol/transport.py``."""

import itertools
import logging
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from typing import Any

import pytest

from a2s.protocol.in_process import Exchange, InProcessBus
from a2s.protocol.transport import Bus
from a2s.protocol.zenoh_bus import ZenohBus

DEADLINE_S = 20.0
LIVE = "a2s/r/live/actor/*"


@dataclass(frozen=True, slots=True)
class Network:
    """A way to be connected; the learner's side is opened before any actor's."""

    learner: Callable[[], Bus]
    actor: Callable[[], Bus]


@dataclass(slots=True)
class Heard:
    """A handler that remembers what it was told, for a test to wait for."""

    items: list[Any] = field(default_factory=list)
    changed: threading.Condition = field(default_factory=threading.Condition)

    def __call__(self, *item: object) -> None:
        """Remember one message, or the arguments when there are several."""
        with self.changed:
            self.items.append(item[0] if len(item) == 1 else item)
            self.changed.notify_all()

    def until(self, *expected: object) -> list[Any]:
        """Wait until each of these was heard, and return everything that was, in order."""
        with self.changed:
            all_heard = self.changed.wait_for(
                lambda: all(item in self.items for item in expected), DEADLINE_S
            )
            assert all_heard, f"heard {self.items}, expected {expected}"
            return list(self.items)


@pytest.fixture(params=["in_process", "zenoh"])
def network(request: pytest.FixtureRequest) -> Iterator[Network]:
    """Make a network that is gone when the test is over."""
    with ExitStack() as stack:
        if request.param == "in_process":
            exchange = Exchange()

            def peer() -> Bus:
                return stack.enter_context(closing(InProcessBus(exchange)))

            yield Network(learner=peer, actor=peer)
            return
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
        yield Network(
            learner=lambda: stack.enter_context(closing(ZenohBus.listen(endpoint))),
            actor=lambda: stack.enter_context(closing(ZenohBus.connect(endpoint, lambda: False))),
        )


@pytest.fixture
def learner(network: Network) -> Bus:
    """Open the learner's side."""
    return network.learner()


@pytest.fixture
def actor(network: Network, learner: Bus) -> Bus:
    """Open an actor's side."""
    return network.actor()


_NUMBER = itertools.count()


def settle(learner: Bus, *actors: Bus) -> None:
    """Wait until everybody knows what was declared so far.

    Declarations and questions share a link in order: who finds a new answerer knows what was
    declared before it, and is known by what it declared before it asked.
    """
    key = f"settle/{next(_NUMBER)}"
    learner.answer(key, lambda question: question)
    end = time.monotonic() + DEADLINE_S
    for actor in actors:
        while actor.ask(key, b"", timeout_s=1.0) is None:
            assert time.monotonic() < end, "declarations never arrived"
            threading.Event().wait(0.005)


def test_a_question_is_answered(learner: Bus, actor: Bus) -> None:
    """By the handler of its own key."""
    learner.answer("a2s/r/hello", lambda question: b"welcome " + question)
    learner.answer("a2s/r/segment", lambda question: b"ack " + question)
    settle(learner, actor)
    assert actor.ask("a2s/r/hello", b"h-1", timeout_s=10.0) == b"welcome h-1"
    assert actor.ask("a2s/r/segment", b"7", timeout_s=10.0) == b"ack 7"
    assert actor.ask("a2s/r/hello", b"h-2", timeout_s=5.0) == b"welcome h-2"


def test_an_actor_can_answer_the_learner_and_other_actors(
    network: Network, learner: Bus, actor: Bus
) -> None:
    """No side is special but for where it listens; for one that is closed nobody answers."""
    other = network.actor()
    actor.answer("a2s/r/replay", lambda question: question[::-1])
    settle(learner, actor, other)
    assert learner.ask("a2s/r/replay", b"abc", timeout_s=10.0) == b"cba"
    end = time.monotonic() + DEADLINE_S
    while (answer := other.ask("a2s/r/replay", b"abc", timeout_s=10.0)) is None:
        assert time.monotonic() < end
    assert answer == b"cba"
    actor.close()
    begin = time.monotonic()
    while learner.ask("a2s/r/replay", b"2", timeout_s=10.0) is not None:
        assert time.monotonic() - begin < 5.0
    assert time.monotonic() - begin < 5.0


def test_a_question_that_nobody_answers_is_none_at_once(learner: Bus, actor: Bus) -> None:
    """Not after the timeout: an actor that waits for a learner asks again soon."""
    learner.answer("a2s/r/hello", lambda question: question)
    settle(learner, actor)
    begin = time.monotonic()
    assert actor.ask("a2s/r/segment", b"7", timeout_s=30.0) is None
    assert actor.ask("a2s/other/hello", b"", timeout_s=30.0) is None
    assert time.monotonic() - begin < 5.0


def test_a_handler_may_give_no_answer(learner: Bus, actor: Bus) -> None:
    """Who asked finds out at once, and asks again."""
    answers = iter([None, b"now"])
    learner.answer("a2s/r/hello", lambda _: next(answers))
    settle(learner, actor)
    assert actor.ask("a2s/r/hello", b"", timeout_s=30.0) is None
    assert actor.ask("a2s/r/hello", b"", timeout_s=30.0) == b"now"


def test_while_many_wait_for_a_slow_handler_others_are_refused_at_once(
    learner: Bus, actor: Bus
) -> None:
    """And what has another handler is answered, however slow this one is."""
    entered, go_on = threading.Semaphore(0), threading.Event()

    def slowly(question: bytes) -> bytes:
        entered.release()
        go_on.wait(DEADLINE_S)
        return question

    learner.answer_in_turn("a2s/r/replay", slowly, lambda: b"busy", at_most=2)
    learner.answer("a2s/r/segment", lambda question: question)
    settle(learner, actor)
    with ThreadPoolExecutor(9) as pool:

        def ask() -> "Future[bytes | None]":
            return pool.submit(actor.ask, "a2s/r/replay", b"1", DEADLINE_S)

        first = ask()
        entered.acquire(timeout=DEADLINE_S)
        asked = [ask() for _ in range(8)]
        refused = list(itertools.islice(as_completed(asked, DEADLINE_S), 6))
        assert [each.result() for each in refused] == [b"busy"] * 6
        assert actor.ask("a2s/r/segment", b"2", DEADLINE_S) == b"2"
        go_on.set()
        assert first.result() == b"1"
        assert [each.result() for each in asked].count(b"1") == 2


def test_a_handler_that_raises_gives_no_answer_and_goes_on(
    learner: Bus, actor: Bus, caplog: pytest.LogCaptureFixture
) -> None:
    """The asker hears silence at once, the log has the reason, the next question is answered."""

    def answer(question: bytes) -> bytes:
        if question == b"bad":
            raise ValueError("no such thing")
        return question

    learner.answer("a2s/r/segment", answer)
    settle(learner, actor)
    begin = time.monotonic()
    with caplog.at_level(logging.ERROR):
        assert actor.ask("a2s/r/segment", b"bad", timeout_s=30.0) is None
    assert time.monotonic() - begin < 5.0
    assert actor.ask("a2s/r/segment", b"good", timeout_s=30.0) == b"good"
    assert [r.getMessage() for r in caplog.records] == ["handler failed key=a2s/r/segment"]


@pytest.mark.parametrize("size", [0, 1, 65_537, 10_000_000])
def test_a_payload_arrives_intact_both_ways(learner: Bus, actor: Bus, size: int) -> None:
    """Of any byte, beyond the size of a packet and of a batch of segments; empty is no silence."""
    question = bytes(itertools.islice(itertools.cycle(range(251)), size))
    asked = Heard()

    def answer(payload: bytes) -> bytes:
        asked(payload)
        return payload[::-1]

    learner.answer("a2s/r/segment", answer)
    settle(learner, actor)
    assert actor.ask("a2s/r/segment", question, timeout_s=30.0) == question[::-1]
    assert asked.items == [question]
    assert type(asked.items[0]) is bytes


def test_threads_that_ask_first_at_once_are_all_answered(learner: Bus, actor: Bus) -> None:
    """What the first question to a key sets up is set up once."""
    learner.answer_each("a2s/r/first/*", lambda name, question: name.encode() + question)
    settle(learner, actor)
    together = threading.Barrier(8)

    def ask(thread: int) -> list[bytes | None]:
        answers = []
        for i in range(50):
            together.wait()
            answers.append(actor.ask(f"a2s/r/first/{i}", b"/%d" % thread, timeout_s=30.0))
        return answers

    with ThreadPoolExecutor(8) as threads:
        answers = list(threads.map(ask, range(8)))
    assert answers == [[b"%d/%d" % (i, t) for i in range(50)] for t in range(8)]


def test_each_of_many_threads_gets_its_own_answer(learner: Bus, actor: Bus) -> None:
    """The sender and the rollout of an actor ask at the same time."""
    learner.answer("a2s/r/segment", lambda question: question)
    settle(learner, actor)

    def ask(thread: int) -> list[bytes | None]:
        return [
            actor.ask("a2s/r/segment", b"%d/%d" % (thread, i), timeout_s=30.0) for i in range(50)
        ]

    with ThreadPoolExecutor(8) as threads:
        answers = list(threads.map(ask, range(8)))
    assert answers == [[b"%d/%d" % (t, i) for i in range(50)] for t in range(8)]


def test_a_handler_gets_one_message_at_a_time(network: Network, learner: Bus, actor: Bus) -> None:
    """So that it needs no lock of its own; two actors ask at once."""
    meeting = threading.Barrier(2)
    met = Heard()

    def answer(question: bytes) -> bytes:
        try:
            meeting.wait(timeout=0.2)
            met(question)
        except threading.BrokenBarrierError:
            meeting.reset()
        return question

    learner.answer("a2s/r/segment", answer)
    other = network.actor()
    settle(learner, actor, other)
    with ThreadPoolExecutor(2) as threads:
        answers = threads.map(
            lambda bus: bus.ask("a2s/r/segment", b"7", timeout_s=30.0), [actor, other]
        )
    assert list(answers) == [b"7", b"7"]
    assert met.items == []


def test_everybody_who_listens_hears_a_publication(network: Network, learner: Bus) -> None:
    """Several peers, and several handlers of one of them; in the order of publication."""
    actors = [network.actor(), network.actor()]
    heard = [Heard(), Heard(), Heard(), Heard()]
    actors[0].subscribe("a2s/r/notice", heard[0])
    actors[0].subscribe("a2s/r/notice", heard[1])
    actors[1].subscribe("a2s/r/notice", heard[2])
    learner.subscribe("a2s/r/notice", heard[3])
    settle(learner, *actors)
    sent = [b"version %d" % i for i in range(20)]
    for payload in sent:
        learner.publish("a2s/r/notice", payload)
    assert [h.until(*sent) for h in heard] == [sent] * 4


def test_a_star_stands_for_one_part_of_a_key(learner: Bus, network: Network) -> None:
    """The learner listens to every actor, whose names it does not know, and to nothing else."""
    actors = [network.actor(), network.actor()]
    every, one = Heard(), Heard()
    learner.subscribe("a2s/r/actor/*", every)
    learner.subscribe("a2s/r/actor/h-1", one)
    settle(learner, *actors)
    actors[0].publish("a2s/other/actor/h-1", b"of another run")
    actors[0].publish("a2s/r/notice", b"of another key")
    actors[0].publish("a2s/r/actor/h-1", b"from 1")
    actors[1].publish("a2s/r/actor/h-2", b"from 2")
    assert sorted(every.until(b"from 1", b"from 2")) == [b"from 1", b"from 2"]
    assert one.until(b"from 1") == [b"from 1"]


def test_a_star_does_not_stand_for_two_parts(learner: Bus, actor: Bus) -> None:
    """``live/*`` is the learner's token, not those of the actors below it."""
    heard, seen = Heard(), Heard()
    learner.subscribe("a2s/r/*", heard)
    learner.watch_presence("a2s/r/*", seen)
    settle(learner, actor)
    actor.publish("a2s/r/actor/h-1", b"deeper")
    actor.publish("a2s/r/notice", b"here")
    actor.declare_presence("a2s/r/live/learner")
    actor.declare_presence("a2s/r/learner")
    assert heard.until(b"here") == [b"here"]
    assert seen.until(("a2s/r/learner", True)) == [("a2s/r/learner", True)]


def test_a_publication_that_nobody_hears_is_no_error(learner: Bus, actor: Bus) -> None:
    """There is no promise, and what came before is not heard later."""
    actor.publish("a2s/r/actor/h-1", b"early")
    settle(learner, actor)
    heard = Heard()
    learner.subscribe("a2s/r/actor/*", heard)
    settle(learner, actor)
    actor.publish("a2s/r/actor/h-1", b"late")
    assert heard.until(b"late") == [b"late"]


def test_a_listener_that_raises_hears_the_next_and_harms_nobody(
    learner: Bus,
    actor: Bus,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A malformed publication must not end what its publisher is doing."""
    before, after = Heard(), Heard()

    def fail(payload: bytes) -> None:
        before(payload)
        raise ValueError("no such thing")

    learner.subscribe("a2s/r/recovery", fail)
    learner.subscribe("a2s/r/recovery", after)
    settle(learner, actor)
    with caplog.at_level(logging.ERROR):
        actor.publish("a2s/r/recovery", b"1")
        actor.publish("a2s/r/recovery", b"2")
        assert before.until(b"2") == [b"1", b"2"]
        assert after.until(b"2") == [b"1", b"2"]


def test_a_closed_peer_hears_nothing(network: Network, learner: Bus, actor: Bus) -> None:
    """Neither publications nor presence; the others go on hearing."""
    closed, open_, here = Heard(), Heard(), (LIVE.replace("*", "h-1"), True)
    other = network.actor()
    for bus, heard in ((actor, closed), (other, open_)):
        bus.subscribe("a2s/r/notice", heard)
        bus.watch_presence(LIVE, heard)
    settle(learner, actor, other)
    learner.publish("a2s/r/notice", b"1")
    closed.until(b"1")
    actor.close()
    learner.publish("a2s/r/notice", b"2")
    learner.declare_presence(here[0])
    open_.until(b"2", here)
    assert closed.items == [b"1"]


def test_those_who_are_present_are_told_first(network: Network, learner: Bus) -> None:
    """A learner that starts to watch learns of everybody, then of who comes."""
    first, second = network.actor(), network.actor()
    first.declare_presence("a2s/r/live/actor/h-1")
    second.declare_presence("a2s/r/live/actor/h-2")
    settle(learner, first, second)
    seen = Heard()
    learner.watch_presence(LIVE, seen)
    present = [("a2s/r/live/actor/h-1", True), ("a2s/r/live/actor/h-2", True)]
    assert sorted(seen.until(*present)) == present
    network.actor().declare_presence("a2s/r/live/actor/h-3")
    assert seen.until(("a2s/r/live/actor/h-3", True))[2:] == [("a2s/r/live/actor/h-3", True)]


def test_who_is_present_can_be_asked_for(network: Network, learner: Bus, actor: Bus) -> None:
    """From either side, also by a part of the key."""
    other, here = network.actor(), ["a2s/r/live/learner", "a2s/s/live/learner"]
    for bus, key in zip((learner, other), here, strict=True):
        bus.declare_presence(key)
    settle(learner, actor, other)
    for bus in (learner, actor):
        assert sorted(bus.present("a2s/*/live/learner", DEADLINE_S)) == here
        assert bus.present(LIVE, DEADLINE_S) == []


def test_who_comes_and_withdraws_is_seen(learner: Bus, actor: Bus) -> None:
    """Once each, and again when it comes back; nobody is told of what was not there."""
    seen, one, two = Heard(), "a2s/r/live/actor/h-1", "a2s/r/live/actor/h-2"
    learner.watch_presence(LIVE, seen)
    settle(learner, actor)
    actor.withdraw_presence(one)
    actor.declare_presence(one)
    seen.until((one, True))
    actor.withdraw_presence(one)
    seen.until((one, False))
    actor.withdraw_presence(one)
    actor.declare_presence(one)
    actor.declare_presence(two)
    assert seen.until((two, True)) == [(one, True), (one, False), (one, True), (two, True)]


def test_the_end_of_a_connection_is_seen_as_leaving(
    network: Network, learner: Bus, actor: Bus
) -> None:
    """Of everything that this peer declared, and of nobody else's."""
    seen = Heard()
    learner.watch_presence(LIVE, seen)
    other = network.actor()
    other.declare_presence("a2s/r/live/actor/h-0")
    actor.declare_presence("a2s/r/live/actor/h-1")
    actor.declare_presence("a2s/r/live/actor/h-2")
    names = ["a2s/r/live/actor/h-0", "a2s/r/live/actor/h-1", "a2s/r/live/actor/h-2"]
    seen.until(*((name, True) for name in names))
    actor.close()
    gone = [(name, False) for name in names[1:]]
    assert sorted(seen.until(*gone)[3:]) == gone


def test_an_actor_sees_the_learner_and_others_but_not_elsewhere(
    network: Network, learner: Bus, actor: Bus
) -> None:
    """Presence is seen by every watcher of the key, and by no other."""
    seen, elsewhere = Heard(), Heard()
    actor.watch_presence("a2s/r/live/learner", seen)
    actor.watch_presence("a2s/other/live/learner", elsewhere)
    settle(learner, actor)
    learner.declare_presence("a2s/r/live/learner")
    assert seen.until(("a2s/r/live/learner", True)) == [("a2s/r/live/learner", True)]
    learner.withdraw_presence("a2s/r/live/learner")
    seen.until(("a2s/r/live/learner", False))
    assert elsewhere.items == []


def test_closing_twice_is_fine(learner: Bus, actor: Bus) -> None:
    """A program that fails while it closes closes again."""
    actor.declare_presence("a2s/r/live/actor/h-1")
    actor.close()
    actor.close()
    learner.close()
    learner.close()
