"""What limits a run, by counts that are worked out by hand."""

from dataclasses import replace

import pytest

from a2s.learner.run.limits import Limits, Shares
from a2s.protocol.messages import ActorStatus

A = ActorStatus(
    actor="a", slot=0, weights_version=1, epoch=0, env_steps=0, episodes=0, segments_sent=0,
    segments_answered=0, spooled_steps=0, leaving=False,
)  # fmt: skip
B = replace(A, actor="b")


def after(*looks: tuple[float, float, list[ActorStatus]]) -> Shares | None:
    """Look at times with the learner's seconds and the actors."""
    limits = Limits()
    for look in looks:
        limits.look(*look)
    return limits.shares


def spent(actor: ActorStatus, environment_s: float, selection_s: float) -> ActorStatus:
    """An actor with its seconds so far."""
    return replace(actor, environment_s=environment_s, selection_s=selection_s)


def test_shares_by_hand() -> None:
    """In 4 s the learner learned for 1; actors stepped for 2 and 1, chose for 1 and 0."""
    found = after(
        (10.0, 5.0, [spent(A, 7.0, 1.0), spent(B, 0.0, 3.0)]),
        (14.0, 6.0, [spent(A, 9.0, 2.0), spent(B, 1.0, 3.0)]),
    )
    assert found == pytest.approx((0.25, 0.375, 0.125, 0.25))
    assert found is not None
    assert found.largest == "environment"


def test_a_wait_that_nobody_works_in_is_the_network() -> None:
    """Learner and actors together were busy for half a second of two."""
    found = after((0.0, 0.0, [A]), (2.0, 0.25, [spent(A, 0.25, 0.0)]))
    assert found is not None
    assert found.largest == "network"
    assert found.network == pytest.approx(0.75)


def test_where_they_work_at_once_nothing_is_left_for_the_network() -> None:
    """The learner learned all the time, the actor stepped for most of it."""
    found = after((0.0, 0.0, [A]), (2.0, 2.0, [spent(A, 1.5, 0.25)]))
    assert found == pytest.approx((1.0, 0.75, 0.125, 0.0))
    assert found is not None
    assert found.largest == "learner"


def test_no_share_is_above_one() -> None:
    """Three seconds of learning that ended between looks a second apart."""
    found = after((0.0, 0.0, [A]), (1.0, 3.0, [A]))
    assert found == (1.0, 0.0, 0.0, 0.0)


def test_only_actors_that_were_there_all_the_time_count() -> None:
    """One that left or came has no beginning or no end; without any nothing is known."""
    assert after() is None
    assert after((0.0, 0.0, [A])) is None
    assert after((0.0, 0.0, []), (2.0, 1.0, [A])) is None
    found = after((0.0, 0.0, [A]), (2.0, 0.5, [spent(A, 1.0, 0.0), spent(B, 90.0, 90.0)]))
    assert found == pytest.approx((0.25, 0.5, 0.0, 0.25))


def test_it_is_known_as_soon_as_an_actor_was_seen_twice() -> None:
    """The learner had waited for it for a minute; another had been there before."""
    there, later = spent(A, 1.0, 0.0), spent(A, 2.0, 0.0)
    found = after((0.0, 0.0, []), (58.0, 0.0, [B]), (60.0, 0.0, [there]), (64.0, 1.0, [later]))
    assert found == pytest.approx((0.25, 0.25, 0.0, 0.5))


def test_looks_are_a_second_apart_and_ten_are_remembered() -> None:
    """An hour of stepping is forgotten ten seconds after it ended."""
    looks = [(0.0, 0.0, [A]), (3600.0, 0.0, [spent(A, 3600.0, 0.0)])]
    looks += [(3600.0 + n / 4, n / 4, [spent(A, 3600.0, 0.0)]) for n in range(1, 41)]
    assert after(*looks) == pytest.approx((1.0, 0.0, 0.0, 0.0))
