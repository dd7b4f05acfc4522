"""The newest notice: late announcements are not seen, answers are believed."""

from collections.abc import Callable, Iterator
from itertools import repeat

import pytest

from a2s.actors.weights_client import WeightsClient
from a2s.protocol.codec import encode
from a2s.protocol.in_process import Exchange, InProcessBus
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Ack, Notice

MakeNotice = Callable[..., Notice]
KEYS = Keys("test")


class _Learner:
    """Announces and answers notices; what it answers may be another's by then."""

    def __init__(self, exchange: Exchange) -> None:
        self._bus = InProcessBus(exchange)
        self.asked: Iterator[Notice] = iter(())
        self.meanwhile: Callable[[], None] = lambda: None
        self._bus.answer(KEYS.notice, self._answer)

    def _answer(self, _: bytes) -> bytes:
        found = encode(next(self.asked))
        self.meanwhile()
        return found

    def announce(self, notice: Notice) -> None:
        self._bus.publish(KEYS.notice, encode(notice))


@pytest.fixture
def exchange() -> Exchange:
    return Exchange()


@pytest.fixture
def learner(exchange: Exchange) -> _Learner:
    return _Learner(exchange)


@pytest.fixture
def client(exchange: Exchange, learner: _Learner, make_notice: MakeNotice) -> WeightsClient:
    """One that knows version 15 of generation 2."""
    client = WeightsClient(InProcessBus(exchange), KEYS)
    learner.asked = repeat(make_notice(generation=2, version=15))
    assert _see(client, None) == (2, 15)
    return client


def _see(client: WeightsClient, known: Notice | None) -> tuple[int, int] | None:
    looks = iter([True] * 3)
    found = client.other_than(known, lambda: next(looks, False))
    return None if found is None else found.identity


def test_a_late_announcement_is_not_seen(
    client: WeightsClient, learner: _Learner, make_notice: MakeNotice
) -> None:
    learner.announce(make_notice(generation=2, version=14))
    learner.announce(make_notice(generation=1, version=99))
    assert _see(client, None) == (2, 15)
    learner.announce(make_notice(generation=2, version=16))
    assert _see(client, None) == (2, 16)


@pytest.mark.parametrize("identity", [(2, 3), (1, 40), (3, 1)])
def test_who_waits_believes_the_answer_of_a_learner_without_the_past(
    client: WeightsClient, learner: _Learner, make_notice: MakeNotice, identity: tuple[int, int]
) -> None:
    generation, version = identity
    learner.asked = repeat(make_notice(generation=generation, version=version))
    assert _see(client, make_notice(generation=2, version=15)) == identity


def test_an_answer_does_not_hide_what_was_announced_while_it_was_on_its_way(
    client: WeightsClient, learner: _Learner, make_notice: MakeNotice
) -> None:
    known = make_notice(generation=2, version=15)
    learner.meanwhile = lambda: learner.announce(make_notice(generation=2, version=16))
    assert _see(client, known) == (2, 16)


@pytest.mark.parametrize(
    ("named", "seen"), [((2, 16), (2, 16)), ((3, 1), (3, 1)), ((2, 14), (2, 15))]
)
def test_an_acknowledgement_of_newer_weights_or_another_learner_has_them_asked_for(
    client: WeightsClient,
    learner: _Learner,
    make_notice: MakeNotice,
    named: tuple[int, int],
    seen: tuple[int, int],
) -> None:
    """One of older weights is only late."""
    generation, version = named
    learner.asked = repeat(make_notice(generation=generation, version=version))
    assert _see(client, None) == (2, 15)
    ack = Ack(
        verdict="refused", reason="", generation=generation, epoch=0, weights_version=version,
        wait_s=0.0,
    )  # fmt: skip
    client.hear(ack)
    assert _see(client, None) == seen


def test_what_is_forgotten_is_asked_for(
    client: WeightsClient, learner: _Learner, make_notice: MakeNotice
) -> None:
    learner.announce(make_notice(generation=2, version=99))
    client.forget()
    assert _see(client, None) == (2, 15)


def test_only_the_learner_itself_can_say_that_it_is_another(
    client: WeightsClient, learner: _Learner, make_notice: MakeNotice
) -> None:
    announced = make_notice(generation=999, version=1)
    learner.announce(announced)
    assert _see(client, None) == (2, 15)
    learner.announce(announced)
    learner.asked = repeat(announced)
    assert _see(client, None) == (999, 1)


@pytest.mark.parametrize("claim", [(2, 1), (3, 0)])
def test_only_the_learner_itself_interrupts(
    client: WeightsClient, learner: _Learner, make_notice: MakeNotice, claim: tuple[int, int]
) -> None:
    """What it does not confirm is forgotten, also while it does not answer."""
    playing = make_notice(generation=2, version=15)
    claimed = make_notice(generation=claim[0], epoch=claim[1], version=16)
    questions = 0

    def count() -> None:
        nonlocal questions
        questions += 1

    learner.meanwhile = count
    learner.announce(claimed)
    assert [client.overrules(playing) for _ in range(9)] == [False] * 9
    assert questions == 1
    learner.asked = iter(())  # no answer
    learner.announce(claimed)
    assert not client.overrules(playing)
    learner.asked = repeat(claimed)
    assert not client.overrules(playing)
    learner.announce(claimed)
    assert client.overrules(playing)


def test_an_acknowledgement_of_another_epoch_interrupts_if_the_learner_confirms_it(
    client: WeightsClient, learner: _Learner, make_notice: MakeNotice
) -> None:
    """The announcement may have been lost."""
    playing, recovered = (make_notice(generation=2, epoch=e, version=15 + e) for e in (0, 1))
    ack = Ack(
        verdict="stale", reason="", generation=2, epoch=1, weights_version=16, wait_s=0.0
    )  # fmt: skip
    client.hear(ack)
    assert not client.overrules(playing)
    learner.asked = repeat(recovered)
    assert not client.overrules(playing)  # it was asked, and has said no
    client.hear(ack)
    assert client.overrules(playing)
    assert not client.overrules(recovered)
