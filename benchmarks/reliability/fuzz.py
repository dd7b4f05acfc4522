"""Mutated messages: ``python -m reliability.fuzz --decode 1000000 --live 100000``.

Bytes are flipped, cut, doubled and made up, values replaced by others of any type. Each is decoded,
or refused with a reason; so is each that is sent to a learner, which goes on learning, and neither
process grows.
"""

import argparse
import gc
import math
import random
import signal
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import msgpack
import psutil
from message_examples import GOLDEN
from reliability.commands import Commands, rows, wait_for
from reliability.run_files import accounts_disagree, unbalanced
from reliability.trial import Result, folder, tell
from system_helpers import OFF_POLICY, REACH

from a2s.protocol.codec import Message, decode
from a2s.protocol.errors import MalformedMessageError
from a2s.protocol.evaluation_messages import EvaluationRequest, EvaluationResult, EvaluationTask
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Ack, ActorStatus, Hello, Refusal, Segment, Welcome
from a2s.protocol.replay_messages import ReplayRequest, ReplaySample
from a2s.protocol.zenoh_bus import ZenohBus

HEADS = (
    b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff",
    b"\xdb\x7f\xff\xff\xff", b"\xc1", b"\xd4\x00\x00",
    b"\xcb\x7f\xf8" + bytes(6), b"\xcf" + b"\xff" * 8, b"\x91" * 2000,
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 2**31, 2**63 - 1, -(2**63), 2**64 - 1, math.nan, math.inf, 1e300, "",
    "a" * 5000, "\n\x00\x1b[2J", b"", b"\x00" * 64, [], {}, [[[[]]]],
    {"dtype": "<f4", "shape": [2**62], "data": b""},
    {"dtype": "O", "shape": [1], "data": b"x"}, {"dtype": "<f4", "shape": [-1], "data": b""},
)  # fmt: skip
_SLOW_S, _MOST_GROWTH = 2.0, 32e6
_ANSWER_S = 30.0


def mutated(payload: bytes, rng: random.Random) -> bytes:
    """Change a message in one to four ways."""
    for _ in range(rng.randint(1, 4)):
        payload = rng.choice(WAYS)(payload, rng)
    return payload


def _flip(payload: bytes, rng: random.Random) -> bytes:
    data = bytearray(payload or b"\0")
    data[rng.randrange(len(data))] ^= rng.randint(1, 255)
    return bytes(data)


def _cut(payload: bytes, rng: random.Random) -> bytes:
    return payload[: rng.randint(0, len(payload))]


def _double(payload: bytes, rng: random.Random) -> bytes:
    begin, end = sorted(rng.randint(0, len(payload)) for _ in range(2))
    return payload[:end] + payload[begin:]


def _insert(payload: bytes, rng: random.Random) -> bytes:
    at = rng.randint(0, len(payload))
    return payload[:at] + rng.choice(HEADS) + payload[at:]


def _invent(payload: bytes, rng: random.Random) -> bytes:
    return rng.randbytes(rng.randint(0, 64)) if rng.random() < 0.2 else payload


def _replace(payload: bytes, rng: random.Random) -> bytes:
    """Replace a value, at any depth."""
    try:
        body = msgpack.unpackb(payload, strict_map_key=False)
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException):
        return payload
    part = body
    while isinstance(part, dict | list) and part:
        key = rng.choice(list(part)) if isinstance(part, dict) else rng.randrange(len(part))
        if not isinstance(part[key], dict | list) or not part[key] or rng.random() < 0.5:
            part[key] = rng.choice(VALUES)
            break
        part = part[key]
    try:
        return bytes(msgpack.packb(body))
    except (ValueError, TypeError, OverflowError, RecursionError):
        return payload


WAYS: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    _flip, _cut, _double, _insert, _invent, _replace, _replace, _replace,
)  # fmt: skip


