"""The keys of a run."""

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from a2s.protocol.codec import SCHEMA_VERSION
from a2s.protocol.errors import UsageError
from a2s.protocol.keys import MAJOR, Keys


def all_keys(keys: Keys, actor: str) -> list[str]:
    """Return every key of a run."""
    return [
        keys.hello,
        keys.hello_of_major_1,
        keys.segment,
        keys.notice,
        keys.weights,
        keys.recovery,
        keys.actor_status(actor),
        keys.status,
        keys.replay_info,
        keys.replay_sample,
        keys.live_learner,
        keys.live_actor(actor),
    ]


def test_the_keys_are_those_of_the_protocol() -> None:
    """An actor of another language has them written in its source."""
    assert all_keys(Keys("walk"), "h-1") == [
        "a2s/2/walk/hello",
        "a2s/walk/hello",
        "a2s/2/walk/segment",
        "a2s/2/walk/notice",
        "a2s/2/walk/weights",
        "a2s/2/walk/recovery",
        "a2s/2/walk/actor/h-1",
        "a2s/2/walk/status",
        "a2s/2/walk/replay/info",
        "a2s/2/walk/replay/sample",
        "a2s/2/walk/live/learner",
        "a2s/2/walk/live/actor/h-1",
    ]


def test_the_major_version_of_keys_and_messages_is_the_same() -> None:
    """A peer of another one hears silence, or is refused."""
    assert MAJOR == SCHEMA_VERSION == 2


def keys_of_major_1(run: str) -> list[str]:
    """Return every key that protocol 1 had for a run, of every actor."""
    rest = (
        "hello", "segment", "notice", "weights", "recovery", "actor/*", "status", "replay/info",
        "replay/sample", "live/learner", "live/actor/*",
    )  # fmt: skip
    return [f"a2s/{run}/{name}" for name in rest]


@pytest.mark.parametrize("run", ["walk", "2"])
def test_only_the_hello_of_protocol_1_is_heard(run: str) -> None:
    """Also where a run has a version's number for its name, in either protocol."""
    old = [zenoh.KeyExpr(key) for key in keys_of_major_1(run)]
    for key in all_keys(Keys(run), "*"):
        heard = [str(k) for k in old if zenoh.KeyExpr(key).intersects(k)]
        assert heard == ([key] if key == Keys(run).hello_of_major_1 else [])


def test_no_two_keys_of_a_run_overlap() -> None:
    """Not even those of every actor: a listener of one hears nothing of another."""
    expressions = [zenoh.KeyExpr(key) for key in all_keys(Keys("r"), "*")]
    for i, one in enumerate(expressions):
        assert [one.intersects(other) for other in expressions[:i]] == [False] * i


def test_the_keys_of_every_actor_include_those_of_each() -> None:
    """But not those of another run's."""
    every, keys = Keys("r"), Keys("r")
    for wide, narrow in (
        (every.actor_status(), keys.actor_status("h-1")),
        (every.live_actor(), keys.live_actor("h-1")),
    ):
        assert zenoh.KeyExpr(wide).includes(zenoh.KeyExpr(narrow))
    assert not zenoh.KeyExpr(every.live_actor()).includes(
        zenoh.KeyExpr(Keys("other").live_actor("h-1"))
    )


@given(st.from_regex(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,95}", fullmatch=True))
def test_every_valid_name_gives_valid_keys(name: str) -> None:
    """Zenoh takes them as they are, without a wildcard in them."""
    for key in all_keys(Keys(name), name):
        assert str(zenoh.KeyExpr(key)) == str(zenoh.KeyExpr.autocanonize(key)) == key
        assert "*" not in key


@pytest.mark.parametrize(
    "name",
    ["", "*", "**", "a/b", "a b", "a\n", "\n", ".", "..", "-x", "a$*", "a?b", "a#b", "@a", "é",
     "a" * 97],
)  # fmt: skip
def test_a_name_that_cannot_be_part_of_a_key_is_refused(name: str) -> None:
    """The user typed it, so the user is told what a name may be."""
    with pytest.raises(UsageError) as caught:
        Keys(name)
    assert str(caught.value) == (
        f"run name: found {name!r}, "
        "expected at most 96 of letters, digits, _ . -, beginning with no . or -"
    )
