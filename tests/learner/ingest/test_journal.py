"""The journal: what was written is read again, from any checkpoint, or refused by name."""

import logging
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import pytest
from segments import segment

from a2s.learner.ingest.journal import (
    Begun,
    Journal,
    Place,
    Record,
    Stored,
    Taken,
    has,
    read,
    without,
)
from a2s.learner.ingest.journal_feed import JournalFeed, read_again
from a2s.learner.ingest.ledger import Ledger
from a2s.learner.ingest.store import Quota
from a2s.protocol.codec import encode
from a2s.protocol.errors import RunDirectoryError
from a2s.protocol.messages import Segment

NoRoom = Callable[[], AbstractContextManager[None]]


class _Store:
    """Remembers what it is told."""

    max_policy_lag: int | None = None
    max_suggestion = 1.0
    short_steps = 0

    def __init__(self) -> None:
        self.told: list[object] = []

    def quota(self, num_envs: int) -> Quota:
        self.told.append(("quota", num_envs))
        return Quota(1, 1, 0)

    def store(self, slot: int, segment: Segment) -> None:
        self.told.append((slot, segment.seq))

    def close_batch(self) -> None:
        self.told.append("batch")

    def hold_s(self, num_batches: float) -> float:
        raise NotImplementedError


def _write(journal: Journal, ledger: Ledger, slot: int, seq: int, epoch: int = 0) -> None:
    """As the ingest does: the journal before the ledger."""
    made = segment(seq, 4, epoch=epoch)
    journal.segment(slot, encode(made))
    ledger.record(made.actor, made.seq, "accepted", made.num_steps)


def _begun(num_envs: int, epoch: int = 0) -> Begun:
    return Begun(3, epoch, num_envs, Quota(8, 4, 2))


@pytest.fixture
def ledger(tmp_path: Path) -> Ledger:
    return Ledger(tmp_path / "segments.log")


def test_batches_come_again_in_their_order_and_what_waited_is_left(
    tmp_path: Path, ledger: Ledger
) -> None:
    journal = Journal(tmp_path / "journal")
    start = journal.place
    journal.begin(_begun(2))
    for slot, seq in ((1, 0), (0, 1)):
        _write(journal, ledger, slot, seq)
    journal.take(ledger.accepted_steps)
    journal.begin(_begun(3))
    _write(journal, ledger, 1, 2)
    again, store = Journal(tmp_path / "journal"), _Store()
    feed = JournalFeed(again, read_again(again, start, ledger), store)
    arrivals = feed.next_batch(lambda _: True)
    assert [(each.slot, each.seq, each.num_steps) for each in arrivals] == [(0, 1, 4), (1, 0, 4)]
    assert again.place == journal.place == Place(0, again.place.end, 8)
    assert feed.next_batch(lambda _: True) == []
    left = feed.left_over
    assert [(slot, each.seq) for slot, each in left.stored] == [(1, 2)]
    assert left.quota(3, 0) == Quota(8, 4, 2)
    assert left.quota(3, 1) is left.quota(4, 0) is None
    assert store.told == [("quota", 2), (1, 0), (0, 1), "batch", ("quota", 3), (1, 2)]


def test_a_stopped_reader_has_taken_nothing(tmp_path: Path, ledger: Ledger) -> None:
    journal = Journal(tmp_path / "journal")
    start = journal.place
    _write(journal, ledger, 0, 0)
    journal.take(4)
    again = Journal(tmp_path / "journal")
    again.place = start
    feed = JournalFeed(again, read_again(again, start, ledger), _Store())
    assert feed.next_batch(lambda _: False) == []
    assert again.place == start


def test_segments_of_before_a_recovery_are_forgotten(tmp_path: Path, ledger: Ledger) -> None:
    journal, store = Journal(tmp_path / "journal"), _Store()
    start = journal.place
    _write(journal, ledger, 0, 0)
    journal.begin(_begun(1, epoch=1))
    _write(journal, ledger, 0, 1, epoch=1)
    journal.take(8)
    feed = JournalFeed(journal, read_again(journal, start, ledger), store)
    assert [each.seq for each in feed.next_batch(lambda _: True)] == [1]
    assert store.told == [(0, 0), ("quota", 1), "batch", (0, 1), "batch"]


def test_a_segment_comes_back_as_it_was(tmp_path: Path) -> None:
    journal, made = Journal(tmp_path / "journal"), segment(7, 5, episode_return=0.1)
    start = journal.place
    journal.segment(3, encode(made))
    journal.begin(_begun(9, epoch=2))
    (stored, begun), _ = read(journal.folder, start)
    assert isinstance(stored, Stored)
    assert (stored.slot, begun) == (3, _begun(9, epoch=2))
    for name in ("obs", "suggestion", "log_prob", "reward", "final_obs"):
        np.testing.assert_array_equal(getattr(stored.segment, name), getattr(made, name))
    assert stored.segment.episode_return == 0.1


def _records(folder: Path, place: Place) -> list[Record]:
    return read(folder, place)[0]


