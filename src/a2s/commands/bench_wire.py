"""The wire: an episode of 1000 steps to bytes and back, and to a learner that acknowledges it."""

import socket
import threading
from contextlib import ExitStack, closing
from dataclasses import fields

import numpy as np

from a2s.commands.bench import Contender, Contest
from a2s.commands.bench_data import make_segment
from a2s.commands.serving import free_endpoint
from a2s.protocol.codec import decode, encode
from a2s.protocol.fields import Array
from a2s.protocol.messages import Ack, Segment
from a2s.protocol.zenoh_bus import ZenohBus

_KEY = "bench/segment"
_TIMEOUT_S = 10.0


def contests(stack: ExitStack) -> list[Contest]:
    """Open the connections."""
    segment = make_segment(0, np.random.default_rng(0))
    payload = encode(segment)
    arrays = [
        value
        for value in (getattr(segment, field.name) for field in fields(segment))
        if isinstance(value, np.ndarray)
    ]
    plain = [array.tobytes() for array in arrays]
    return [
        Contest(
            "segments/s",
            [
                Contender("encode: a2s", lambda: encode(segment)),
                Contender("encode: bytes alone", lambda: _join(arrays), is_baseline=True),
            ],
        ),
        Contest(
            "segments/s",
            [
                Contender("decode: a2s", lambda: decode(payload, Segment)),
                Contender("decode: bytes alone", lambda: _copies(plain), is_baseline=True),
            ],
        ),
        Contest("segments/s", [_over_zenoh(payload, stack), _over_tcp(payload, stack)]),
    ]


def _join(arrays: list[Array]) -> bytes:
    return b"".join(array.tobytes() for array in arrays)


def _copies(plain: list[bytes]) -> list[Array]:
    return [np.frombuffer(part, np.float32).copy() for part in plain]


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
        buffer = memoryview(bytearray(len(payload)))
        with connection:
            while True:
                got = 0
                while got < len(payload):
                    more = connection.recv_into(buffer[got:])
                    if more == 0:
                        return
                    got += more
                connection.sendall(b".")

    threading.Thread(target=serve, name="tcp", daemon=True).start()
    client = stack.enter_context(socket.create_connection(listener.getsockname()))
    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send() -> None:
        client.sendall(payload)
        client.recv(1)

    return Contender("acknowledged: bare tcp", send, is_baseline=True)
