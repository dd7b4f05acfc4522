"""The answer to every segment: exactly once, whatever is killed.

Every answer is one line of ``segments.log``, with a checksum, written before the answer is sent, so
that a restarted learner recognises the segments that an earlier one has taken.
"""

import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

import xxhash

from a2s.learner.run.writing import write_at, writing
from a2s.protocol.errors import RunDirectoryError
from a2s.protocol.messages import Verdict

_MAX_LEAP = 10_000  # of an actor
_MAX_MISSING = 100_000  # of all
_MAX_SKIPPED = 1_000_000  # by a line of the file: a journal may fill it without regard to leaps
_CHUNK_BYTES = 1 << 20
_RECORDED: tuple[Verdict, ...] = ("accepted", "stale", "refused")


@dataclass(frozen=True, slots=True, kw_only=True)
class Accounts:
    """The segments of a run: ``sent = accepted + stale + refused + lost``.

    Attributes:
        sent: Segments that actors have numbered, from the first to the last number seen of each.
        duplicate: Answers to segments that had been answered before; in no sum.
        lost: Numbered between others but never received.
    """

    sent: int = 0
    accepted: int = 0
    duplicate: int = 0
    stale: int = 0
    refused: int = 0
    lost: int = 0


@dataclass(slots=True)
class _Sender:
    """The numbers seen from one actor: ``first`` up to below ``next_seq``, but for ``missing``."""

    first: int
    next_seq: int
    missing: set[int] = field(default_factory=set)

    def saved(self) -> tuple[int, int, list[int]]:
        return self.first, self.next_seq, sorted(self.missing)

    def has(self, seq: int) -> bool:
        return self.first <= seq < self.next_seq and seq not in self.missing

    def skips(self, seq: int) -> int:
        return max(0, seq - self.next_seq, self.first - seq - 1)

    def add(self, seq: int) -> None:
        self.missing.discard(seq)
        self.missing.update(range(self.next_seq, seq), range(seq + 1, self.first))
        self.first = min(self.first, seq)
        self.next_seq = max(self.next_seq, seq + 1)


class Mark(NamedTuple):
    """What a ledger was at a moment: its first ``size`` bytes, their XXH3, and what they say."""

    size: int
    digest: str
    accepted_steps: int
    verdicts: dict[Verdict, int]
    senders: dict[str, tuple[int, int, list[int]]]  # first, next and missing numbers of each


class Ledger:
    """The answers of one run, in memory and in a file; an existing file is read first.

    ``known`` is what it was at a checkpoint, so that only later lines have to be read; a file that
    is shorter has lost its end, which the journal may know.

    Raises:
        RunDirectoryError: The file is not a ledger, or its beginning is not what is ``known``.
    """

    def __init__(self, path: Path, known: Mark | None = None) -> None:
        self._senders: dict[str, _Sender] = {}
        self._verdicts = dict.fromkeys(_RECORDED, 0)
        self._duplicates = self._missing = 0
        self.accepted_steps = 0
        self._digest, self._size = xxhash.xxh3_64(), 0
        self._path, self._lock = path, threading.Lock()
        if path.exists():
            with path.open("rb") as file:
                if known is not None and known.size <= path.stat().st_size:
                    self._trust(file, known)
                for line in _lines(file):
                    self._replay(path, line)
                    self._add(line)
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT, 0o644)
        os.ftruncate(self._file, self._size)  # a line torn by a kill was never answered

    def has(self, actor: str, seq: int) -> bool:
        """Whether this segment was answered; counts a duplicate if so."""
        is_known = self.knows(actor, seq)
        self._duplicates += is_known
        return is_known

    def knows(self, actor: str, seq: int) -> bool:
        """Whether this segment was answered; counts nothing."""
        return actor in self._senders and self._senders[actor].has(seq)

    def leaps(self, actor: str, seq: int) -> bool:
        """Whether a number is so far from those seen that it cannot be the actor's next.

        Skipped numbers are remembered, less than 10,000 of an actor and 100,000 of all.
        """
        sender = self._senders.get(actor)
        if sender is None or not (skipped := sender.skips(seq)):
            return False
        if len(sender.missing) + skipped >= _MAX_LEAP:
            return True
        return self._missing + skipped > _MAX_MISSING

    def record(self, actor: str, seq: int, verdict: Verdict, steps: int) -> None:
        """Write an answer down; it survives the death of this process when this returns.

        Raises:
            RunDirectoryError: There is no room for it.
        """
        line = _with_check(f"{actor} {seq} {verdict} {steps}")
        with self._lock, writing(self._path):
            write_at(self._file, line, self._size)
            self._add(line)
            self._count(actor, seq, verdict, steps)

    def mark(self) -> Mark:
        """What it is now; may be called on another thread than that which records."""
        with self._lock:
            return Mark(
                self._size,
                self._digest.hexdigest(),
                self.accepted_steps,
                dict(self._verdicts),
                {actor: sender.saved() for actor, sender in self._senders.items()},
            )

    def accounts(self) -> Accounts:
        """Add up all answers."""
        return Accounts(
            sent=sum(s.next_seq - s.first for s in self._senders.values()),
            lost=self._missing,
            duplicate=self._duplicates,
            **self._verdicts,
        )

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)

    def _trust(self, file: BinaryIO, known: Mark) -> None:
        """Go on from what is known of the beginning, if that is what it was."""
        while self._size < known.size:
            self._add(file.read(min(_CHUNK_BYTES, known.size - self._size)))
        if self._digest.hexdigest() != known.digest:
            raise RunDirectoryError(
                f"{self._path}: its first {known.size} bytes are not those that the checkpoint "
                "knows; restore it from a copy, or begin another run with --init-from"
            )
        self.accepted_steps, self._verdicts = known.accepted_steps, dict(known.verdicts)
        for actor, (first, next_seq, missing) in known.senders.items():
            self._senders[actor] = _Sender(first, next_seq, set(missing))
            self._missing += len(missing)

    def _add(self, lines: bytes) -> None:
        self._digest.update(lines)
        self._size += len(lines)

    def _count(self, actor: str, seq: int, verdict: Verdict, steps: int) -> None:
        sender = self._senders.setdefault(actor, _Sender(seq, seq))
        before = len(sender.missing)
        sender.add(seq)
        self._missing += len(sender.missing) - before
        self._verdicts[verdict] += 1
        if verdict == "accepted":
            self.accepted_steps += steps

    def _replay(self, path: Path, line: bytes) -> None:
        text = line[:-1].decode(errors="replace")
        answer = text.rpartition(" ")[0]
        try:
            if line != _with_check(answer):
                raise ValueError
            actor, seq, verdict, steps = answer.split(" ")
            known, number = next(v for v in _RECORDED if v == verdict), int(seq)
            sender = self._senders.get(actor)
            if number < 0 or (sender is not None and sender.skips(number) > _MAX_SKIPPED):
                raise ValueError
            self._count(actor, number, known, int(steps))
        except (ValueError, StopIteration):
            raise RunDirectoryError(f"{path}: found {text!r:.60}, expected a ledger line") from None


def _with_check(text: str) -> bytes:
    """The line of an answer: its words, and their XXH32, so that none is read as another one."""
    return f"{text} {xxhash.xxh32(text.encode()).hexdigest()}\n".encode()


def _lines(file: BinaryIO) -> Iterator[bytes]:
    """Yield every complete line, with its end."""
    yield from (line for line in file if line.endswith(b"\n"))
