"""Who may do what in a run: the rules that the learner's session enforces on every link.

A peer is known by the common name of its certificate, or by its user name: a *role*, ``actor`` or
``viewer``, or a role and a name, ``actor-lab1``. What is not allowed here is dropped without a word
(docs/security.md).
"""

import re
from collections.abc import Iterable
from typing import Any, Literal

from a2s.protocol.keys import ANY_LEARNER, Keys

LEARNER, ACTOR, VIEWER = "learner", "actor", "viewer"
KnownBy = Literal["cert_common_names", "usernames"]
NAMES = f"{ACTOR}, {VIEWER}, {ACTOR}-NAME or {VIEWER}-NAME, NAME of A-Z a-z 0-9 _ and -"
_NAME = re.compile(rf"({LEARNER}|{ACTOR}|{VIEWER})(-[A-Za-z0-9_][A-Za-z0-9_-]{{0,31}})?")


def role_of(name: str) -> str:
    """Give the role in the name of a peer; empty: there is none."""
    found = _NAME.fullmatch(name)
    return found[1] if found else ""


def rules(keys: Keys, known_by: KnownBy, names: Iterable[str]) -> dict[str, Any]:
    """Write zenoh's ``access_control`` for the learner of a run and peers with these names.

    An actor joins, plays and is seen under names that begin with its own and a dot. A learner
    among the peers may do what a viewer may: it is another one, which learns from the replay.
    """
    all_read = [keys.notice, keys.weights, keys.status]
    viewing = [
        *_listening(keys),
        *_asking(VIEWER, all_read, [keys.replay_info, keys.replay_sample]),
    ]
    acting = _asking(
        ACTOR, all_read, [keys.hello_of_major_1, keys.evaluation_task, keys.evaluation_result]
    )
    found, subjects, policies = [*viewing, *acting], [], []
    for name in dict.fromkeys(names):
        own = viewing
        if role_of(name) == ACTOR:
            being = _being(keys, name)
            found += being
            own = [*_listening(keys), *acting, *being]
        subjects.append({"id": name, known_by: [name]})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": found,
        "subjects": subjects,
        "policies": policies,
    }


def _asking(who: str, *keys: list[str]) -> list[dict[str, Any]]:
    """Ask the learner, and know that it answers."""
    asked = [key for each in keys for key in each]
    return [
        _rule(f"{who} asks", "ingress", ["query"], asked),
        _rule(f"{who} is answered", "egress", ["reply", "declare_queryable"], asked),
    ]


def _listening(keys: Keys) -> list[dict[str, Any]]:
    """Hear what the learner says to all, and whether learners are there."""
    said, present = [keys.notice, keys.recovery, keys.status], [keys.live_learner, ANY_LEARNER]
    looking = ["liveliness_query", "declare_liveliness_subscriber"]
    return [
        _rule("all listen", "ingress", ["declare_subscriber"], said),
        _rule("all hear", "egress", ["put"], said),
        _rule("all look", "ingress", looking, present),
        _rule("all see", "egress", ["reply", "liveliness_token"], present),
    ]


def _being(keys: Keys, name: str) -> list[dict[str, Any]]:
    """Join, play and be seen as one of the actors of this name.

    The learner refuses a message of another actor than its key says.
    """
    own = f"{name}.$*"
    return [
        *_asking(f"one of {name}", [keys.hello_of(own), keys.segment_of(own)]),
        _rule(
            f"{name} hears of",
            "egress",
            ["declare_queryable"],
            [keys.hello_of(), keys.segment_of()],
        ),
        _rule(f"{name} is present", "ingress", ["liveliness_token"], [keys.live_actor(own)]),
        _rule(f"{name} reports", "ingress", ["put"], [keys.actor_status(own)]),
    ]


def _rule(id_: str, flow: str, messages: list[str], keys: list[str]) -> dict[str, Any]:
    return {
        "id": id_, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys
    }  # fmt: skip
