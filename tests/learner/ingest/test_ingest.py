"""Ingest: what is accepted, stale and refused, and when a batch is complete."""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ingest_runs import QUOTA, IngestRun
from learners import SPACES
from segments import segment

from a2s.learner.ingest import ingest
from a2s.learner.ingest.store import Quota
from a2s.protocol.errors import RunDirectoryError
from a2s.protocol.generations import numbered
from a2s.protocol.messages import ActorStatus, Hello, Notice, Refusal, Segment, Welcome

MakeNotice = Callable[..., Notice]
NoRoom = Callable[[], AbstractContextManager[None]]


@pytest.fixture
def run(tmp_path: Path, make_notice: MakeNotice) -> IngestRun:
    run = IngestRun(tmp_path)
    run.ingest.begin(make_notice(generation=2, version=5, quota_steps=4), QUOTA, 2)
    return run


def _segment(actor: str = "a", seq: int = 0, steps: int = 4, **fields: Any) -> Segment:
    values = {"actor": actor, "generation": 2, "weights_version": 5, **fields}
    return segment(seq, steps, **values)


@pytest.mark.parametrize(
    ("fields", "verdict", "reason"),
    [
        ({}, "accepted", ""),
        ({"weights_version": 4}, "accepted", ""),
        ({"weights_version": 3}, "stale", "2 versions behind, at most 1"),
        ({"epoch": 1}, "stale", "epoch 1, this is 0"),
        ({"generation": 1}, "stale", "generation 1, this is 2"),
        ({"weights_version": 6}, "refused", "version 6 is not published"),
        ({"env": 1}, "refused", "found env 1, expected less than 1"),
        ({"actor": "stranger"}, "unknown", "actor stranger has not joined"),
        (
            {"suggestion": np.ones((4, 3), dtype=np.float32)},
            "refused",
            "found obs_size and action_size (2, 3), expected (2, 1)",
        ),
        (
            {"suggestion": np.array([[1], [0], [-1.01], [0]], dtype=np.float32)},
            "refused",
            "found suggestion 1.01, expected at most 1.001 in size",
        ),
    ],
)
def test_every_segment_is_judged_with_a_reason(
    run: IngestRun, fields: dict[str, Any], verdict: str, reason: str
) -> None:
    run.join("a")
    ack = run.send(_segment(**fields))
    assert (ack.verdict, ack.reason, ack.generation) == (verdict, reason, 2)
    assert run.complete() is (fields == {})


def test_another_learner_with_the_same_name_and_number_of_starts_gets_nothing(
    tmp_path: Path, make_notice: MakeNotice
) -> None:
    """Its seeds are the same all the same: the mark of a learner decides nothing."""
    runs = []
    for mark in (7, 8):
        path = tmp_path / str(mark)
        path.mkdir()
        runs.append(IngestRun(path, generation=numbered(1, mark)))
        notice = make_notice(generation=numbered(1, mark), version=5, quota_steps=4)
        runs[-1].ingest.begin(notice, QUOTA, 1)
    first, other = (run.join("a") for run in runs)
    assert first.generation != other.generation
    assert first.seed == other.seed
    ack = runs[1].send(_segment(generation=first.generation))
    assert (ack.verdict, ack.reason) == ("stale", "generation 1 of another run")
    assert runs[1].kept == []


def test_an_actor_gets_the_place_it_asks_for_so_that_the_order_of_joining_does_not_matter(
    run: IngestRun,
) -> None:
    first = {actor: run.join(actor, slot=slot) for actor, slot in (("b", 1), ("a", 0), ("c", 2))}
    assert {actor: welcome.slot for actor, welcome in first.items()} == {"a": 0, "b": 1, "c": 2}
    assert run.join("d", slot=1).slot == 3  # it is taken: the lowest free one
    assert run.join("e", slot=9).slot == 9
    assert run.join("f").slot == 4
    assert run.join("g", slot=4095).slot == 4095
    assert run.join("h", slot=4096).slot == 5  # a place costs memory, here and in Prometheus


def test_a_segment_is_counted_once_however_often_it_is_sent(run: IngestRun) -> None:
    run.join("a")
    verdicts = [run.send(_segment()).verdict for _ in range(3)]
    assert verdicts == ["accepted", "duplicate", "duplicate"]
    assert run.ledger.accepted_steps == 4
    assert len(run.batch()) == 1