def test_of_a_torn_end_nothing_was_answered(tmp_path: Path) -> None:
    """Wherever it is torn; the next record takes its place."""
    journal = Journal(tmp_path / "journal")
    journal.segment(0, encode(segment(0)))
    whole = (tmp_path / "journal" / "00000000").read_bytes()
    journal.take(4)
    longer = (tmp_path / "journal" / "00000000").read_bytes()
    for end in range(len(whole), len(longer)):
        (tmp_path / "journal" / "00000000").write_bytes(longer[:end])
        again = Journal(tmp_path / "journal")
        records, size = read(again.folder, Place())
        assert len(records) == 1
        again.cut(size)
        again.begin(_begun(1))
        assert [type(each) for each in read(again.folder, Place())[0]] == [Stored, Begun]


def test_every_flipped_byte_before_the_last_record_is_seen(tmp_path: Path, ledger: Ledger) -> None:
    """By its checksum; or by the ledger, if it looks like a torn end."""
    journal = Journal(tmp_path / "journal")
    start = journal.place
    for seq in range(2):
        _write(journal, ledger, 0, seq)
    journal.take(8)
    file = tmp_path / "journal" / "00000000"
    whole = file.read_bytes()
    last = len(whole) - 17
    for at in range(0, last, 3):
        file.write_bytes(whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :])
        damaged = file.read_bytes()
        with pytest.raises(RunDirectoryError, match=r"journal.* delete .*journal to go on from"):
            read_again(Journal(tmp_path / "journal"), start, ledger)
        assert file.read_bytes() == damaged
        file.write_bytes(whole)
    assert len(read_again(Journal(tmp_path / "journal"), start, ledger)) == 3


@pytest.mark.parametrize(
    ("steps", "lost"),
    [
        (1200, "the 200 steps since then count and are not learned from"),
        (1000, "nothing came after that, and nothing is lost"),
        (0, "segments.log has 1,000 steps fewer than that, what is lost is unknown"),
    ],
)
def test_what_is_lost_with_a_journal_is_said(steps: int, lost: str) -> None:
    assert without(Place(accepted_steps=1000), steps).partition("; ")[2] == lost


def test_what_the_ledger_has_lost_is_written_into_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """An actor that sends it again is told that it was accepted."""
    journal, ledger = Journal(tmp_path / "journal"), Ledger(tmp_path / "segments.log")
    start = journal.place
    for seq in range(2):
        _write(journal, ledger, 0, seq)
    ledger.close()
    lines = (tmp_path / "segments.log").read_text().splitlines(keepends=True)
    (tmp_path / "segments.log").write_text("".join(lines[:1]))
    again = Ledger(tmp_path / "segments.log")
    assert not again.knows("a", 1)
    read_again(journal, start, again)
    assert again.knows("a", 1)
    assert (tmp_path / "segments.log").read_text() == "".join(lines)
    assert not caplog.text
    with caplog.at_level(logging.WARNING):
        read_again(journal, start._replace(accepted_steps=12), again)
    assert "segments.log: 12 steps fewer than were learned from" in caplog.text


def test_files_go_with_the_checkpoints_that_need_them(tmp_path: Path) -> None:
    """Three checkpoints are kept; what waited at the oldest is in the file before its own."""
    journal = Journal(tmp_path / "journal")
    places = []
    for seq in range(6):
        journal.segment(0, encode(segment(seq)))
        journal.take(4 * (seq + 1))
        journal.segment(0, encode(segment(100 + seq)))  # waits
        places.append(journal.place)
        journal.roll(places[-3:][0])
    for place in places[-3:]:
        assert has(journal.folder, place)
        waits = next(iter(_records(tmp_path / "journal", place)))
        assert isinstance(waits, Stored)
        assert waits.segment.seq == 100 + place.accepted_steps // 4 - 1
    assert not has(journal.folder, places[0])
    assert len(list((tmp_path / "journal").iterdir())) == 4
    journal.roll(places[-3])
    assert len(list((tmp_path / "journal").iterdir())) == 4  # nothing was written since
    (end,) = (r for r in _records(tmp_path / "journal", places[-2]) if isinstance(r, Taken))
    assert end.end == places[-1]


def test_threads_append_while_files_are_begun(tmp_path: Path) -> None:
    """Nothing is torn, lost or out of order."""
    journal = Journal(tmp_path / "journal")

    def write() -> None:
        for seq in range(300):
            journal.segment(0, encode(segment(seq)))

    writer = threading.Thread(target=write)
    writer.start()
    while writer.is_alive():
        journal.roll(Place())
    writer.join()
    records, _ = read(journal.folder, Place())
    assert [each.segment.seq for each in records if isinstance(each, Stored)] == list(range(300))
    assert len(list(journal.folder.iterdir())) > 1


def test_other_files_are_not_its_own(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal")
    (tmp_path / "journal" / "00000001.bak").touch()
    journal.segment(0, encode(segment(0)))
    assert len(_records(tmp_path / "journal", Place())) == 1


def test_where_there_is_no_room_it_says_so(tmp_path: Path, no_room: NoRoom) -> None:
    journal = Journal(tmp_path / "journal")
    with no_room(), pytest.raises(RunDirectoryError, match="journal: File too large; mend that"):
        journal.segment(0, encode(segment(0)))
