"""The accounts: exactly once, whatever is killed, and they always balance."""

import json
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
import xxhash
from hypothesis import given
from hypothesis import strategies as st

from a2s.learner.ingest.ledger import Accounts, Ledger, Mark
from a2s.protocol.errors import RunDirectoryError
from a2s.protocol.messages import Verdict

NoRoom = Callable[[], AbstractContextManager[None]]
EVENTS = st.lists(
    st.tuples(
        st.sampled_from(["a", "b"]),
        st.integers(0, 12),
        st.sampled_from(["accepted", "stale", "refused"]),
    )
)


def line(text: str) -> str:
    """As docs/run-directory.md has it."""
    return f"{text} {xxhash.xxh32(text.encode()).hexdigest()}\n"


def _balances(accounts: Accounts) -> bool:
    parts = accounts.accepted + accounts.stale + accounts.refused + accounts.lost
    return accounts.sent == parts


def test_a_segment_is_known_from_its_first_answer_on(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "segments.log")
    assert not ledger.has("a", 0)
    ledger.record("a", 0, "accepted", 100)
    assert ledger.has("a", 0)
    assert not ledger.has("b", 0)
    assert ledger.accounts() == Accounts(
        sent=1, accepted=1, duplicate=1, stale=0, refused=0, lost=0
    )


def test_a_gap_in_the_numbers_is_lost_until_it_is_filled(tmp_path: Path) -> None:
    """Numbers begin where the actor is: it may have served an earlier run."""
    ledger = Ledger(tmp_path / "segments.log")
    for seq, sent, lost in [(7, 1, 0), (10, 4, 2), (8, 4, 1), (5, 6, 2)]:
        ledger.record("a", seq, "accepted", 5)
        assert (ledger.accounts().sent, ledger.accounts().lost) == (sent, lost)


def test_a_number_far_away_is_recognised_without_being_counted_to(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "segments.log")
    assert not ledger.leaps("a", 2**62)
    ledger.record("a", 5, "accepted", 5)
    far = [ledger.leaps("a", seq) for seq in (6, 10_005, 10_006, 2**62)]
    assert far == [False, False, True, True]


def test_what_is_skipped_is_bounded_however_often_an_actor_leaps(tmp_path: Path) -> None:
    """Else hundreds of megabytes of numbers would be remembered."""
    ledger, refused = Ledger(tmp_path / "segments.log"), 0
    for actor in "abcdefghijklmnopq":
        seq = 0
        for _ in range(5):
            if ledger.leaps(actor, seq):
                refused += 1
            else:
                ledger.record(actor, seq, "accepted", 1)
            seq += 6_000
    assert refused == 17 * 3 + 1  # more than 10,000 of an actor; at last more than 100,000 of all
    assert ledger.accounts().lost == 16 * 5_999


@given(events=EVENTS)
def test_accounts_balance_and_survive_a_restart(
    tmp_path_factory: pytest.TempPathFactory, events: list[tuple[str, int, str]]
) -> None:
    path = tmp_path_factory.mktemp("ledger") / "segments.log"
    ledger = Ledger(path)
    for actor, seq, verdict in events:
        if not ledger.has(actor, seq):
            ledger.record(actor, seq, verdict, 3)  # type: ignore[arg-type]
    before = ledger.accounts()
    assert _balances(before)
    assert before.duplicate + before.sent - before.lost == len(events)
    ledger.close()
    again = Ledger(path)
    for name in ("sent", "accepted", "stale", "refused", "lost"):
        assert getattr(again.accounts(), name) == getattr(before, name)
    assert again.accepted_steps == 3 * before.accepted
    assert all(again.has(actor, seq) for actor, seq, _ in events)


def test_a_line_torn_by_a_kill_is_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "segments.log"
    path.write_text(line("a 0 accepted 7") + line("a 1 accepted 7")[:-1])
    ledger = Ledger(path)
    assert (ledger.has("a", 0), ledger.has("a", 1)) == (True, False)
    ledger.record("a", 1, "stale", 7)
    ledger.close()
    assert path.read_text() == line("a 0 accepted 7") + line("a 1 stale 7")


