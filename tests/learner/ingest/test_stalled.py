"""Who reports and delivers nothing is not waited for without end; who is slow is."""

from dataclasses import replace

import pytest
from message_examples import NOTICE, STATUS
from segments import segment

from a2s.learner.ingest.clock import STALLED_S, Async, Lockstep, Round
from a2s.learner.ingest.members import Member
from a2s.protocol.messages import ActorStatus

QUOTA = replace(NOTICE, quota_steps=100, quota_episodes=0)
PUBLISHED_S, TIMEOUT_S = 1000.0, 120.0
LATE_S = PUBLISHED_S + STALLED_S


def status(env_steps: int, doing: str = "") -> ActorStatus:
    return replace(STATUS, env_steps=env_steps, doing=doing)


def member(num_envs: int = 4) -> Member:
    """One that joined long ago, and has reported 50,000 steps when the weights came out."""
    made = Member(actor="a", slot=0, num_envs=num_envs, heard_s=0.0)
    made.hear(status(50_000), PUBLISHED_S - 1.0)
    made.has_sent(PUBLISHED_S - 1.0)
    return made


def is_stalled(found: Member, now_s: float) -> bool:
    played = Round(notice=QUOTA, batch_steps=400, published_s=PUBLISHED_S)
    return bool(Lockstep().stalled(played, [found], now_s, TIMEOUT_S))


def test_who_reports_but_does_not_play_is_stalled() -> None:
    found = member()
    for second in range(int(STALLED_S)):
        found.hear(status(50_000), PUBLISHED_S + second)
    assert not is_stalled(found, LATE_S)
    assert is_stalled(found, LATE_S + 0.1)
    assert not Async().stalled(
        Round(notice=QUOTA, batch_steps=400, published_s=PUBLISHED_S), [found], 1e9, TIMEOUT_S
    )


def test_who_plays_slowly_or_has_just_sent_is_not() -> None:
    """A step now and then is enough; so is a segment."""
    slow, sent = member(), member()
    slow.hear(status(50_001), LATE_S)
    sent.has_sent(LATE_S)
    for found in (slow, sent):
        assert not is_stalled(found, LATE_S + STALLED_S)
        assert is_stalled(found, LATE_S + STALLED_S + 0.1)


@pytest.mark.parametrize(("reported", "expected"), [(800, False), (801, True)])
def test_who_says_that_it_plays_and_sends_nothing_is_believed_for_two_quotas(
    reported: int, expected: bool
) -> None:
    """Two quotas of 100 steps in four environments."""
    found = member()
    found.hear(status(50_000 + reported), LATE_S)
    assert is_stalled(found, LATE_S + 1.0) is expected


def test_a_call_into_each_environment_may_take_as_long_as_it_may() -> None:
    found = member()
    found.hear(status(50_000, "reset of environment 3 for 100 s"), LATE_S)
    assert not is_stalled(found, PUBLISHED_S + 4 * TIMEOUT_S)
    assert is_stalled(found, PUBLISHED_S + 4 * TIMEOUT_S + 0.1)


def test_who_has_played_its_quota_owes_nothing() -> None:
    found = member(num_envs=1)
    found.deliver(segment(0, 100, env=0))
    assert not is_stalled(found, 1e9)
