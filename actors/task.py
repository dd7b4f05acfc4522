"""What a worker process is to do."""

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """What the supervisor tells a worker process.

    Attributes:
        label: Place among the workers, for names and messages, for example ``host-0``.
        worker: The number in it.
        connect: Endpoint of the learner.
        num_envs: Environments to step; ``None`` leaves it to the learner.
        outbox_steps: Steps that may wait for an answer.
        evaluates: It is an evaluator, and takes no part in the run.
        allow_env: Code that a learner may have it run, as `require_allowed` takes it.
        fast_envs: Step Gymnasium's own environments faster, to the same results.
        cause: Why the process before it in this place was replaced; empty if there was no other.
        known_as: Name in the certificate, or of the user; the label begins with it.
        tls: Folder of certificates, as `a2s.protocol.identity.Security` takes it.
        password_file: File with a password, likewise.
    """

    label: str
    worker: int
    connect: str
    run: str
    num_envs: int | None
    outbox_steps: int
    evaluates: bool = False
    allow_env: Sequence[str] = ()
    fast_envs: bool = True
    cause: str = ""
    known_as: str = ""
    tls: str | None = None
    password_file: str | None = None