def test_of_an_actor_that_sends_several_at_a_time_none_overtakes_another(run: IngestRun) -> None:
    """What did so is not looked at, until a hello says that it is next."""
    welcome = run.join("a", next_seq=0)
    assert welcome.window == 64
    verdicts = [run.send(_segment(seq=seq)).verdict for seq in (0, 2, 3, 1, 0, 2)]
    assert verdicts == ["accepted", "unknown", "unknown", "accepted", "duplicate", "accepted"]
    early = run.send(_segment(seq=5))
    assert (early.verdict, early.reason) == ("unknown", "seq 5 has overtaken 3")
    assert [stored.seq for stored in run.kept] == [0, 1, 2]
    assert run.ledger.accounts().lost == 0
    run.join("a", next_seq=5)
    assert run.send(_segment(seq=5)).verdict == "accepted"
    run.join("a")  # one at a time: as it likes
    assert run.send(_segment(seq=8)).verdict == "accepted"


def test_whatever_is_the_answer_the_next_one_is_next(run: IngestRun) -> None:
    run.join("a", next_seq=7)
    sent = [_segment(seq=7, generation=1), _segment(seq=8, weights_version=6), _segment(seq=9)]
    assert [run.send(each).verdict for each in sent] == ["stale", "refused", "accepted"]


def test_only_what_is_accepted_is_stored_and_what_cannot_be_stored_ends_the_run(
    run: IngestRun,
) -> None:
    """An actor that got no answer keeps its segment."""
    run.join("a")
    for sent in (_segment(), _segment(), _segment(seq=1, epoch=1)):
        run.send(sent)
    assert [stored.seq for stored in run.kept] == [0]
    run.disk_is_full = True
    with pytest.raises(RunDirectoryError, match="no space left"):
        run.send(_segment(seq=2))
    assert run.ledger.accounts().accepted == 1
    with pytest.raises(RunDirectoryError, match="no space left"):
        run.ingest.next_batch(lambda _: True)


def test_what_comes_after_the_end_is_written_into_no_file_that_was_opened_since(
    run: IngestRun, tmp_path: Path
) -> None:
    """An operating system gives the numbers of closed files to the next ones."""
    run.join("a")
    run.ingest.close()
    others = [(tmp_path / name).open("w") for name in ("one", "two")]
    with pytest.raises(RunDirectoryError, match="the learner has ended"):
        run.send(_segment())
    for other in others:
        other.close()
    assert [path.stat().st_size for path in (tmp_path / "one", tmp_path / "two")] == [0, 0]
    assert not run.kept


def test_what_cannot_be_written_down_is_not_stored_again(run: IngestRun, no_room: NoRoom) -> None:
    """However often it is sent; and nothing else is, once one has failed."""
    run.join("a")
    for seq in range(6):
        run.send(_segment(seq=seq))
    with no_room(), pytest.raises(RunDirectoryError, match="journal: File too large"):
        run.send(_segment(seq=6))
    for seq in (6, 7):
        with pytest.raises(RunDirectoryError, match="journal: File too large"):
            run.send(_segment(seq=seq))
    assert [stored.seq for stored in run.kept] == list(range(6))
    assert run.ledger.accounts().accepted == 6


def test_off_policy_no_segment_is_too_old_and_actors_are_held_back_while_learning_is_behind(
    tmp_path: Path, make_notice: MakeNotice
) -> None:
    run = IngestRun(tmp_path, max_policy_lag=None, clock="async")
    run.ingest.begin(make_notice(generation=2, version=500, quota_steps=4), QUOTA, 2)
    run.join("a")
    first = run.send(_segment(seq=0, weights_version=1))
    assert (first.verdict, first.wait_s) == ("accepted", 0.0)
    run.is_far_behind = True
    assert run.send(_segment(seq=1)).wait_s == 1.5
    stale = run.send(_segment(seq=2, generation=1))
    assert (stale.verdict, stale.wait_s) == ("stale", 0.0)  # what is left of before goes quickly


def test_a_batch_is_complete_when_every_environment_of_every_actor_has_its_quota(
    run: IngestRun,
) -> None:
    """Its order is not that of arrival."""
    run.join("a", num_envs=2)
    run.join("b")
    run.send(_segment("b", 0, steps=3))
    run.send(_segment("a", 1, env=1))
    run.send(_segment("a", 0, env=0))
    assert not run.complete()
    run.send(_segment("b", 1, steps=1))
    assert [arrival[:3] for arrival in run.batch()] == [
        (0, 0, 0), (0, 1, 1), (1, 0, 0), (1, 0, 1),
    ]  # fmt: skip


