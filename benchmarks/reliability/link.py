"""A link between two network namespaces, carried in user space.

Each end is a TAP device in a namespace of its own; a thread reads from one what it writes to the
other, later or never. So it needs neither a kernel with netem nor any network of the machine, but
root, ``/dev/net/tun`` and ``ip netns``.
"""

import fcntl
import os
import random
import select
import shutil
import struct
import subprocess
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

LEARNER, ACTOR = "learner", "actor"
ADDRESSES = {LEARNER: "10.77.0.1", ACTOR: "10.77.0.2"}
_NET = "10.77.0.0/24"
OTHER = {LEARNER: ACTOR, ACTOR: LEARNER}
_TUN = Path("/dev/net/tun")
_TUNSETIFF, _IFF_TAP, _IFF_NO_PI = 0x400454CA, 0x0002, 0x1000  # linux/if_tun.h
_MAX_FRAME, _AT_ONCE = 65536, 64
_LOOK_EVERY_S = 0.1


class NoLinkError(Exception):
    """A link cannot be made here; the message is one line."""


@dataclass(frozen=True)
class Quality:
    """How frames fare in one direction.

    Attributes:
        delay_s: Seconds on the way.
        jitter_s: Seconds by which a frame's delay is longer or shorter at most. Frames stay in
            order, so in a burst all wait for those before them, and the mean is longer.
        loss: Chance of a frame to be lost.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0


class Direction:
    """What one end has sent and the other has not received yet, in order.

    Attributes:
        quality: Of what is sent from now on.
        is_cut: Whatever is sent is lost.
    """

    def __init__(self, rng: random.Random) -> None:
        self.quality, self.is_cut = Quality(), False
        self._rng = rng
        self._on_the_way: deque[tuple[float, bytes]] = deque()

    def send(self, frame: bytes, now_s: float) -> None:
        """Take a frame, or lose it."""
        quality = self.quality
        if self.is_cut or self._rng.random() < quality.loss:
            return
        arrives_s = now_s + quality.delay_s + self._rng.uniform(-1, 1) * quality.jitter_s
        self._on_the_way.append((arrives_s, frame))

    def arrived(self, now_s: float) -> Iterator[bytes]:
        """Yield, and forget, what has arrived."""
        while self._on_the_way and self._on_the_way[0][0] <= now_s:
            yield self._on_the_way.popleft()[1]

    def next_s(self) -> float:
        """When the next frame arrives; infinite if there is none."""
        return self._on_the_way[0][0] if self._on_the_way else float("inf")


class Link:
    """Two namespaces, and what carries frames between them; all is removed after the block.

    A process makes one at a time: its number is in their names. ``congestion``: what the kernel
    calls TCP's way of finding out how much a link carries; empty: the machine's.

    Attributes:
        directions: By the end that sends.

    Raises:
        NoLinkError: On entering, if it cannot be made here.
    """

    def __init__(self, seed: int = 0, congestion: str = "") -> None:
        self._congestion = congestion
        self.directions = {end: Direction(random.Random(seed)) for end in ADDRESSES}
        # Of device and namespace; a device's has at most 15 characters.
        self._names = {end: f"a2s{os.getpid()}{end[0]}" for end in ADDRESSES}
        self._taps: dict[str, int] = {}
        self._ended = threading.Event()
        self._stack = ExitStack()

    def __enter__(self) -> "Link":
        _require_possible()
        with ExitStack() as stack:
            for end in ADDRESSES:
                self._make(end, stack)
            thread = threading.Thread(target=self._carry, name="link")
            thread.start()
            stack.callback(thread.join)
            stack.callback(self._ended.set)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def inside(self, end: str) -> tuple[str, ...]:
        """Give the words before a command that is to run at an end."""
        return ("ip", "netns", "exec", self._names[end])

    def cut(self, *senders: str) -> None:
        """Lose what these ends send from now on, and nothing that others send."""
        for end, direction in self.directions.items():
            direction.is_cut = end in senders

    def become(self, quality: Quality) -> None:
        """Change both directions, for what is sent from now on."""
        for direction in self.directions.values():
            direction.quality = quality

    def _make(self, end: str, stack: ExitStack) -> None:
        name = self._names[end]
        self._taps[end] = tap = os.open(_TUN, os.O_RDWR | os.O_NONBLOCK)
        stack.callback(os.close, tap)
        request = struct.pack("16sH", name.encode(), _IFF_TAP | _IFF_NO_PI)
        try:
            fcntl.ioctl(tap, _TUNSETIFF, request)
        except OSError as error:
            raise NoLinkError(f"cannot make a TAP device: {error.strerror}; run as root") from None
        stack.callback(_remove, name)
        _ip("netns", "add", name)
        _ip("link", "set", name, "netns", name)
        _ip("-n", name, "address", "add", f"{ADDRESSES[end]}/24", "dev", name)
        _ip("-n", name, "link", "set", "lo", "up")
        _ip("-n", name, "link", "set", name, "up")
        if self._congestion:
            way = (_NET, "dev", name, "src", ADDRESSES[end], "congctl", self._congestion)
            _ip("-n", name, "route", "replace", *way)

    def _carry(self) -> None:
        taps = self._taps
        while not self._ended.is_set():
            wait_s = min(each.next_s() for each in self.directions.values()) - time.monotonic()
            wait_s = min(max(wait_s, 0.0), _LOOK_EVERY_S)
            ready, _, _ = select.select(list(taps.values()), [], [], wait_s)
            for end, direction in self.directions.items():
                if taps[end] in ready:
                    for frame in _frames(taps[end]):
                        direction.send(frame, time.monotonic())
                for frame in direction.arrived(time.monotonic()):
                    with suppress(OSError):  # a device that is full loses frames, as any does
                        os.write(taps[OTHER[end]], frame)


def _frames(tap: int) -> Iterator[bytes]:
    with suppress(BlockingIOError):
        for _ in range(_AT_ONCE):
            yield os.read(tap, _MAX_FRAME)


def _require_possible() -> None:
    if os.geteuid():
        raise NoLinkError("a link between network namespaces needs root; run as root")
    if shutil.which("ip") is None:
        raise NoLinkError("found no program `ip`; install iproute2")
    if not _TUN.exists():
        raise NoLinkError(f"found no {_TUN}; load the module tun, or give the container the device")


def _ip(*words: str) -> None:
    done = subprocess.run(["ip", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        said = " ".join(done.stderr.split()) or f"exit code {done.returncode}"
        raise NoLinkError(f"`ip {' '.join(words)}` failed: {said}")


def _remove(name: str) -> None:
    """Remove a namespace, if it was made; a signal to the terminal's processes is none to this."""
    subprocess.run(
        ["ip", "netns", "delete", name], stderr=subprocess.DEVNULL, check=False,
        start_new_session=True,
    )  # fmt: skip
