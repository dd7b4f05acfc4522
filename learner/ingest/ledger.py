"""The answer to every segment: exactly once, whatever is killed.

Every answer is one line of ``segments.log``, written before the answer is sent, so that a
restarted learner recognises the segments that an earlier one has taken.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import xxhash

from a2s.learner.run.writing import write_at, writing
from a2s.protocol.errors import RunDirectoryError
from a2s.protocol.messages import Verdict

_MAX_LEAP = 10_000  # of an actor
_MAX_MISSING = 100_000  # of all
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
    """What a ledger was at a moment: its first ``size`` bytes, and their XXH3, 64 bits."""

    size: int
    digest: str


class Ledger:
    """The answers of one run, in memory and in a file; an existing file is read first.

    ``known`` is what it was at a checkpoint; a file that is shorter has lost its end, which the
    journal may know.

    Attributes:
        mark: What it is now.

    Raises:
        RunDirectoryError: The file is not a ledger, or its beginning is not what is ``known``.
    """

    def __init__(self, path: Path, known: Mark | None = None) -> None:
        self._senders: dict[str, _Sender] = {}
        self._verdicts = dict.fromkeys(_RECORDED, 0)
        self._duplicates = self._missing = 0
        self.accepted_steps = 0
        self._digest = xxhash.xxh3_64()
        self.mark, whole = Mark(0, self._digest.hexdigest()), 0
        for line in _lines(path):
            self._replay(path, line[:-1].decode(errors="replace"))
            whole = self._add(line)
            if known is not None and whole >= known.size > whole - len(line):
                _require_equal(path, self.mark, known)
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT, 0o644)
        os.ftruncate(self._file, whole)  # a line torn by a kill was never answered
        self._path = path

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
        line = f"{actor} {seq} {verdict} {steps}\n".encode()
        with writing(self._path):
            write_at(self._file, line, self.mark.size)
        self._add(line)
        self._count(actor, seq, verdict, steps)

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

    def _add(self, line: bytes) -> int:
        """Take a line into the mark; gives the size of the file."""
        self._digest.update(line)
        self.mark = Mark(self.mark.size + len(line), self._digest.hexdigest())
        return self.mark.size

    def _count(self, actor: str, seq: int, verdict: Verdict, steps: int) -> None:
        sender = self._senders.setdefault(actor, _Sender(seq, seq))
        before = len(sender.missing)
        sender.add(seq)
        self._missing += len(sender.missing) - before
        self._verdicts[verdict] += 1
        if verdict == "accepted":
            self.accepted_steps += steps

    def _replay(self, path: Path, line: str) -> None:
        try:
            actor, seq, verdict, steps = line.split(" ")
            known = next(v for v in _RECORDED if v == verdict)
            self._count(actor, int(seq), known, int(steps))
        except (ValueError, StopIteration):
            raise RunDirectoryError(f"{path}: found {line!r:.60}, expected a ledger line") from None


def _require_equal(path: Path, found: Mark, known: Mark) -> None:
    if found != known:
        raise RunDirectoryError(
            f"{path}: its first {known.size} bytes are not those that the checkpoint knows; "
            "restore it from a copy, or begin another run with --init-from"
        )


def _lines(path: Path) -> Iterator[bytes]:
    """Yield every complete line, with its end."""
    if path.exists():
        with path.open("rb") as file:
            yield from (line for line in file if line.endswith(b"\n"))
