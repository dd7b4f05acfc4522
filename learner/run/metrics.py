"""The learner's Prometheus metrics; ``docs/metrics.md`` explains every name."""

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from typing import get_args

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    Info,
    PlatformCollector,
    ProcessCollector,
    disable_created_metrics,
)

from a2s import __version__
from a2s.learner.ingest.members import Member
from a2s.learner.on_policy.stats import UpdateStats
from a2s.learner.page.history import History
from a2s.learner.page.server import Sampler, Server
from a2s.learner.run.episode_stats import EpisodeStats
from a2s.learner.run.limits import Shares
from a2s.learner.run.status import Status
from a2s.protocol.keys import MAJOR
from a2s.protocol.messages import Verdict

_LAGS = (0, 1, 2, 3, 5, 8, 13, 21, 34, 55, 100)
_SECONDS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)


class LearnerMetrics:
    """The metrics of one learner process, in a registry of their own."""

    def __init__(self) -> None:
        disable_created_metrics()  # type: ignore[no-untyped-call]
        self.registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)
        PlatformCollector(registry=self.registry)
        self.build = Info("a2s_build", "What runs here.", registry=self.registry)
        self.build.info({"version": __version__, "protocol": str(MAJOR)})
        self.run = Info("a2s_run", "Which run this is.", registry=self.registry)

        self._add_ingest()
        self._add_episodes()
        self._add_updates()
        self._add_replay()
        self._add_weights()

    def _add_ingest(self) -> None:
        self.env_steps = self._counter("env_steps", "Environment steps accepted.")
        self.received = self._counter(
            "transitions_received", "Transitions of segments, by the answer.", "result"
        )
        for verdict in get_args(Verdict):
            self.received.labels(result=verdict)  # 0 from the beginning: a share needs both sides
        self.refused = self._counter(
            "messages_refused", "Unusable messages, by kind and reason.", "message", "reason"
        )
        self.starved = self._counter("starved_seconds", "Time spent waiting for a batch.")
        self.time_share = self._gauge(
            "time_share", "What the last ten seconds went into, here and at the actors.", "part"
        )
        self.joins = self._counter("actor_joins", "Actors that joined.")
        self.leaves = self._counter("actor_leaves", "Actors that left.", "reason")
        self.actors = self._gauge("actors", "Actors present.")
        self._slots: set[int] = set()  # that were ever taken
        self.actor_up = self._gauge("actor_up", "Whether the actor at a place is there.", "slot")
        self.actor_heard = self._gauge(
            "actor_heard_timestamp_seconds", "When the actor at a place was last heard.", "slot"
        )
        self.actor_steps = self._gauge(
            "actor_env_steps", "Environment steps that the actor at a place has made.", "slot"
        )
        self.actor_version = self._gauge(
            "actor_weights_version", "Version that the actor at a place acts with.", "slot"
        )
        self.queue = self._gauge("ingest_queue_transitions", "Transitions that wait for an update.")
        self.policy_lag = self._histogram(
            "policy_lag_updates", "Versions that accepted segments were behind.", _LAGS
        )

    def _add_episodes(self) -> None:
        self.episodes = self._counter("episodes", "Finished episodes.")
        self.return_mean = self._unknown(
            "episode_return_mean", "Mean return of the last 100 episodes."
        )
        self.return_min = self._unknown("episode_return_min", "Least of the last 100 episodes.")
        self.return_max = self._unknown("episode_return_max", "Greatest of the last 100 episodes.")
        self.length_mean = self._unknown(
            "episode_length_mean_steps", "Mean length of the last 100 episodes."
        )
        self.episode_info = self._gauge(
            "episode_info_mean", "What environments told of the last 100 episodes.", "metric"
        )
        self.evaluated = {
            "mean": self._unknown(
                "eval_return_mean", "Mean return of the latest evaluation, by the mean action."
            ),
            "best-of-k": self._unknown("eval_best_of_k_return_mean", "The same, by the best of K."),
        }
        self.eval_info = self._gauge(
            "eval_info_mean", "What environments told of the latest evaluation.", "metric"
        )
        self.eval_episodes = self._counter("eval_episodes", "Episodes of evaluations.")
        self.target_steps = self._gauge("target_steps", "Environment steps at which the run ends.")

    def _add_updates(self) -> None:
        self.updates = self._counter("updates", "Updates: batches learned from.")
        self.gradient_steps = self._counter("gradient_steps", "Gradient steps.", "network")
        self.update_seconds = Histogram(
            "a2s_learner_update_seconds",
            "Where the time of an update goes.",
            ["phase"],
            buckets=_SECONDS,
            registry=self.registry,
        )
        self.loss = self._gauge("loss", "Losses of the latest update.", "loss")
        self.kl = self._unknown("kl", "KL divergence of the latest update, nats.")
        self.entropy = self._unknown("entropy", "Entropy of the policy, nats.")
        self.policy_std = self._unknown("policy_std", "Mean standard deviation of the policy.")
        self.learning_rate = self._gauge("learning_rate", "Learning rate.", "network")
        self.explained = self._gauge(
            "explained_variance", "Of returns, before they are fitted.", "network"
        )
        self.q_trusted = self._unknown(
            "q_trusted", "1 when the next suggester lets Q choose, otherwise 0."
        )
        self.q_action_correlation = self._unknown(
            "q_action_correlation",
            "Of what Q says of actions with their advantage, before it is fitted to them.",
        )
        self.q_slope = self._unknown(
            "q_slope",
            "How much of Q's difference between two actions is believed, 0..1.",
        )
        self.recoveries = self._counter("recoveries", "Recoveries of the best networks.")
        self.recovery_return = self._unknown("recovery_return", "The statistic r of equation 5.")
        self.recovery_best = self._unknown("recovery_best_return", "r* of equation 5.")
        self.epoch = self._gauge("epoch", "Recovery epoch: recoveries so far.")

    def _add_replay(self) -> None:
        self.temperature = self._unknown("temperature", "Weight of the entropy, off-policy.")
        self.q_mean = self._unknown("q_mean", "Mean of Q on the batches, in returns, off-policy.")
        self.replay_rows = self._unknown("replay_transitions", "Transitions in the replay.")
        self.replay_torn = self._counter(
            "replay_torn_records", "Pieces of segments that a kill had torn, cut when opened."
        )
        self.limiter_error = self._unknown(
            "samples_per_insert_error",
            "Transitions by which sampling is behind its wanted ratio; negative: ahead.",
        )
        self.limiter_waits = self._counter(
            "samples_per_insert_waits", "Times that a side was ahead and had to wait.", "side"
        )

    def _add_weights(self) -> None:
        self.generation = self._gauge("generation", "Starts of the learner within this run.")
        self.published = self._counter("weights_published", "Versions of weights published.")
        self.weights_version = self._gauge("weights_version", "Newest version.")
        self.weights_bytes = self._gauge("weights_bytes", "Size of the newest graph.")
        self.checkpoint_time = self._unknown(
            "checkpoint_timestamp_seconds", "When the latest checkpoint was written."
        )
        self.checkpoint_bytes = self._unknown("checkpoint_bytes", "Size of the latest checkpoint.")
        self.checkpoint_failures = self._counter(
            "checkpoint_failures", "Checkpoints that could not be written."
        )
        self.checkpoint_seconds = self._histogram(
            "checkpoint_seconds", "Time to write a checkpoint.", _SECONDS
        )

    def _counter(self, name: str, text: str, *labels: str) -> Counter:
        return Counter(f"a2s_learner_{name}", text, labels, registry=self.registry)

    def _gauge(self, name: str, text: str, *labels: str) -> Gauge:
        return Gauge(f"a2s_learner_{name}", text, labels, registry=self.registry)

    def _unknown(self, name: str, text: str) -> Gauge:
        """Make a gauge that is NaN, and not a plausible 0, until it has a value."""
        gauge = self._gauge(name, text)
        gauge.set(math.nan)
        return gauge

    def _histogram(self, name: str, text: str, buckets: tuple[float, ...]) -> Histogram:
        return Histogram(f"a2s_learner_{name}", text, buckets=buckets, registry=self.registry)

    def show_update(self, stats: UpdateStats) -> None:
        """Show the numbers of an update."""
        self.updates.inc()
        for network in ("q", "value"):
            self.explained.labels(network=network).set(
                getattr(stats, f"{network}_explained_variance")
            )
            self.gradient_steps.labels(network=network).inc(getattr(stats, f"{network}_fit_steps"))
            self.loss.labels(loss=network).set(getattr(stats, f"{network}_loss"))
        self.learning_rate.labels(network="policy").set(stats.learning_rate)
        self.learning_rate.labels(network="value").set(stats.critic_learning_rate)
        self.learning_rate.labels(network="q").set(stats.q_learning_rate)
        self.loss.labels(loss="policy").set(stats.policy_loss)
        self.loss.labels(loss="distil").set(stats.distil_loss)
        self.kl.set(stats.kl)
        self.entropy.set(stats.entropy)
        self.policy_std.set(stats.std)
        self.q_trusted.set(stats.q_trusted)
        self.q_action_correlation.set(stats.q_action_correlation)
        self.q_slope.set(stats.q_slope)
        if stats.recovery is not None and stats.recovery.r is not None:
            self.recovery_return.set(stats.recovery.r)
            best = stats.recovery.r_best
            self.recovery_best.set(stats.recovery.r if best is None else best)

    def show_off_policy(self, row: Mapping[str, float | None], counts: Mapping[str, int]) -> None:
        """Show the means over the updates of a round, and how many had each number."""
        self.updates.inc()
        self.count_gradient_steps(counts["q_loss"], counts["policy_loss"])
        gauges = {"entropy": self.entropy, "temperature": self.temperature, "q_mean": self.q_mean}
        losses = {f"{network}_loss": self.loss.labels(loss=network) for network in ("q", "policy")}
        for name, gauge in (gauges | losses).items():
            if (value := row[name]) is not None:
                gauge.set(value)

    def count_gradient_steps(self, q: int, policy: int) -> None:
        """Count gradient steps of each critic, and of the policy."""
        self.gradient_steps.labels(network="q").inc(q)
        self.gradient_steps.labels(network="policy").inc(policy)

    def show_episodes(self, episodes: EpisodeStats) -> None:
        """Show the latest episodes."""
        for name, mean in episodes.mean_metrics.items():
            self.episode_info.labels(metric=name).set(mean)
        if returns := episodes.returns:
            self.return_mean.set(sum(returns) / len(returns))
            self.return_min.set(min(returns))
            self.return_max.set(max(returns))
            self.length_mean.set(sum(episodes.lengths) / len(episodes.lengths))

    def show_evaluation(
        self, mode: str, returns: Sequence[float], metrics: Mapping[str, float]
    ) -> None:
        """Show an evaluation in one way of acting, and the environment's metrics then."""
        for name, mean in metrics.items():
            self.eval_info.labels(metric=name).set(mean)
        self.evaluated[mode].set(sum(returns) / len(returns))
        self.eval_episodes.inc(len(returns))

    def go_on(self, status: Status) -> None:
        """Count from where a run was; its steps are counted by the ledger."""
        self.updates.inc(status.rows)
        self.episodes.inc(status.episodes.count)
        self.recoveries.inc(status.num_recoveries)
        self.show_episodes(status.episodes)

    def show_actors(self, members: Sequence[Member]) -> None:
        """Show the actors that are present, and that those of before are gone."""
        self.actors.set(len(members))
        since_s = time.time() - time.monotonic()
        for slot in self._slots - {member.slot for member in members}:
            self.actor_up.labels(slot=slot).set(0)
        for member in members:
            self._slots.add(member.slot)
            self.actor_up.labels(slot=member.slot).set(1)
            self.actor_heard.labels(slot=member.slot).set(since_s + member.heard_s)
            if member.status is not None:
                self.actor_steps.labels(slot=member.slot).set(member.status.env_steps)
                self.actor_version.labels(slot=member.slot).set(member.status.weights_version)

    def show_limits(self, shares: Shares | None) -> None:
        """Show what the last seconds went into; nothing while that is not known."""
        if shares is None:
            self.time_share.clear()
            return
        for part, share in shares._asdict().items():
            self.time_share.labels(part=part).set(share)

    @contextmanager
    def served(self, host: str, port: int) -> Iterator[int]:
        """Serve them, and the live page of them, over HTTP while the block lasts; gives the port.

        Raises:
            UsageError: The port is taken.
        """
        history = History()
        with (
            closing(Server([history], host, port, "--metrics-port", self.registry)) as server,
            closing(Sampler(lambda: history.take(time.time(), self.registry.collect()))),
        ):
            yield server.port
