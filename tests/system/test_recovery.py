"""Recovery over the wire: journaled, broadcast, followed by every actor, and replayable."""

import csv
import json
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from system_helpers import FAST, OFTEN, PATIENCE_S, REACH, Start, metrics_port, scrape

from a2s.learner.on_policy.recovery import Recovery
from a2s.protocol.codec import decode
from a2s.protocol.keys import Keys
from a2s.protocol.messages import RecoveryEvent
from a2s.protocol.zenoh_bus import ZenohBus

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

WaitFor = Callable[..., None]


def _table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize(
    "overlaps",
    [False, pytest.param(True, marks=pytest.mark.long)],
    ids=["in turns", "acting while learning"],
)
def test_recoveries_are_journaled_followed_and_replayable(
    start: Start, endpoint: str, tmp_path: Path, wait_for: WaitFor, overlaps: bool
) -> None:
    path = tmp_path / "run"
    learner = start(
        "learner", *REACH, *FAST, *OFTEN, "--listen", endpoint, "--run-dir", str(path),
        "--total-steps", "6000", "--metrics-port", "-1", "--n", "2",
        "--set", f"act_while_learning={str(overlaps).lower()}",
    )  # fmt: skip
    wait_for(lambda: "/metrics" in learner.text() or "off" in learner.text(), "the learner")
    heard: list[RecoveryEvent] = []
    with closing(ZenohBus.connect(endpoint, lambda: learner.process.poll() is None)) as bus:
        bus.subscribe(Keys("default").recovery, lambda p: heard.append(decode(p, RecoveryEvent)))
        actor = start("actor", "--n", "2", "--connect", endpoint, "--metrics-port", "0")
        assert learner.process.wait(PATIENCE_S) == 0, learner.text()

    journal = [json.loads(x) for x in (path / "events.jsonl").read_text().splitlines()]
    recoveries = [event for event in journal if event["event"] == "recovery"]
    assert len(recoveries) >= 2
    assert [e["id"] for e in recoveries] == list(range(1, len(recoveries) + 1))
    assert [(e.id, e.draw, e.restored_version) for e in heard] == [
        (e["id"], e["draw"], e["restored_version"]) for e in recoveries
    ]
    # Whoever acted after the last recovery has followed it; the last update may be one itself.
    updates = _table(path / "updates.csv")
    followed = len(recoveries) - int(updates[-1]["recovered"])
    port = metrics_port(actor)
    for worker in ("0", "1"):
        name = f'a2s_actor_recovery_events_total{{worker="{worker}"}}'
        wait_for(lambda name=name: scrape(port)[name] == followed, f"{followed} in {name}")
        assert scrape(port)[f'a2s_actor_epoch{{worker="{worker}"}}'] == followed

    rule = Recovery(rule="invariant", bias=0.0, statistic="mean", episodes=0)
    episodes = _table(path / "episodes.csv")
    for row in updates:
        made_by = str(int(row["weights_version"]) - 1 - overlaps * int(row["recovered"]))
        returns = [float(e["return"]) for e in episodes if e["weights_version"] == made_by]
        decision = rule.judge(returns, float(row["recovery_draw"]))
        assert decision.recover is (row["recovered"] == "1"), row
