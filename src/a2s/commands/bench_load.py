"""``a2s bench wire --actors N``: sessions that speak the protocol to a learner, without physics."""

import statistics
import tempfile
import threading
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from a2s.commands.bench_data import ENV_ID, make_segment
from a2s.commands.process import free_endpoint
from a2s.commands.status import ask
from a2s.commands.train import started
from a2s.protocol.codec import decode, encode
from a2s.protocol.errors import RefusedError, UnreachableError
from a2s.protocol.keys import Keys, other_runs
from a2s.protocol.messages import Ack, Hello, Notice, Refusal, Segment, Weights, Welcome
from a2s.protocol.zenoh_bus import ZenohBus

_ASK_S, _AGAIN_S, _LOOK_EVERY_S = 10.0, 0.2, 1.0
_START_S = 120.0  # for a learner, and for all to join it
_ENDLESS = str(10**12)


class Tally:
    """What all sessions saw while it counted: seconds to each answer and to each new weights."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._is_counting = False
        self._first_heard: dict[tuple[int, int], float] = {}
        self.answers: list[float] = []
        self.weights: list[float] = []
        self.verdicts = Counter[str]()
        self.steps = self.joined = 0

    def begin(self) -> None:
        """Count from now on."""
        with self._lock:
            self._is_counting = True

    def end(self) -> None:
        """Count no more."""
        with self._lock:
            self._is_counting = False

    def join(self) -> None:
        """A session is a member."""
        with self._lock:
            self.joined += 1

    def answer(self, verdict: str, steps: int, seconds: float) -> None:
        """A segment was answered; ``unanswered`` is a verdict, too."""
        with self._lock:
            if self._is_counting:
                self.verdicts[verdict] += 1
                self.answers.append(seconds)
                self.steps += steps if verdict == "accepted" else 0

    def heard(self, notice: Notice) -> None:
        """A session has heard of weights."""
        with self._lock:
            self._first_heard.setdefault(notice.identity, perf_counter())

    def fetched(self, notice: Notice) -> None:
        """It has them; the time begins when the first one heard of them."""
        with self._lock:
            if self._is_counting and notice.identity in self._first_heard:
                self.weights.append(perf_counter() - self._first_heard[notice.identity])


class _Session:
    """An actor of one environment: fetches weights when it hears of them, sends its quota."""

    def __init__(self, index: int, bus: ZenohBus, keys: Keys, pace_s: float, tally: Tally) -> None:
        self._name, self._bus, self._keys = f"bench-{index}", bus, keys
        self._pace_s, self._tally = pace_s, tally
        self._rng = np.random.default_rng(index)
        self._changed = threading.Condition()
        self._notice: Notice | None = None
        self._seq = 0
        bus.subscribe(keys.notice, lambda payload: self._hear(decode(payload, Notice)))
        bus.declare_presence(keys.live_actor(self._name))

    def run(self, stop: threading.Event) -> None:
        """Play until stopped."""
        welcome = self._join(stop)
        fetched: Notice | None = None
        sent: Notice | None = None
        free_s = 0.0
        while not stop.is_set() and welcome is not None:
            notice = self._newest(sent if welcome.clock == "lockstep" else None, stop)
            if notice is None:
                continue
            if fetched is None or notice.identity != fetched.identity:
                self._fetch(notice)
                segment = make_segment(
                    self._rng, steps=notice.quota_steps, spaces=welcome.spaces, actor=self._name,
                    generation=notice.generation, epoch=notice.epoch,
                    weights_version=notice.version, terminated=True, truncated=False,
                    episode_return=float(self._rng.standard_normal()),
                )  # fmt: skip
                fetched = notice
            if not self._is_free(free_s, notice):
                continue
            sent, begin_s = notice, perf_counter()
            ack = self._send(segment)
            if ack is not None and ack.verdict == "unknown":
                welcome = self._join(stop)
            rest_s = 0.0 if ack is None else ack.wait_s
            free_s = max(perf_counter() + rest_s, begin_s + self._pace_s)

    def _hear(self, notice: Notice) -> None:
        self._tally.heard(notice)
        with self._changed:
            if self._notice is None or notice.identity > self._notice.identity:
                self._notice = notice
                self._changed.notify_all()

    def _is_free(self, free_s: float, notice: Notice) -> bool:
        """Whether a segment may be sent; if not, wait until then, for a second or for news."""
        left_s = free_s - perf_counter()
        with self._changed:
            if left_s > 0 and self._notice is notice:
                self._changed.wait(min(left_s, _LOOK_EVERY_S))
        return left_s <= 0

    def _newest(self, sent: Notice | None, stop: threading.Event) -> Notice | None:
        """Give the newest notice, other than the one for which all was sent."""
        with self._changed:
            if self._notice is not None and (
                sent is None or self._notice.identity != sent.identity
            ):
                return self._notice
            if self._notice is not None and self._changed.wait(1.0):
                return None
        reply = self._bus.ask(self._keys.notice, b"", _ASK_S)
        if reply:
            self._hear(decode(reply, Notice))
        else:
            stop.wait(_AGAIN_S)
        return None

    def _join(self, stop: threading.Event) -> Welcome | None:
        hello = Hello(actor=self._name, num_envs=0, env_id="", spaces=None)
        told = self._ask_to(hello, stop)
        if told is None:
            return None
        env_id = told.env_id if told.env is None else told.env.env_id
        joined = self._ask_to(replace(hello, num_envs=1, env_id=env_id, spaces=told.spaces), stop)
        self._tally.join()
        return joined

    def _ask_to(self, hello: Hello, stop: threading.Event) -> Welcome | None:
        while not stop.is_set():
            reply = self._bus.ask(self._keys.hello, encode(hello), _ASK_S)
            answer = decode(reply, Welcome, Refusal) if reply else None
            if isinstance(answer, Refusal):
                raise RefusedError(f"bench wire: the learner refused an actor: {answer.reason}")
            if isinstance(answer, Welcome):
                return answer
            stop.wait(_AGAIN_S)
        return None

    def _fetch(self, notice: Notice) -> None:
        reply = self._bus.ask(self._keys.weights, b"", _ASK_S)
        if reply and decode(reply, Weights).notice.identity == notice.identity:
            self._tally.fetched(notice)

    def _send(self, segment: Segment) -> Ack | None:
        payload = encode(replace(segment, seq=self._seq))
        begin_s = perf_counter()
        reply = self._bus.ask(self._keys.segment, payload, _ASK_S)
        ack = decode(reply, Ack) if reply else None
        verdict = "unanswered" if ack is None else ack.verdict
        self._tally.answer(verdict, segment.num_steps, perf_counter() - begin_s)
        self._seq += ack is not None and ack.verdict != "unknown"
        return ack


def load(
    actors: int, *, connect: str | None, run: str, pace_s: float, seconds: float
) -> list[dict[str, Any]]:
    """Have ``actors`` sessions send to the learner at ``connect``, or to one that is started.

    Each sends its next segment when the last is answered, at the soonest ``pace_s`` seconds after
    it. The learner that is started learns by its defaults, of made-up steps of the size of
    HalfCheetah, and in async.

    Returns:
        Rows as those of `a2s.commands.bench.bench`, of what was seen in ``seconds``.

    Raises:
        A2SError: There is no such learner, or it refuses them.
    """
    tally, stop = Tally(), threading.Event()
    with ExitStack() as stack:
        endpoint = connect or _learner(actors, run, stack)
        pool = stack.enter_context(ThreadPoolExecutor(actors))
        stack.callback(stop.set)
        give_up_s = perf_counter() + _START_S
        # Only a learner that was started here may still be on its way.
        coming = ZenohBus.connect(endpoint, lambda: not connect and perf_counter() < give_up_s)
        with closing(coming) as bus:
            if connect and ask(bus, Keys(run)) is None:
                hint = other_runs(bus, run) or "; name another with --run"
                raise UnreachableError(f"bench wire: {connect}: no answer for run {run!r}{hint}")

        def play(index: int) -> None:
            with closing(ZenohBus.connect(endpoint, lambda: False)) as bus:
                _Session(index, bus, Keys(run), pace_s, tally).run(stop)

        playing = [pool.submit(play, index) for index in range(actors)]
        while tally.joined < actors and perf_counter() < give_up_s:
            _require_running(playing)
            stop.wait(_AGAIN_S)
        tally.begin()
        begin_s = perf_counter()
        stop.wait(seconds)
        tally.end()
        spent_s = perf_counter() - begin_s
        stop.set()
        _require_running(playing)
    return rows(actors, tally, spent_s)


def _learner(actors: int, run: str, stack: ExitStack) -> str:
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    endpoint = free_endpoint()
    log = stack.enter_context((folder / "learner.log").open("w"))
    options = ["--env", ENV_ID, "--async", "--n", str(actors), "--envs", "1", "--run", run]
    options += ["--listen", endpoint, "--run-dir", str(folder / "run"), "--metrics-port", "-1"]
    stack.enter_context(started(["learner", *options, "--total-steps", _ENDLESS], log))
    return endpoint


def _require_running(playing: Sequence[Any]) -> None:
    for each in playing:
        if each.done():
            each.result()


def rows(actors: int, tally: Tally, seconds: float) -> list[dict[str, Any]]:
    """What was seen in so many seconds."""
    others = sorted(tally.verdicts.keys() - {"accepted"})
    found: list[tuple[str, float | None, str]] = [
        ("accepted", tally.verdicts["accepted"] / seconds, "segments/s"),
        ("accepted steps", tally.steps / seconds, "steps/s"),
        *((verdict, tally.verdicts[verdict] / seconds, "segments/s") for verdict in others),
        *_percentiles("answer", tally.answers),
        *_percentiles("weights", tally.weights),
    ]
    who = f"{actors} actor{'s' if actors > 1 else ''}"
    return [
        {"name": f"{who}: {name}", "value": value, "unit": unit, "baseline": None, "ratio": None}
        for name, value, unit in found
    ]


def _percentiles(name: str, seconds: Sequence[float]) -> list[tuple[str, float | None, str]]:
    if len(seconds) < 2:
        return [(f"{name}, median", None, "ms"), (f"{name}, p99", None, "ms")]
    parts = statistics.quantiles(seconds, n=100, method="inclusive")
    return [
        (f"{name}, median", 1e3 * parts[49], "ms"), (f"{name}, p99", 1e3 * parts[98], "ms")
    ]  # fmt: skip
