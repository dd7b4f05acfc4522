"""The process of one actor, as its supervisor sees it."""

from collections.abc import Callable
from dataclasses import asdict

from a2s.actors.children import Child, Report
from a2s.actors.task import Task
from a2s.commands.process import free_endpoint


def test_a_worker_that_waits_for_a_learner_reports(wait_for: Callable[..., None]) -> None:
    """One that has become silent is taken for dead, and ended."""
    task = Task(
        label="a-0", worker=0, connect=free_endpoint(), run="r", num_envs=None, outbox_steps=100
    )
    reports: list[Report] = []
    child = Child("a2s.actors.worker", asdict(task), reports.append, lambda _: None)
    try:
        wait_for(lambda: len(reports) > 2, "more reports than that of the start")
    finally:
        child.kill()
