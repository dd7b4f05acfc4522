"""What a learner says that it waits for."""

from dataclasses import replace

import pytest
from message_examples import NOTICE, STATUS

from a2s.learner.ingest.clock import Lockstep, Round
from a2s.learner.ingest.members import Member, Members


@pytest.mark.parametrize(
    ("doing", "said"),
    [
        ("step of environment 3 for 0 s", "step of environment 3"),
        ("step of environment 3 for 10 s", "step of environment 3 for 10 s"),
    ],
)
def test_a_call_has_seconds_once_it_lasts_for_one(doing: str, said: str) -> None:
    status = replace(STATUS, leaving=False, doing=doing)
    members = Members(0, 1)
    members.coming("h-1", 0.0, doing)
    assert members.describe_newcomers(0.0) == f"h-1: {said}"
    present = Member(actor="h-1", slot=0, num_envs=1, heard_s=0.0)
    present.hear(status, 0.0)
    played = Round(notice=NOTICE, batch_steps=4, published_s=0.0)
    waits = f"segments of version {NOTICE.version} from actors [0], actor 0: {said}"
    assert Lockstep().missing(played, [present], 1.0) == waits
