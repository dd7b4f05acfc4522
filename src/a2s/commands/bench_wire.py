"""The wire: an episode of 1000 steps to bytes and back, and to a learner that acknowledges it."""

import socket
import threading
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import fields
from typing import Any

import numpy as np

from a2s.commands.bench import Contender, Contest, optional
from a2s.commands.bench_data import make_segment
from a2s.commands.process import free_endpoint
from a2s.protocol.codec import decode, encode
from a2s.protocol.messages import Ack, Segment
from a2s.protocol.zenoh_bus import ZenohBus

_KEY = "bench/segment"
_TIMEOUT_S, _WINDOW = 10.0, 16


def contests(stack: ExitStack) -> list[Contest]:
    """Open the connections."""
    segment = make_segment(np.random.default_rng(0))
    payload = encode(segment)
    values = [getattr(segment, field.name) for field in fields(segment)]
    arrays = [value for value in values if isinstance(value, np.ndarray)]
    parts = [array.tobytes() for array in arrays]
    pairs = {
        "encode": (lambda: encode(segment), lambda: b"".join(a.tobytes() for a in arrays)),
        "decode": (
            lambda: decode(payload, Segment),
            lambda: [np.frombuffer(part, np.float32).copy() for part in parts],
        ),
    }
    local = [
        [Contender(f"{name}: a2s", ours), Contender(f"{name}: bytes alone", bare, is_baseline=True)]
        for name, (ours, bare) in pairs.items()
    ]
    remote = _over_zenoh(payload, stack)
    zmq = optional("zmq", "pyzmq")
    remote += [_over_tcp(payload, stack, is_baseline=zmq is None)]
    remote += [] if zmq is None else [_over_zmq(zmq, payload, stack)]
    return [Contest("segments/s", contenders) for contenders in (*local, remote)]


def _over_zenoh(payload: bytes, stack: ExitStack) -> list[Contender]:
    """Ask as an actor does, answer as a learner does that has nothing to judge."""
    ack = encode(
        Ack(verdict="accepted", reason="", generation=1, epoch=0, weights_version=0, wait_s=0.0)
    )
    endpoint = free_endpoint()
    learner = stack.enter_context(closing(ZenohBus.listen(endpoint)))
    learner.answer(_KEY, lambda _: ack)
    actor = stack.enter_context(closing(ZenohBus.connect(endpoint, lambda: False)))
    asked = deque[Callable[[], bytes | None]]()

    def ask_of_window() -> None:
        asked.append(actor.begin_asking(_KEY, payload, _TIMEOUT_S))
        if len(asked) == _WINDOW:
            asked.popleft()()

    return [
        Contender("acknowledged: zenoh", lambda: actor.ask(_KEY, payload, _TIMEOUT_S)),
        Contender(f"acknowledged: zenoh, {_WINDOW} at a time", ask_of_window),
    ]


def _over_tcp(payload: bytes, stack: ExitStack, *, is_baseline: bool) -> Contender:
    """Send the same bytes to a bare socket that answers with one."""
    listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))

    def serve() -> None:
        connection, _ = listener.accept()
        buffer = bytearray(len(payload))
        with connection:
            while connection.recv_into(buffer, len(buffer), socket.MSG_WAITALL):
                connection.sendall(b".")

    threading.Thread(target=serve, name="tcp", daemon=True).start()
    client = stack.enter_context(socket.create_connection(listener.getsockname()))
    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send() -> None:
        client.sendall(payload)
        client.recv(1)

    return Contender("acknowledged: bare tcp", send, is_baseline=is_baseline)


def _over_zmq(zmq: Any, payload: bytes, stack: ExitStack) -> Contender:
    """Ask by REQ, answer by ROUTER, which knows who asks as a learner does."""
    context = zmq.Context()
    router, client = context.socket(zmq.ROUTER), context.socket(zmq.REQ)
    port = router.bind_to_random_port("tcp://127.0.0.1")

    def serve() -> None:
        while True:
            who, nothing, asked = router.recv_multipart()
            if not asked:
                break
            router.send_multipart([who, nothing, b"."])
        router.close()

    thread = threading.Thread(target=serve, name="zmq")
    thread.start()
    client.connect(f"tcp://127.0.0.1:{port}")

    def end() -> None:
        client.send(b"")
        thread.join()
        client.close()
        context.term()

    stack.callback(end)

    def send() -> None:
        client.send(payload)
        client.recv()

    return Contender("acknowledged: pyzmq REQ/ROUTER", send, is_baseline=True)