def test_whole_episodes_are_waited_for(tmp_path: Path, make_notice: MakeNotice) -> None:
    run = IngestRun(tmp_path)
    notice = make_notice(generation=2, version=5, quota_steps=4, quota_episodes=2)
    run.ingest.begin(notice, QUOTA, 2)
    run.join("a")
    run.send(_segment(seq=0, terminated=True))
    run.send(_segment(seq=1))
    assert not run.complete()
    run.send(_segment(seq=2, truncated=True))
    assert len(run.batch()) == 3


def test_a_quota_of_long_episodes_is_taken_however_much_it_is(
    tmp_path: Path, make_notice: MakeNotice
) -> None:
    """Five episodes of 8 where a batch has 8 steps: an async learner would take four."""
    run = IngestRun(tmp_path)
    run.ingest.begin(
        make_notice(generation=2, version=5, quota_steps=8, quota_episodes=5), Quota(8, 8, 5), 2
    )
    run.join("a")
    acks = [run.send(_segment(seq=i, steps=8, terminated=True)) for i in range(5)]
    assert [ack.verdict for ack in acks] == ["accepted"] * 5
    assert len(run.batch()) == 5


def test_a_segment_is_no_longer_than_the_largest_quota(
    run: IngestRun, make_notice: MakeNotice
) -> None:
    """An actor may still be playing an earlier one."""
    run.join("a")
    found = [run.send(_segment(seq=steps, steps=steps)) for steps in (4, 5)]
    assert [ack.verdict for ack in found] == ["accepted", "refused"]
    assert found[1].reason == "found 5 steps, expected at most 4: that was the largest quota"
    smaller = make_notice(generation=2, version=6, quota_steps=2)
    run.ingest.begin(smaller, Quota(8, 2, 0), 4)
    assert run.send(_segment(seq=6, steps=4)).verdict == "accepted"


@pytest.mark.parametrize(("limit", "longest"), [(0, 10_000), (1000, 10_000), (12_000, 12_000)])
def test_where_whole_episodes_are_played_a_segment_is_no_longer_than_one(
    tmp_path: Path, make_notice: MakeNotice, limit: int, longest: int
) -> None:
    run = IngestRun(tmp_path, episode_limit=limit)
    whole = make_notice(generation=2, version=5, quota_steps=8, quota_episodes=5)
    run.ingest.begin(whole, Quota(8, 8, 5), 2)
    run.join("a")
    sent = [_segment(seq=steps, steps=steps) for steps in (longest, longest + 1)]
    assert [run.send(each).verdict for each in sent] == ["accepted", "refused"]


def test_an_actor_that_leaves_is_no_longer_waited_for(run: IngestRun) -> None:
    run.join("a")
    run.join("b")
    run.send(_segment("a"))
    assert not run.complete()
    run.ingest.gone("b")
    assert run.complete()
    assert ("leave", {"actor": "b", "slot": 1, "reason": "lost"}) in run.events


@pytest.mark.parametrize("gone_first", [False, True])
def test_why_an_actor_cannot_join_is_said_once(
    run: IngestRun, caplog: pytest.LogCaptureFixture, *, gone_first: bool
) -> None:
    """Whether its last words or the end of its connection is heard of first."""
    run.ingest.hello(Hello(actor="a", num_envs=0, env_id="", spaces=None))
    last = ActorStatus(
        actor="a", slot=-1, weights_version=0, epoch=0, env_steps=0, episodes=0, segments_sent=0,
        segments_answered=0, spooled_steps=0, leaving=True, trouble="no such environment",
    )  # fmt: skip
    if gone_first:
        run.ingest.gone("a")
    run.ingest.status(last)
    run.ingest.gone("a")
    run.ingest.status(last)
    assert caplog.messages == ["actor a cannot join: no such environment"]


def test_a_replacement_takes_the_free_place_with_another_seed(run: IngestRun) -> None:
    first, other = run.join("a"), run.join("b")
    run.ingest.gone("a")
    second = run.join("c")
    assert (first.slot, other.slot, second.slot) == (0, 1, 0)
    assert first.seed != second.seed


