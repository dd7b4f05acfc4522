"""The counts of all workers: labelled, cumulative, never falling when a process is replaced."""

import urllib.request

import pytest
from prometheus_client.parser import text_string_to_metric_families

from a2s.actors.metrics import ActorMetrics, Fleet, serve
from a2s.protocol.errors import UsageError


def _scrape(fleet: Fleet) -> dict[tuple[str, ...], float]:
    port = serve(fleet, "127.0.0.1", 0)
    text = urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics").read().decode()
    return {
        (sample.name, *(f"{k}={v}" for k, v in sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_counts_of_a_dead_worker_are_kept_and_added_to() -> None:
    fleet = Fleet(2)
    for steps in (100, 30):
        metrics = ActorMetrics()
        metrics.env_steps.inc(steps)
        metrics.acks.labels("accepted").inc()
        metrics.send_seconds.observe(0.3)
        metrics.epoch.set(3)
        fleet.update(1, metrics.samples())
        assert _scrape(fleet)["a2s_actor_epoch", "worker=1"] == 3
        fleet.ended(1)
        fleet.restarted(1)
    seen = _scrape(fleet)
    assert seen["a2s_actor_env_steps_total", "worker=0"] == 0
    assert seen["a2s_actor_env_steps_total", "worker=1"] == 130
    assert seen["a2s_actor_acks_total", "result=accepted", "worker=1"] == 2
    assert seen["a2s_actor_restarts_total", "worker=1"] == 2
    assert seen["a2s_actor_worker_up", "worker=1"] == 0
    assert ("a2s_actor_epoch", "worker=1") not in seen  # the state of a process that is gone
    assert seen["a2s_actor_send_seconds_bucket", "le=0.1", "worker=1"] == 0
    assert seen["a2s_actor_send_seconds_bucket", "le=0.5", "worker=1"] == 2
    assert seen["a2s_actor_send_seconds_count", "worker=1"] == 2
    assert seen["a2s_actor_send_seconds_sum", "worker=1"] == pytest.approx(0.6)


def test_a_taken_port_is_a_usage_error_that_says_what_to_do() -> None:
    port = serve(Fleet(1), "127.0.0.1", 0)
    with pytest.raises(UsageError, match=f"metrics port {port}: .*--metrics-port"):
        serve(Fleet(1), "127.0.0.1", port)


@pytest.mark.parametrize("host", ["nosuch.invalid", "a..b", "192.0.2.1"])
def test_a_host_that_is_not_here_is_a_usage_error_that_names_its_option(host: str) -> None:
    """192.0.2.1 is of documentation, and nobody's."""
    with pytest.raises(UsageError, match=rf"^--metrics-host: found '{host}', expected an address"):
        serve(Fleet(1), host, 0)
