"""Write the dashboard of a run: ``python deploy/grafana/build_dashboard.py``.

Grafana's JSON says everything a hundred times; here every panel is said once. The test
``tests/deploy/test_dashboard.py`` holds the committed file to what this writes.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

OUTPUT = Path(__file__).parent / "dashboards" / "a2s-run.json"

_DATASOURCE = {"type": "prometheus", "uid": "${datasource}"}
_COLUMNS = 24
_HEIGHT = 8


class Panel(NamedTuple):
    """One panel.

    Attributes:
        title: Of the panel.
        description: What is seen, and what it means when it looks odd.
        unit: Grafana's name of the unit.
        targets: Legend to PromQL. ``{}`` stands for the chosen runs.
        kind: ``timeseries`` or ``stat``.
        width: Of 24 columns.
        decimals: Shown after the point; ``None`` leaves it to Grafana.
    """

    title: str
    description: str
    unit: str
    targets: dict[str, str]
    kind: str = "timeseries"
    width: int = 8
    decimals: int | None = None


def _rate(counter: str, by: str = "", function: str = "rate") -> str:
    labels = ", ".join(filter(None, ["run", by]))
    return f"sum by ({labels}) ({function}({counter}{{}}[$__rate_interval]))"


def _quantiles(histogram: str, *quantiles: float) -> dict[str, str]:
    return {
        f"{{{{run}}}} p{quantile * 100:.0f}": (
            f"histogram_quantile({quantile}, {_rate(f'{histogram}_bucket', 'le')})"
        )
        for quantile in quantiles
    }


_RUN = 'run=~"$run"'
_LEARNER = f'{{job="a2s-learner", {_RUN}}}'
_STEPS, _TARGET = "a2s_learner_env_steps_total{}", "a2s_learner_target_steps{}"
_WORKER = "{{instance}} {{worker}}"

ROWS: dict[str, list[Panel]] = {
    "Learning": [
        Panel(
            "Episode return",
            "Of the last 100 episodes, as they were played for training: with exploration.",
            "none",
            {
                "{{run}} mean": "a2s_learner_episode_return_mean{}",
                "{{run}} evaluation": "a2s_learner_eval_return_mean{}",
                "{{run}} min": "a2s_learner_episode_return_min{}",
                "{{run}} max": "a2s_learner_episode_return_max{}",
            },
            width=10,
        ),
        Panel(
            "Environment steps per second",
            "Accepted by the learner: the speed of the run. At 0 nothing arrives.",
            "none",
            {"{{run}}": _rate("a2s_learner_env_steps_total")},
            width=8,
        ),
        Panel(
            "Progress",
            "Environment steps that this learner has accepted, of those at which the run ends.",
            "percentunit",
            {"{{run}}": f"sum by (run) ({_STEPS}) / sum by (run) ({_TARGET})"},
            kind="stat",
            width=3,
            decimals=1,
        ),
        Panel(
            "Time left",
            "To the end of the run, at the present speed.",
            "s",
            {
                "{{run}}": (
                    f"(sum by (run) ({_TARGET}) - sum by (run) ({_STEPS})) / "
                    f"{_rate('a2s_learner_env_steps_total')}"
                )
            },
            kind="stat",
            width=3,
        ),
        Panel(
            "Losses",
            "Of the latest update. Not to be compared with each other: only their course tells.",
            "none",
            {"{{run}} {{loss}}": "a2s_learner_loss{}"},
        ),
        Panel(
            "KL divergence",
            "How far the latest update moved the policy, in nats. The kl rule of the learning rate "
            "holds it near its target; peaks are steps that were too large.",
            "none",
            {"{{run}}": "a2s_learner_kl{}"},
        ),
        Panel(
            "Learning rate",
            "Of each network, after the rule has changed it.",
            "sci",
            {"{{run}} {{network}}": "a2s_learner_learning_rate{}"},
        ),
        Panel(
            "Entropy and standard deviation",
            "Of the policy: entropy in nats, and the mean standard deviation of its suggestions. "
            "An early collapse means that it no longer explores.",
            "none",
            {
                "{{run}} entropy": "a2s_learner_entropy{}",
                "{{run}} std": "a2s_learner_policy_std{}",
            },
        ),
        Panel(
            "Explained variance",
            "Of returns by Q and V, before they are fitted to them. 1 is perfect, 0 is as good as "
            "the mean, below 0 is worse than that.",
            "none",
            {"{{run}} {{network}}": "a2s_learner_explained_variance{}"},
        ),
        Panel(
            "Does Q know the actions apart?",
            "Correlation of what Q says of executed actions with their advantage, before Q is "
            "fitted to them; how much of it is believed; and whether Q may choose: 1 or 0.",
            "none",
            {
                "{{run}} correlation": "a2s_learner_q_action_correlation{}",
                "{{run}} believed": "a2s_learner_q_slope{}",
                "{{run}} trusted": "a2s_learner_q_trusted{}",
            },
        ),
        Panel(
            "Recovery: r and r*",
            "Equation 5 compares the return r with the best so far, r*; far below it the best "
            "networks are restored. Empty where recovery is off.",
            "none",
            {
                "{{run}} r": "a2s_learner_recovery_return{}",
                "{{run}} r*": "a2s_learner_recovery_best_return{}",
            },
        ),
        Panel(
            "Recovery epoch",
            "Rises by one with every recovery. The lowest epoch of the actors follows at once; one "
            "that stays behind does not hear the learner.",
            "none",
            {
                "{{run}} learner": "max by (run) (a2s_learner_epoch{})",
                "{{run}} lowest of the actors": "min by (run) (a2s_actor_epoch{})",
            },
            decimals=0,
        ),
        Panel(
            "Where the learner's time goes",
            "Share of time spent waiting for a batch, computing and publishing. Mostly waiting: "
            "more actors help. Mostly computing: more actors do not.",
            "percentunit",
            {
                "{{run}} waiting": _rate("a2s_learner_starved_seconds_total"),
                "{{run}} {{phase}}": _rate("a2s_learner_update_seconds_sum", "phase"),
            },
        ),
    ],
    "Acting": [
        Panel(
            "Environment steps per second by worker",
            "Every worker process of every `a2s actor`. In lockstep all wait for the slowest.",
            "none",
            {_WORKER: "rate(a2s_actor_env_steps_total{}[$__rate_interval])"},
        ),
        Panel(
            "Time of one environment step",
            "Physics, over all workers. What it takes is the floor of the cost of acting.",
            "s",
            _quantiles("a2s_actor_env_step_seconds", 0.5, 0.99),
        ),
        Panel(
            "Time of one selection",
            "One batched call for all environments of a worker: the suggestions, their Q values, "
            "the choice.",
            "s",
            _quantiles("a2s_actor_select_seconds", 0.5, 0.99),
        ),
        Panel(
            "Q spread of the suggestions",
            "Highest minus mean Q over the suggestions, in the latest call. At 0 Q has no say.",
            "none",
            {_WORKER: "a2s_actor_suggestion_q_spread{}"},
        ),
        Panel(
            "Episode length",
            "In steps: the learner's mean over the last 100 episodes, quantiles over all actors.",
            "none",
            {
                "{{run}} mean of 100": "a2s_learner_episode_length_mean_steps{}",
                **_quantiles("a2s_actor_episode_length_steps", 0.5, 0.95),
            },
        ),
        Panel(
            "Ends of episodes per second",
            "Terminated: the environment says that it is over. Truncated: its time limit.",
            "none",
            {"{{run}} {{end}}": _rate("a2s_actor_episodes_total", "end")},
        ),
    ],
    "Wire": [
        Panel(
            "Time from send to answer",
            "Of one segment: link, queue of the learner, disk. One that is sent again begins anew.",
            "s",
            _quantiles("a2s_actor_send_seconds", 0.5, 0.99),
        ),
        Panel(
            "Answers per second",
            "Of the learner, by verdict. Duplicates are harmless; stale is work thrown away; "
            "refused is unusable.",
            "none",
            {"{{run}} {{result}}": _rate("a2s_actor_acks_total", "result")},
        ),
        Panel(
            "Transitions received per second",
            "By the learner, by verdict.",
            "none",
            {"{{run}} {{result}}": _rate("a2s_learner_transitions_received_total", "result")},
        ),
        Panel(
            "Retries per second",
            "Segments sent again because there was no answer. Steadily above 0: the learner is "
            "away or the link loses messages.",
            "none",
            {"{{run}}": _rate("a2s_actor_retries_total")},
        ),
        Panel(
            "Outbox",
            "Share of what an actor may keep while the learner does not answer. At 100 % it waits.",
            "percentunit",
            {_WORKER: "a2s_actor_outbox_transitions{} / a2s_actor_outbox_capacity_transitions{}"},
        ),
        Panel(
            "Policy lag",
            "Versions that accepted segments were behind. 0 in lockstep.",
            "none",
            _quantiles("a2s_learner_policy_lag_updates", 0.5, 0.95),
        ),
        Panel(
            "Age of the weights in use",
            "Since they reached the worker. It grows while the learner publishes nothing, or while "
            "a worker does not hear it.",
            "s",
            {_WORKER: "time() - a2s_actor_weights_received_timestamp_seconds{}"},
        ),
        Panel(
            "Refused messages",
            "By kind of message and reason. Empty is good.",
            "none",
            {
                "{{run}} {{message}} {{reason}}": _rate(
                    "a2s_learner_messages_refused_total", "message, reason", "increase"
                )
            },
        ),
        Panel(
            "Transitions dropped by actors",
            "By reason: malformed numbers of an environment, or no answer before the end. Empty is "
            "good.",
            "none",
            {
                "{{run}} {{reason}}": _rate(
                    "a2s_actor_dropped_transitions_total", "reason", "increase"
                )
            },
        ),
        Panel(
            "Actors present",
            "Worker processes that the learner knows, and those that report to their `a2s actor`.",
            "none",
            {
                "{{run}} joined": "a2s_learner_actors{}",
                "{{run}} up": "sum by (run) (a2s_actor_worker_up{})",
            },
            decimals=0,
        ),
        Panel(
            "Joins and restarts",
            "Joins of the learner, and worker processes that died and were replaced.",
            "none",
            {
                "{{run}} joins": _rate("a2s_learner_actor_joins_total", function="increase"),
                "{{run}} restarts": _rate("a2s_actor_restarts_total", function="increase"),
            },
            decimals=0,
        ),
        Panel(
            "Traffic",
            "Bytes per second of all actors: segments out, weights in.",
            "Bps",
            {
                "{{run}} segments": _rate("a2s_actor_sent_bytes_total"),
                "{{run}} weights": _rate("a2s_actor_weights_received_bytes_total"),
            },
        ),
    ],
    "Resources": [
        Panel(
            "Processors",
            "Processors kept busy by each process. 1 is a whole one.",
            "none",
            {
                "{{instance}} learner": (
                    f"rate(process_cpu_seconds_total{_LEARNER}[$__rate_interval])"
                ),
                _WORKER: "rate(a2s_actor_cpu_seconds_total{}[$__rate_interval])",
            },
        ),
        Panel(
            "Memory",
            "Resident memory of each process.",
            "bytes",
            {
                "{{instance}} learner": f"process_resident_memory_bytes{_LEARNER}",
                _WORKER: "a2s_actor_resident_memory_bytes{}",
            },
        ),
        Panel(
            "Transitions that wait for an update",
            "In the learner. Held near 0 in lockstep, below a few batches otherwise.",
            "none",
            {"{{run}}": "a2s_learner_ingest_queue_transitions{}"},
        ),
        Panel(
            "Age of the checkpoint",
            "What is learned again if the learner is killed now; nothing acknowledged is lost.",
            "s",
            {"{{run}}": "time() - a2s_learner_checkpoint_timestamp_seconds{}"},
        ),
        Panel(
            "Size of checkpoint and weights",
            "Of the latest checkpoint, and of the graph that every actor fetches.",
            "bytes",
            {
                "{{run}} checkpoint": "a2s_learner_checkpoint_bytes{}",
                "{{run}} weights": "a2s_learner_weights_bytes{}",
            },
        ),
        Panel(
            "Time of one update",
            "By phase, on average.",
            "s",
            {
                "{{run}} {{phase}}": (
                    f"{_rate('a2s_learner_update_seconds_sum', 'phase')}"
                    f" / {_rate('a2s_learner_update_seconds_count', 'phase')}"
                )
            },
        ),
    ],
}


def dashboard() -> dict[str, Any]:
    """Lay the panels out, row by row."""
    panels: list[dict[str, Any]] = []
    top = 0
    for title, row in ROWS.items():
        panels.append(_row(len(panels) + 1, title, top))
        top += 1
        left = 0
        for panel in row:
            if left + panel.width > _COLUMNS:
                left, top = 0, top + _HEIGHT
            place = {"x": left, "y": top, "w": panel.width, "h": _HEIGHT}
            panels.append(_panel(len(panels) + 1, panel, place))
            left += panel.width
        top += _HEIGHT
    return {
        "uid": "a2s-run",
        "title": "a2s run",
        "description": "One run or several: learning, acting, the wire between, and what they use.",
        "tags": ["a2s"],
        "editable": False,
        "schemaVersion": 39,
        "version": 1,
        "refresh": "10s",
        "time": {"from": "now-30m", "to": "now"},
        "timezone": "browser",
        "graphTooltip": 1,
        "templating": {"list": _variables()},
        "panels": panels,
    }


def _variables() -> list[dict[str, Any]]:
    query = "label_values(a2s_learner_env_steps_total, run)"
    return [
        {
            "name": "datasource",
            "label": "Data source",
            "type": "datasource",
            "query": "prometheus",
            "hide": 0,
        },
        {
            "name": "run",
            "label": "Run",
            "type": "query",
            "datasource": _DATASOURCE,
            "definition": query,
            "query": {"query": query, "refId": "run"},
            "refresh": 2,
            "sort": 1,
            "multi": True,
            "includeAll": True,
            # Also where a scrape configuration gives no label `run`.
            "allValue": ".*",
            "current": {"text": ["All"], "value": ["$__all"]},
        },
    ]


def _row(number: int, title: str, top: int) -> dict[str, Any]:
    place = {"x": 0, "y": top, "w": _COLUMNS, "h": 1}
    return {
        "id": number,
        "type": "row",
        "title": title,
        "collapsed": False,
        "gridPos": place,
        "panels": [],
    }


def _panel(number: int, panel: Panel, place: dict[str, int]) -> dict[str, Any]:
    defaults: dict[str, Any] = {"unit": panel.unit}
    if panel.decimals is not None:
        defaults["decimals"] = panel.decimals
    options: dict[str, Any] = {
        "legend": {"displayMode": "list", "placement": "bottom", "showLegend": True, "calcs": []},
        "tooltip": {"mode": "multi", "sort": "desc"},
    }
    if panel.kind == "stat":
        options = {"reduceOptions": {"calcs": ["lastNotNull"], "values": False}}
    else:
        defaults["custom"] = {"drawStyle": "line", "lineWidth": 1, "showPoints": "never"}
    return {
        "id": number,
        "type": panel.kind,
        "title": panel.title,
        "description": panel.description,
        "datasource": _DATASOURCE,
        "gridPos": place,
        "fieldConfig": {"defaults": defaults, "overrides": []},
        "options": options,
        "targets": [
            {
                "refId": chr(ord("A") + index),
                "datasource": _DATASOURCE,
                "expr": _of_chosen_runs(expression),
                "legendFormat": legend,
            }
            for index, (legend, expression) in enumerate(panel.targets.items())
        ],
    }


def _of_chosen_runs(expression: str) -> str:
    return expression.replace("{}", f"{{{_RUN}}}")


if __name__ == "__main__":
    OUTPUT.write_text(json.dumps(dashboard(), indent=2) + "\n")