def decoded(count: int, seed: int) -> Result:
    """Decode mutations of every kind of message, as that kind."""
    result = Result("fuzz, decode", "decoded or refused with a reason; no crash, memory flat")
    rng, me, refused, grown = random.Random(seed), psutil.Process(), 0, 0
    before, slowest_s = 0, 0.0
    for number in range(count):
        if number == count // 4:
            gc.collect()
            before = me.memory_info().rss
        message, payload = GOLDEN[number % len(GOLDEN)]
        data, begin_s = mutated(payload, rng), time.monotonic()
        try:
            decode(data, type(message))
        except MalformedMessageError as error:
            refused += 1
            if not str(error) or "\n" in str(error):
                result.failures.append(f"{data[:80].hex()}: no reason in one line: {error!r:.80}")
        except Exception as error:  # noqa: BLE001  that is what is looked for
            result.failures.append(f"{data[:200].hex()}: {error!r:.200}")
        slowest_s = max(slowest_s, time.monotonic() - begin_s)
    gc.collect()
    grown = me.memory_info().rss - before
    result.count = count
    result.figures = {
        "refused": str(refused),
        "grown": f"{grown / 1e6:.1f} MB",
        "slowest": f"{slowest_s:.2f} s",
    }
    if grown > _MOST_GROWTH or slowest_s > _SLOW_S:
        result.failures.append(f"grown {grown / 1e6:.1f} MB, slowest {slowest_s:.2f} s")
    return result


def live(count: int, seed: int, place: Path) -> Result:
    """Send mutations to all keys of a learner at work."""
    result = Result("fuzz, live", "answered with a reason; the learner learns on, memory flat")
    rng, path = random.Random(seed), place / "run"
    table = path / "updates.csv"
    with Commands(place) as commands:
        options = ("--listen", commands.endpoint, "--run-dir", str(path), "--metrics-port", "-1")
        learner = commands.start(
            "learner", *REACH, *OFF_POLICY, "--set", "warm_up_steps=100", "--total-steps",
            "100000000", *options,
        )  # fmt: skip
        commands.start("actor", "--connect", commands.endpoint, "--metrics-port", "-1")
        wait_for(lambda: rows(table) >= 3, "the first updates")
        process, before = psutil.Process(learner.process.pid), 0
        with closing(ZenohBus.connect(commands.endpoint, lambda: False)) as bus:
            for number in range(count):
                if number == count // 4:
                    before = process.memory_info().rss
                if wrong := _send(bus, rng):
                    result.failures.append(wrong)
        grown, updates = process.memory_info().rss - before, rows(table)
        result.count = count
        result.figures["grown"] = f"{grown / 1e6:.1f} MB"
        if grown > _MOST_GROWTH:
            result.failures.append(f"grown {grown / 1e6:.1f} MB")
        wait_for(lambda: rows(table) > updates + 2, "updates afterwards")
        code, words = learner.end(signal.SIGINT), learner.text()
        told = (
            "a traceback" if "Traceback" in words else "",
            unbalanced(path),
            accounts_disagree(path),
        )
        result.add(*told, "" if code == 130 else f"exit code {code}", of="the end")
    return result


def _send(bus: ZenohBus, rng: random.Random) -> str:
    """Send one; says what is wrong about the answer."""
    keys = Keys("default")
    if rng.random() < 0.1:
        bus.publish(keys.actor_status("x"), mutated(_example(ActorStatus), rng))
        return ""
    key, kind, answers = rng.choice(
        (
            (keys.hello, Hello, (Welcome, Refusal)),
            (keys.segment, Segment, (Ack,)),
            (keys.replay_sample, ReplayRequest, (ReplaySample, Refusal)),
            (keys.evaluation_task, EvaluationRequest, (EvaluationTask, Refusal)),
            (keys.evaluation_result, EvaluationResult, (Refusal,)),
        )
    )
    data, begin_s = mutated(_example(kind), rng), time.monotonic()
    answer = bus.ask(key, data, _ANSWER_S)
    if answer is None:
        return f"{key}: no answer in {time.monotonic() - begin_s:.1f} s to {data[:200].hex()}"
    if not answer and "evaluation" in key:
        return ""
    found: Any = decode(answer, *answers)
    has_reason = not isinstance(found, Refusal) or found.reason
    is_told = not isinstance(found, Ack) or found.verdict == "accepted" or found.reason
    return "" if has_reason and is_told else f"{key}: no reason for {data[:200].hex()}"


def _example(kind: type[Message]) -> bytes:
    return next(payload for message, payload in GOLDEN if type(message) is kind)


def main() -> None:
    """Parse, mutate, tell."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--decode", type=int, default=20_000)
    parser.add_argument("--live", type=int, default=2_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    results = [decoded(options.decode, options.seed)] if options.decode else []
    if options.live:
        with folder() as place:
            results.append(live(options.live, options.seed, place))
    tell(results)


if __name__ == "__main__":
    main()
