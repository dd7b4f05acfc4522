"""The learner's metrics: what they count after a resume, and who is there."""

from collections import Counter

from a2s.learner.ingest.members import Member
from a2s.learner.run.limits import Shares
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.run.run_config import RunConfig
from a2s.learner.run.status import Status


def _value(metrics: LearnerMetrics, name: str, **labels: str) -> float | None:
    return metrics.registry.get_sample_value(f"a2s_learner_{name}", labels)


def test_a_resumed_run_counts_from_where_it_was() -> None:
    metrics, status = LearnerMetrics(), Status(RunConfig(), rows=3, num_recoveries=2)
    for episode_return in (1.0, 3.0):
        status.episodes.add(episode_return, 5, {})
    metrics.go_on(status)
    counted = [_value(metrics, f"{name}_total") for name in ("updates", "episodes", "recoveries")]
    assert counted == [3.0, 2.0, 2.0]
    assert _value(metrics, "episode_return_mean") == 2.0


def test_what_no_update_of_a_round_had_stays_as_it_was() -> None:
    """Of three updates one had the policy learn; of the next round's two none."""
    metrics = LearnerMetrics()
    row: dict[str, float | None] = dict.fromkeys(
        ("q_loss", "policy_loss", "entropy", "temperature", "q_mean"), 2.0
    )
    metrics.show_off_policy(row, {"q_loss": 3, "policy_loss": 1})
    metrics.show_off_policy(
        {**row, "q_loss": 4.0, "policy_loss": None, "entropy": None}, Counter(q_loss=2)
    )
    steps = [_value(metrics, "gradient_steps_total", network=n) for n in ("q", "policy")]
    losses = [_value(metrics, "loss", loss=n) for n in ("q", "policy")]
    assert (steps, losses) == ([5.0, 1.0], [4.0, 2.0])
    assert (_value(metrics, "updates_total"), _value(metrics, "entropy")) == (2.0, 2.0)


def test_what_limits_a_run_is_not_told_of_actors_that_have_gone() -> None:
    metrics = LearnerMetrics()
    metrics.show_limits(Shares(0.5, 0.25, 0.125, 0.125))
    assert _value(metrics, "time_share", part="environment") == 0.25
    metrics.show_limits(None)
    assert _value(metrics, "time_share", part="environment") is None


def test_an_actor_that_leaves_is_shown_as_gone() -> None:
    metrics = LearnerMetrics()
    members = [Member(actor=name, slot=i, num_envs=1, heard_s=0.0) for i, name in enumerate("ab")]
    metrics.show_actors(members)
    assert [_value(metrics, "actor_up", slot=slot) for slot in "01"] == [1.0, 1.0]
    metrics.show_actors(members[1:])
    assert [_value(metrics, "actor_up", slot=slot) for slot in "01"] == [0.0, 1.0]
    assert _value(metrics, "actors") == 1.0