def test_who_cannot_be_seen_does_not_join(run: IngestRun) -> None:
    """Nobody would see it leave; it is not answered, so it asks again until its token is there."""
    hello = Hello(actor="a", num_envs=1, env_id="Test-v0", spaces=SPACES)
    assert run.ingest.hello(hello) is None
    waiting: list[str] = []

    def once(missing: str) -> bool:
        waiting.append(missing)
        return False

    run.ingest.next_batch(once)
    assert waiting == ["1 more of 1 actors: a: joins without its token"]
    run.ingest.here("a")
    assert isinstance(run.ingest.hello(hello), Welcome)
    run.ingest.gone("a")
    assert run.ingest.hello(hello) is None
    assert run.ingest.attendance().members == ()


def test_members_that_are_silent_have_no_share_of_the_quota(run: IngestRun) -> None:
    """Unless all are: then it was the learner that heard nothing."""
    run.join("a")
    for silent in "bcd":
        run.join(silent, num_envs=100)
    members = run.ingest.attendance().members
    assert run.ingest.num_envs == 301
    for member in members[1:]:
        member.heard_s -= 31.0
    assert run.ingest.num_envs == 1
    members[0].heard_s -= 31.0
    assert run.ingest.num_envs == 301
    run.send(_segment("d"))
    assert run.ingest.num_envs == 100


def test_who_has_left_is_expected_back_with_as_many_environments(run: IngestRun) -> None:
    """Weights that come out meanwhile are for them: one environment alone would play a batch."""
    run.join("a", num_envs=3)
    run.join("b", num_envs=4)
    assert run.ingest.num_envs == 7
    run.ingest.gone("b")
    assert run.ingest.num_envs == 3
    run.ingest.gone("a")
    assert run.ingest.num_envs == 3


def test_a_run_has_at_most_so_many_environments(run: IngestRun) -> None:
    for number in range(16):
        run.join(f"a{number}", num_envs=4096)
    run.ingest.here("b")
    one_more = Hello(actor="b", num_envs=1, env_id="Test-v0", spaces=SPACES)
    refusal = run.ingest.hello(one_more)
    assert isinstance(refusal, Refusal)
    assert refusal.reason == "num_envs: found 1 beside 65536, expected 65536 in all"
    assert run.join("a0", num_envs=4096).slot == 0  # a member is welcome again
    run.ingest.gone("a0")
    assert run.join("b").slot == 0


