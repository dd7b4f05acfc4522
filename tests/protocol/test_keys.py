"""The keys of a run."""

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from a2s.protocol.errors import UsageError
from a2s.protocol.keys import MAJOR, Keys

LIVE = "a2s/2/walk/live/actor/*"


def of_version_2(keys: Keys, actor: str) -> list[str]:
    """Return the keys of a run."""
    return [
        keys.hello, keys.segment, keys.notice, keys.weights, keys.recovery,
        keys.actor_status(actor), keys.status, keys.replay_info, keys.replay_sample,
        keys.live_learner, keys.live_actor(actor), keys.hello_of(actor), keys.segment_of(actor),
    ]  # fmt: skip


REST = [
    "hello", "segment", "notice", "weights", "recovery", "actor/*", "status", "replay/info",
    "replay/sample", "live/learner", "live/actor/*", "hello/*", "segment/*",
]  # fmt: skip


def test_the_keys_are_those_of_the_protocol() -> None:
    """An actor of another language has them written in its source."""
    keys = Keys("walk")
    assert of_version_2(keys, "*") == [f"a2s/2/walk/{rest}" for rest in REST]
    assert keys.hello_of_major_1 == "a2s/walk/hello"
    assert (keys.actor_status(), keys.live_actor()) == ("a2s/2/walk/actor/*", LIVE)
    assert (keys.actor_status("h"), keys.live_actor("h")) == ("a2s/2/walk/actor/h", LIVE[:-1] + "h")
    assert MAJOR == 2


@pytest.mark.parametrize("run", ["walk", "2"])
def test_only_the_hello_of_protocol_1_is_heard(run: str) -> None:
    """Also where a run has a version's number for its name, in either protocol."""
    old = [zenoh.KeyExpr(f"a2s/{run}/{rest}") for rest in REST]
    for key in of_version_2(Keys(run), "*"):
        assert [str(k) for k in old if zenoh.KeyExpr(key).intersects(k)] == []
    assert str(old[0]) == Keys(run).hello_of_major_1


def test_no_two_keys_of_a_run_overlap() -> None:
    """Not even those of every actor: a listener of one hears nothing of another."""
    expressions = [zenoh.KeyExpr(key) for key in of_version_2(Keys("r"), "*")]
    for i, one in enumerate(expressions):
        assert [one.intersects(other) for other in expressions[:i]] == [False] * i
    other_run = zenoh.KeyExpr(Keys("other").live_actor("h"))
    assert not any(one.intersects(other_run) for one in expressions)


@given(st.from_regex(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,95}", fullmatch=True))
def test_every_valid_name_gives_valid_keys(name: str) -> None:
    """Zenoh takes them as they are, without a wildcard in them."""
    for key in of_version_2(Keys(name), name):
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
