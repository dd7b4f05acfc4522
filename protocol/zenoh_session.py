"""Opening a zenoh session: explicit links only, no discovery, no shared memory.

The learner's session is the router (docs/adr/0003), so no other process is needed.
"""

import json
import logging
import re
import time
from collections.abc import Callable
from typing import Any, Literal

import zenoh

from a2s.protocol import refusal
from a2s.protocol.endpoint import check_endpoint
from a2s.protocol.errors import RefusedError, UnreachableError, UsageError
from a2s.protocol.identity import Identity, is_local

logger = logging.getLogger(__name__)

_PATIENCE_S = 10.0
_REFUSED_WITHIN_S = 1.0
_TRIES, _AGAIN_S = 2, 0.5
_OPEN_MS = 2000
_START = "start `a2s learner` (--resume goes on with a run)"

_SETTINGS = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,  # otherwise opening takes half a second
    # Queries over shared memory can be lost (eclipse-zenoh/zenoh #2628).
    "transport/shared_memory/enabled": False,
    "transport/unicast/max_sessions": 4096,
    "transport/unicast/accept_pending": 1024,
    # A peer that hangs is noticed after this; shorter gives false alarms on loaded hosts.
    "transport/link/tx/lease": 10_000,
    "transport/link/tx/keep_alive": 4,
    "transport/link/tx/queue/congestion_control/block/wait_before_close": 20_000_000,
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 20_000,
    "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 500_000,
    "transport/link/rx/buffer_size": 1 << 20,
    "transport/link/rx/max_message_size": 512 << 20,
}
# What the kernel has taken to send, nothing can overtake: on a way that carries 60 kB/s it would
# take up to 4 MB, and an answer would come a minute later (docs/adr/0036).
_OVER_NETWORKS = {f"transport/link/{kind}/so_sndbuf": 64 << 10 for kind in ("tcp", "tls")}


def configure(mode: Literal["router", "client"], settings: dict[str, Any]) -> zenoh.Config:
    """Zenoh's configuration: ours, and what else is set."""
    config = zenoh.Config()
    for path, value in {"mode": mode, **_SETTINGS, **settings}.items():
        config.insert_json5(path, json.dumps(value))
    return config


def listen(endpoint: str, identity: Identity) -> zenoh.Session:
    """Open a router that listens on ``endpoint``.

    Raises:
        UsageError: The endpoint is malformed or taken.
    """
    check_endpoint(endpoint)
    settings = {"listen/endpoints": [endpoint], **identity.settings}
    if not is_local(endpoint):
        settings |= _OVER_NETWORKS
    try:
        return zenoh.open(configure("router", settings))
    except zenoh.ZError as error:
        raise UsageError(
            f"cannot listen on {endpoint}: {_reason(error)}; "
            "choose another endpoint with --listen tcp/HOST:PORT"
        ) from None


def connect(endpoint: str, proceed: Callable[[], bool], identity: Identity) -> zenoh.Session:
    """Open a client; once open, it finds a restarted learner again by itself.

    ``proceed`` is asked after each failed attempt of about a second; if false, give up.

    Raises:
        UsageError: The endpoint is malformed.
        RefusedError: What listens there does not let this peer in.
        UnreachableError: Nobody listens there.
    """
    check_endpoint(endpoint)
    retry = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}
    settings = {"connect/endpoints": [endpoint], "connect/retry": retry, **identity.settings}
    config = configure("client", {**settings, "connect/timeout_ms": 1000})
    begin = said = time.monotonic()
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError:
            is_awaited = refusal.is_awaited(endpoint)
            if is_awaited and (session := _try(endpoint, identity, settings)) is not None:
                return session
            now = time.monotonic()
            goes_on = proceed()
            if goes_on and now - said < _PATIENCE_S:
                continue
            nobody = _nobody(endpoint, now - begin, identity, is_awaited=is_awaited)
            if not goes_on:
                raise UnreachableError(
                    f"{nobody}; {_START}, or name its endpoint with --connect"
                ) from None
            said = now
            logger.warning("%s; still trying, %s there", nobody, _START)


def _nobody(endpoint: str, waited_s: float, identity: Identity, *, is_awaited: bool) -> str:
    """Say who is missing, with what is known of the reason."""
    found = f"no learner at {endpoint} after {waited_s:.0f} s"
    if is_awaited:
        found += ", though something listens there: it may hang"
        return found if identity.folder is None else f"{found}, or be without --tls"
    return found if refusal.has_address(endpoint) else f"{found}: its host has no address here"


def _try(endpoint: str, identity: Identity, settings: dict[str, Any]) -> zenoh.Session | None:
    """Try, where something listens: zenoh fails at once if it is not let in.

    ``None``: what listens does not answer.

    Raises:
        RefusedError: It does, with what is known of the reason.
    """
    for _ in range(_TRIES):
        begin = time.monotonic()
        try:
            return zenoh.open(
                configure("client", {**settings, "transport/unicast/open_timeout": _OPEN_MS})
            )
        except zenoh.ZError:
            is_refused = time.monotonic() - begin < _REFUSED_WITHIN_S
        if not is_refused:
            break
        time.sleep(_AGAIN_S)
        if not refusal.is_awaited(endpoint):  # a learner that ends does not let anybody in, either
            return None
    if found := refusal.why(endpoint, identity):
        raise RefusedError(f"{endpoint}: {found}")
    if is_refused and identity.folder is None:
        who = f"user {identity.name!r} with this password" if identity.name else "this peer"
        expected = (
            "a learner with the same line in its --password-file; or give none if it wants none"
            if identity.name
            else "a user; name a file with its line with --password-file, or give A2S_PASSWORD"
        )
        raise RefusedError(
            f"{endpoint}: what listens there does not let {who} in; expected {expected}"
        )
    return None


def _reason(error: Exception) -> str:
    """Find the operating system's words in zenoh's error, for example "Address in use"."""
    found = re.search(r"\[[^\[]*?: ([^\[\]:]+) \(os error", str(error))
    return found[1] if found else str(error).split("\n")[0].split(" at /")[0]