def test_a_member_of_whom_nothing_comes_is_one_no_more_until_it_sends(
    run: IngestRun, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The batch is made without it, and it is named."""
    run.join("a")
    run.join("b")
    now_s = time.monotonic() + 301.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    run.send(_segment("a"))
    assert [arrival.slot for arrival in run.batch()] == [0]
    assert ("leave", {"actor": "b", "slot": 1, "reason": "stalled"}) in run.events
    assert "actor b: nothing came of it for 301 s; going on without it until it sends" in (
        caplog.text
    )
    late = _segment("b")
    assert run.send(late).verdict == "unknown"
    run.join("b")
    assert run.send(late).verdict == "accepted"


def test_an_actor_that_was_cut_off_goes_on_where_it_was(run: IngestRun) -> None:
    """Its segment is not answered while it is away, so it is sent again and not lost."""
    run.join("a", num_envs=2)
    run.send(_segment("a", 0, env=0))
    run.ingest.gone("a")
    late = _segment("a", 1, env=1)
    assert run.send(late).verdict == "unknown"
    run.join("a", num_envs=2)
    assert run.send(late).verdict == "accepted"
    assert len(run.batch()) == 2


def test_a_number_out_of_all_order_is_refused_at_once(run: IngestRun) -> None:
    run.join("a")
    run.send(_segment(seq=0))
    ack = run.send(_segment(seq=2**62))
    assert (ack.verdict, ack.reason) == ("refused", f"seq {2**62} is far from the others")
    assert run.ledger.accounts().sent == 1


def test_refused_segments_fill_no_disk(
    run: IngestRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are answered all the same, and what can be used is still written down."""
    monkeypatch.setattr(ingest, "_MAX_USELESS", 5)
    run.join("a")
    sent = [_segment(seq=i, env=7) for i in range(20)]
    sent += [_segment(seq=i, generation=1) for i in range(20, 40)]
    verdicts = [run.send(each).verdict for each in sent]
    assert verdicts == ["refused"] * 20 + ["stale"] * 20
    assert run.send(_segment(seq=40)).verdict == "accepted"
    assert (tmp_path / "segments.log").read_text().count("\n") == 5 + 1
    assert sum(kind == "refusal" for kind, _ in run.events) == 10


def test_what_is_left_of_an_earlier_learner_is_counted_once_its_sender_is_seen(
    run: IngestRun,
) -> None:
    """A name that nobody has would cost memory and disk."""
    late = _segment("a", generation=1)
    assert run.send(late).verdict == "unknown"
    run.ingest.here("a")
    assert run.send(late).verdict == "stale"


def test_joining_twice_keeps_the_place_and_the_seed(run: IngestRun) -> None:
    first, again = run.join("a"), run.join("a")
    assert (first.slot, first.seed) == (again.slot, again.seed)
    assert [kind for kind, _ in run.events] == ["join"]


def test_asking_is_not_joining(run: IngestRun) -> None:
    welcome = run.ingest.hello(Hello(actor="a", num_envs=0, env_id="", spaces=None))
    assert isinstance(welcome, Welcome)
    assert (welcome.slot, welcome.env_id, welcome.num_envs) == (-1, "Test-v0", 2)
    assert run.ingest.attendance().members == ()


def test_other_spaces_are_refused_with_the_difference(run: IngestRun) -> None:
    wide = replace(SPACES, obs_size=3)
    refusal = run.ingest.hello(Hello(actor="a", num_envs=1, env_id="Test-v0", spaces=wide))
    assert isinstance(refusal, Refusal)
    assert refusal.reason == "environment Test-v0: found obs_size 3, expected 2"
    counted = run.metrics.refused.labels(message="hello", reason="environment")
    assert counted._value.get() == 1


def test_a_reason_is_short_whatever_was_sent(run: IngestRun) -> None:
    hello = Hello(actor="a", num_envs=1, env_id="x\n" * 400_000, spaces=SPACES)
    refusal = run.ingest.hello(hello)
    assert isinstance(refusal, Refusal)
    assert len(refusal.reason) <= 500
    assert refusal.reason.isprintable()


def test_a_recovery_forgets_what_waits(run: IngestRun, make_notice: MakeNotice) -> None:
    run.join("a")
    run.send(_segment(seq=0))
    run.ingest.begin(
        make_notice(generation=2, version=6, epoch=1, quota_steps=4), Quota(8, 4, 0), 2
    )
    run.send(_segment(seq=1, weights_version=6, epoch=1))
    assert [arrival.seq for arrival in run.batch()] == [1]


def test_async_batches_are_counted_in_steps_and_hold_actors_back(
    tmp_path: Path, make_notice: MakeNotice
) -> None:
    """Batches of 8: held back when one waits, taken no more when four do."""
    run = IngestRun(tmp_path, clock="async")
    run.ingest.begin(make_notice(generation=2, version=5, quota_steps=4), QUOTA, 2)
    run.join("a")
    acks = [run.send(_segment(seq=seq)) for seq in range(10)]
    assert [ack.wait_s > 0 for ack in acks] == [False] + [True] * 9
    assert [ack.verdict for ack in acks] == ["accepted"] * 8 + ["stale"] * 2
    assert len(run.batch()) == 8


def test_a_clean_goodbye_is_told_from_a_lost_actor(run: IngestRun) -> None:
    run.join("a")
    status = ActorStatus(
        actor="a", slot=0, weights_version=5, epoch=0, env_steps=1, episodes=0, segments_sent=1,
        segments_answered=1, spooled_steps=0, leaving=True,
    )  # fmt: skip
    run.ingest.status(status)
    run.ingest.gone("a")
    assert [d["reason"] for kind, d in run.events if kind == "leave"] == ["clean"]


def test_waiting_says_what_for(run: IngestRun) -> None:
    heard: list[str] = []

    def once(missing: str) -> bool:
        heard.append(missing)
        return False

    run.ingest.next_batch(once)
    run.join("a")
    run.ingest.next_batch(once)
    run.ingest.gone("a")
    run.ingest.next_batch(once)
    assert heard == [
        "1 more of 1 actors: start `a2s actor` unless it starts already",
        "segments of version 5 from actors [0]",
        "actors: none is present, start `a2s actor` unless it starts already",
    ]


def test_the_first_batch_waits_for_all_actors_that_are_expected(
    tmp_path: Path, make_notice: MakeNotice
) -> None:
    """Later ones do not: two actors with two environments each are expected, one plays on."""
    run = IngestRun(tmp_path, n=2)
    run.ingest.begin(make_notice(generation=2, version=5, quota_steps=4), QUOTA, 2)
    assert run.ingest.num_envs == 4
    run.join("a")
    run.send(_segment("a"))
    assert not run.complete()
    run.join("b")
    run.send(_segment("b"))
    assert run.complete()
    run.ingest.gone("b")
    assert run.ingest.num_envs == 1