def test_what_a_checkpoint_knows_of_it_cannot_change_unseen(tmp_path: Path) -> None:
    """Not a bit; lines after that are not known, and an end that is missing is for the journal."""
    path = tmp_path / "segments.log"
    ledger = Ledger(path)
    for seq in range(3):
        ledger.record("a", seq, "accepted", 7)
    known = ledger.mark()
    ledger.record("a", 3, "accepted", 7)
    ledger.close()
    whole = path.read_bytes()
    assert known.size == len(whole) * 3 // 4
    for place in range(len(whole)):
        for bit in range(8):
            damaged = bytearray(whole)
            damaged[place] ^= 1 << bit
            path.write_bytes(damaged)
            if place < known.size:
                with pytest.raises(RunDirectoryError, match=r"segments\.log"):
                    Ledger(path, known)
    path.write_bytes(whole)
    again = Ledger(path, known)
    assert (again.accepted_steps, again.mark().size) == (28, len(whole))
    again.close()
    path.write_bytes(whole[: known.size - 1])
    assert Ledger(path, known).accepted_steps == 14


@given(events=EVENTS, then=EVENTS)
def test_what_a_checkpoint_knows_is_what_its_lines_say(
    tmp_path_factory: pytest.TempPathFactory,
    events: list[tuple[str, int, Verdict]],
    then: list[tuple[str, int, Verdict]],
) -> None:
    """The same ledger, from all lines or from a mark that was JSON and the lines after it."""
    path = tmp_path_factory.mktemp("ledger") / "segments.log"
    ledger, known = Ledger(path), None
    for part in (events, then):
        for actor, seq, verdict in part:
            if not ledger.knows(actor, seq):
                ledger.record(actor, seq, verdict, 3)
        known = known or Mark(*json.loads(json.dumps(ledger.mark())))
    ledger.close()
    again, whole = Ledger(path, known), Ledger(path)
    assert again.accounts() == whole.accounts() == ledger.accounts()
    assert again.mark() == whole.mark() == ledger.mark()


def test_lines_before_the_mark_are_not_read_again(tmp_path: Path) -> None:
    """Only compared: what they say is in the mark."""
    path = tmp_path / "segments.log"
    ledger = Ledger(path)
    ledger.record("a", 0, "accepted", 7)
    known = ledger.mark()._replace(accepted_steps=1000)
    ledger.record("a", 1, "accepted", 7)
    assert Ledger(path, known).accepted_steps == 1007


def test_a_file_of_another_kind_is_refused_and_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "segments.log"
    path.write_text("wall_s,return\n1,2\n")
    with pytest.raises(RunDirectoryError, match=r"segments\.log: found 'wall_s,return'"):
        Ledger(path)
    assert path.read_text() == "wall_s,return\n1,2\n"


@pytest.mark.parametrize("text", ["a -1 accepted 5", f"a {2**63 - 1} stale 5"])
def test_a_line_with_a_number_that_cannot_be_is_refused(tmp_path: Path, text: str) -> None:
    """The numbers that it skips are remembered, each of them."""
    path = tmp_path / "segments.log"
    path.write_text(line("a 3 accepted 5") + line(text))
    with pytest.raises(RunDirectoryError, match=f"found '{text} .*', expected a ledger line"):
        Ledger(path)


def test_no_flipped_bit_is_read_as_another_answer(tmp_path: Path) -> None:
    """A flip in an end of line may join two lines, or hide that the last one is whole."""
    path, whole = tmp_path / "segments.log", b""
    for text in ("a 0 accepted 7", "b 8 stale 31"):
        whole += line(text).encode()
    for place in range(len(whole)):
        for bit in range(8):
            damaged = bytearray(whole)
            damaged[place] ^= 1 << bit
            path.write_bytes(damaged)
            if place == len(whole) - 1:
                assert Ledger(path).accounts().sent == 1  # as if a kill had torn it
            else:
                with pytest.raises(RunDirectoryError, match=r"segments\.log: found"):
                    Ledger(path)


def test_an_answer_for_which_there_is_no_room_leaves_no_trace(
    tmp_path: Path, no_room: NoRoom
) -> None:
    """Also not a half of its line, which the next would be glued to."""
    path = tmp_path / "segments.log"
    ledger = Ledger(path)
    for seq in range(4):
        ledger.record("a", seq, "accepted", 4)
    with no_room(), pytest.raises(RunDirectoryError, match=r"File too large; mend that and resume"):
        ledger.record("a", 4, "accepted", 4)
    assert path.stat().st_size == 100
    assert not ledger.knows("a", 4)
    ledger.record("b", 0, "accepted", 4)
    ledger.close()
    again = Ledger(path)
    assert again.accounts() == ledger.accounts()
    assert again.accepted_steps == 20
