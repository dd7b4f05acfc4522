"""Runs of scripted actors, each start of the learner in a process of its own, which may die.

The process is forked from one that has imported everything already, so a start takes little. What
the learner has answered is noted outside the run, so that a start goes on where the last one died.
"""

import logging
import os
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from learners import learner_of
from reliability.run_files import Learned, learned
from scripted_actors import ENVS, WAYS, ScriptedActor

from a2s.learner.run.config import assemble
from a2s.protocol.codec import decode, encode
from a2s.protocol.errors import A2SError
from a2s.protocol.in_process import Exchange, InProcessBus
from a2s.protocol.messages import Ack, Notice, Segment

ACTORS = 2
_TRIES = 3  # of a segment that is not answered
_PATIENCE_S = 60.0
_DEFECT = 70  # an exception that nobody expects


class LastingActor(ScriptedActor):
    """A scripted actor that outlives its process: ``notes`` has what it was answered.

    A segment that is not answered is sent again, and after that nothing of those weights.
    """

    def __init__(self, slot: int, notes: Path) -> None:
        super().__init__(slot, lambda: None)
        self._notes = notes
        lines = notes.read_text().splitlines() if notes.exists() else []
        for line in lines:
            version, env, piece = map(int, line.split())
            self._done.add((version, env, piece))
        self._seq = len(lines)

    def _join(self, here: bool) -> None:
        for _ in range(_TRIES):
            try:
                super()._join(here)
            except AssertionError:
                continue
            return

    def _play(self, notice: Notice) -> None:
        try:
            super()._play(notice)
        except TimeoutError:
            return

    def _send(self, segment: Segment) -> None:
        for _ in range(_TRIES):
            answer = self._bus.ask(self._keys.segment, encode(segment), 1.0)
            verdict = "unknown" if answer is None else decode(answer, Ack).verdict
            if verdict in ("accepted", "duplicate"):
                with self._notes.open("a") as notes:
                    notes.write(f"{segment.weights_version} {segment.env} {segment.seq % 2}\n")
                return
            assert verdict == "unknown", verdict
        raise TimeoutError


@dataclass(frozen=True, slots=True)
class Ended:
    """How a start of a learner ended: its exit code, negative for a signal, and its words."""

    code: int
    words: str

    @property
    def defect(self) -> str:
        """What must not be, in one line; empty: it has finished, or died of a kill."""
        if self.code in (0, -signal.SIGKILL) and "Traceback" not in self.words:
            return ""
        last = self.words.strip().splitlines()[-1:] or [""]
        return f"code {self.code}: {last[0]}"

    @property
    def is_one_line(self) -> bool:
        """Whether it ended as a command does that was refused, or could not go on."""
        return self.code == 1 and "Traceback" not in self.words


class ScriptedRun:
    """A run in ``path``, one of `scripted_actors.WAYS`, with other ``options`` if any.

    ``notes`` is a folder outside of it. A start that takes longer than ``patience_s`` is ended.
    """

    def __init__(
        self, way: str, path: Path, notes: Path, *, patience_s: float = _PATIENCE_S, **options: Any
    ) -> None:
        self.path, self.notes, self._patience_s = path, notes, patience_s
        self._options, self._settings = WAYS[way][0] | options, WAYS[way][1]
        for each in (path, notes):
            shutil.rmtree(each, ignore_errors=True)
            each.mkdir(parents=True)

    def start(self) -> Ended:
        """Learn, going on where that is possible, to the end or until something ends it."""
        resume = (self.path / "config.toml").exists()
        return in_fork(lambda: self._learn(resume=resume), self.notes / "words")

    def acknowledged(self) -> int:
        """Segments that were answered."""
        found = (each.read_text() for each in self.notes.glob("actor-*"))
        return sum(text.count("\n") for text in found)

    def learned(self) -> Learned:
        """What must be the same in every run of this way."""
        return learned(self.path)

    def _learn(self, *, resume: bool) -> None:
        exchange, deadline_s = Exchange(), time.monotonic() + self._patience_s
        for slot in range(ACTORS):
            LastingActor(slot, self.notes / f"actor-{slot}").connect(exchange)
        options = {"env": "Test-v0", "n": ACTORS, "envs": ENVS, **self._options}
        configuration = assemble(options, self._settings)
        bus = InProcessBus(exchange)
        learner = learner_of(options, self._settings, bus, self.path, resume=resume)
        place = _place(self.path)
        place.write_config(configuration)
        summary = learner.run(lambda: time.monotonic() > deadline_s)
        if not summary["finished"]:
            raise AssertionError(f"hangs: {self._patience_s:.0f} s went by")


def _place(path: Path) -> Any:
    from a2s.commands.learner import Place

    return Place(
        path=path, resume=False, metrics_host="", metrics_port=-1, as_json=False, again=""
    )  # fmt: skip


def in_fork(action: Callable[[], None], words: Path) -> Ended:
    """Do something in a process of its own, which prints into a file."""
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid == 0:
        _in_child(action, words)
    deadline_s = time.monotonic() + 2 * _PATIENCE_S
    while (found := os.waitpid(pid, os.WNOHANG))[0] == 0:
        if time.monotonic() > deadline_s:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            return Ended(_DEFECT, "hangs")
        time.sleep(0.002)
    return Ended(os.waitstatus_to_exitcode(found[1]), words.read_text(errors="replace"))


def _without_trace(record: logging.LogRecord) -> bool:
    """Tell an expected error of a handler in one line, as the real network does."""
    if record.exc_info and isinstance(record.exc_info[1], A2SError):
        record.msg, record.args, record.exc_info = str(record.exc_info[1]), (), None
    return True


def _in_child(action: Callable[[], None], words: Path) -> NoReturn:
    """As `a2s.cli.main` does: what is expected to go wrong is one line."""
    code = _DEFECT
    out = os.open(words, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    os.dup2(out, 1)
    os.dup2(out, 2)
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr, format="%(message)s", force=True)
    logging.getLogger().handlers[0].addFilter(_without_trace)
    try:
        action()
        code = 0
    except A2SError as error:
        sys.stderr.write(f"a2s: {error}\n")
        code = 1
    except BaseException:  # noqa: BLE001  it ends here, and is told
        traceback.print_exc()
    sys.stderr.flush()
    os._exit(code)
