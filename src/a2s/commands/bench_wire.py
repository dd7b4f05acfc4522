"""The wire: an episode of 1000 steps to bytes and back, and to a learner that acknowledges it."""

import socket
import threading
from contextlib import ExitStack, closing
from dataclasses import fields

import numpy as np

from a2s.commands.bench import Contender, Contest
from a2s.commands.bench_data import make_segment
from a2s.commands.process import free_endpoint
from a2s.protocol.codec import decode, encode
from a2s.protocol.messages import Ack, Segment
from a2s.protocol.zenoh_bus import ZenohBus

_KEY = "bench/segment"
_TIMEOUT_S = 10.0


def contests(stack: ExitStack) -> list[Contest]:
    """Open the connections."""
    segment = make_segment(0, np.random.default_rng(0))
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
    remote = [_over_zenoh(payload, stack), _over_tcp(payload, stack)]
    return [Contest("segments/s", contenders) for contenders in (*local, remote)]


def _over_zenoh(payload: bytes, stack: ExitStack) -> Contender:
    """Ask as an actor does, answer as a learner does that has nothing to judge."""
    ack = encode(
        Ack(verdict="accepted", reason="", generation=1, epoch=0, weights_version=0, wait_s=0.0)
    )
    endpoint = free_endpoint()
    learner = stack.enter_context(closing(ZenohBus.listen(endpoint)))
    learner.answer(_KEY, lambda _: ack)
    actor = stack.enter_context(closing(ZenohBus.connect(endpoint, lambda: False)))
    return Contender("acknowledged: zenoh", lambda: actor.ask(_KEY, payload, _TIMEOUT_S))


def _over_tcp(payload: bytes, stack: ExitStack) -> Contender:
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

    return Contender("acknowledged: bare tcp", send, is_baseline=True)
