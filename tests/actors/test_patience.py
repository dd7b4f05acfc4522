"""What an actor says while it waits, and when the run has ended."""

from dataclasses import replace
from itertools import count

import pytest

from a2s.actors.patience import Patience
from a2s.protocol.codec import encode
from a2s.protocol.in_process import Exchange, InProcessBus
from a2s.protocol.keys import Keys
from a2s.protocol.messages import RunStatus

KEYS = Keys("hop")
GOES_ON = RunStatus(
    run="hop", generation=1, env_id="E", env_steps=9, total_steps=9, episodes=1, updates=1,
    weights_version=2, epoch=0, return_mean=0.0, env_steps_per_s=1.0, waiting_for="", actors=(),
)  # fmt: skip
ENDED = replace(GOES_ON, ended="all steps are made")
WAITS = ["waiting for an answer for 10 s; is `a2s learner` running?"]


def _wait(patience: Patience) -> None:
    """For 15 seconds: each call is one."""
    for _ in range(16):
        patience.wait_for("an answer")


@pytest.mark.parametrize(
    ("told", "speaks", "said"),
    [
        (GOES_ON, True, WAITS),
        (ENDED, False, []),
        (
            ENDED,
            True,
            [
                "run 'hop' has ended: all steps are made; waiting for a learner that goes on with "
                "it, or for a new run"
            ],
        ),
    ],
    ids=["goes on", "another worker says it", "ended"],
)
def test_the_end_of_a_run_is_said_once_instead_of_what_is_waited_for(
    caplog: pytest.LogCaptureFixture, told: RunStatus, speaks: bool, said: list[str]
) -> None:
    """A late answer changes nothing; that of the next learner does."""
    bus, seconds = InProcessBus(Exchange()), count()
    patience = Patience(bus, KEYS, speaks=speaks, clock=lambda: float(next(seconds)))
    bus.publish(KEYS.status, encode(told))
    patience.over()
    _wait(patience)
    assert caplog.messages == said
    caplog.clear()
    patience.over()
    _wait(patience)
    assert caplog.messages == WAITS


def test_who_waits_for_a_run_of_another_name_is_told_those_that_are_there(
    caplog: pytest.LogCaptureFixture,
) -> None:
    bus, seconds = InProcessBus(Exchange()), count()
    for name in ("walk", "hopp"):
        bus.declare_presence(Keys(name).live_learner)
    _wait(Patience(bus, KEYS, speaks=True, clock=lambda: float(next(seconds))))
    there = "found runs 'hopp', 'walk' there, name it with --run"
    assert caplog.messages == [f"waiting for an answer for 10 s; {there}"]


def test_a_peer_with_a_name_is_told_that_it_may_not_be_let_in(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """What is not allowed is not answered: that looks like a learner that is not there."""
    patience = Patience(
        InProcessBus(Exchange()), KEYS, speaks=True, known_as="actor-x", clock=count().__next__
    )
    _wait(patience)
    assert caplog.messages == [
        "waiting for an answer for 10 s; is `a2s learner` running, and is 'actor-x' one of the "
        "names that it lets in?"
    ]


@pytest.mark.parametrize(
    ("waiting_for", "hint"),
    [
        ("segments of version 5", "; it answers, and waits for segments of version 5"),
        ("", "; is `a2s learner` running?"),
    ],
)
def test_what_the_learner_itself_waits_for_is_said(
    waiting_for: str, hint: str, caplog: pytest.LogCaptureFixture
) -> None:
    bus = InProcessBus(Exchange())
    bus.answer(KEYS.status, lambda _: encode(replace(GOES_ON, waiting_for=waiting_for)))
    _wait(Patience(bus, KEYS, speaks=True, clock=count().__next__))
    assert caplog.messages == [f"waiting for an answer for 10 s{hint}"]
