"""The page of ``a2s status``."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

from a2s.commands.status import page, where
from a2s.learner.run.directory import claimed
from a2s.protocol.errors import UsageError
from a2s.protocol.messages import ActorStatus, RunStatus

ACTOR = ActorStatus(
    actor="host-0-1f", slot=0, weights_version=201, epoch=1, env_steps=206_150, episodes=400,
    segments_sent=5003, segments_answered=5000, spooled_steps=96, leaving=False,
    environment_s=30.0, selection_s=10.0, sending_s=0.0, waiting_s=60.0,
)  # fmt: skip
RUN = RunStatus(
    run="hop", generation=1, env_id="Hopper-v5", env_steps=412_300, total_steps=1_000_000,
    episodes=812, updates=201, weights_version=202, epoch=1, return_mean=3214.53,
    env_steps_per_s=4100.0, waiting_for="", actors=(ACTOR,), limited_by="learner",
)  # fmt: skip


def test_a_page_has_progress_limit_and_a_row_an_actor() -> None:
    """587,700 steps at 4,100 a second are 143 s."""
    assert list(page(RUN)) == [
        "run hop  Hopper-v5  412,300 of 1,000,000 steps (41%)  4,100 steps/s  0:02:23 left",
        "return 3214.5  episodes 812  updates 201  version 202  recoveries 1",
        "limited by learner",
        "actor      slot  behind    steps  episodes  unanswered  stepping  choosing",
        "host-0-1f     0       1  206,150       400           3       30%       10%",
    ]


def test_what_off_policy_counts_are_gradient_steps() -> None:
    assert "  gradient steps 201  " in list(page(replace(RUN, variant="off-policy")))[1]


def test_before_the_first_step_nothing_is_divided_by_it() -> None:
    """No rate, no return, no time of the actor."""
    idle = replace(ACTOR, environment_s=0.0, selection_s=0.0, waiting_s=0.0)
    waiting = "actors; run: a2s actor"
    run = replace(
        RUN, env_steps=0, env_steps_per_s=0.0, return_mean=math.nan, limited_by="",
        waiting_for=waiting, actors=(idle,),
    )  # fmt: skip
    first, second, third, *_, last = page(run)
    assert first == "run hop  Hopper-v5  0 of 1,000,000 steps (0%)"
    assert second.startswith("return -  ")
    assert third == f"waiting for {waiting}"
    assert last.endswith("-         -")


def test_what_an_actor_is_stuck_in_or_has_dropped_is_told() -> None:
    """A call of less than a second is no news."""
    stuck = replace(ACTOR, doing="step of environment 3 for 21 s", trouble="E: reward is nan")
    *_, doing, trouble = page(replace(RUN, actors=(stuck,)))
    assert doing == "host-0-1f: step of environment 3 for 21 s"
    assert trouble == "host-0-1f: E: reward is nan (0 steps dropped so far)"
    quick = replace(ACTOR, doing="step of environment 3 for 0 s")
    assert list(page(replace(RUN, actors=(quick,)))) == list(page(RUN))


def test_a_run_directory_says_where_its_learner_is(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"config.toml"):
        where(tmp_path)
    (tmp_path / "config.toml").write_text('[run]\nrun = "hop"\n')
    with pytest.raises(UsageError, match="is not the directory of a run with actors"):
        where(tmp_path)
    (tmp_path / "endpoint").write_text("tcp/127.0.0.1:9")
    with claimed(tmp_path):
        assert where(tmp_path) == ("hop", "tcp/127.0.0.1:9")
    with pytest.raises(UsageError, match="no learner is at work there"):
        where(tmp_path)


@pytest.mark.parametrize(
    ("endpoint", "reached"),
    [
        ("tls/0.0.0.0:7447", "tls/127.0.0.1:7447"),
        ("tls/[::]:7447", "tls/[::1]:7447"),
        ("tls/10.0.0.0:7447", "tls/10.0.0.0:7447"),
    ],
)
def test_a_learner_on_all_addresses_is_reached_on_one(
    tmp_path: Path, endpoint: str, reached: str
) -> None:
    """Its certificate is for no other."""
    (tmp_path / "config.toml").write_text("[run]\n")
    (tmp_path / "endpoint").write_text(endpoint)
    with claimed(tmp_path):
        assert where(tmp_path) == ("default", reached)
