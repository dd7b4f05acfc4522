"""Learn in one process, without a network: python benchmarks/probe.py Walker2d-v5 --seed 100.

For choosing between settings by many short runs: a run of ``--total-steps`` with one actor of 16
environments, which ends at ``--steps``. Every ``--every`` steps the mean action plays ten fresh
episodes side by side, and one line says what they return, and what Q knew of the last batches.
"""

import argparse
import sys
import time
from collections.abc import Sequence

import gymnasium
import numpy as np
import torch

from a2s.actors.environments.environment import Environment
from a2s.actors.metrics import ActorMetrics
from a2s.actors.rollout import Rollout
from a2s.actors.suggester import Suggester
from a2s.actors.troubles import Troubles
from a2s.learner.export.metadata import policy_metadata
from a2s.learner.off_policy.config import OffPolicyConfig
from a2s.learner.on_policy_trainer import OnPolicyTrainer
from a2s.learner.run.config import assemble, parse_settings
from a2s.learner.run.metrics import LearnerMetrics
from a2s.protocol.messages import Notice

ENVS, EPISODES, EVALUATION_SEED = 16, 10, 2000
SHOWN = ("q_action_correlation", "pull_strength", "kl")


def played(env_id: str, graph: bytes) -> float:
    """Mean return of fresh episodes by the mean action."""
    envs = [gymnasium.make(env_id) for _ in range(EPISODES)]
    suggester, rng = Suggester(graph, "mean"), np.random.default_rng(EVALUATION_SEED)
    obs = {i: env.reset(seed=EVALUATION_SEED + i)[0] for i, env in enumerate(envs)}
    total = 0.0
    while obs:
        numbers = list(obs)
        action = suggester(np.array([obs[i] for i in numbers], np.float32), rng).action
        for i, chosen in zip(numbers, action, strict=True):
            obs[i], reward, terminated, truncated, _ = envs[i].step(chosen)
            total += float(reward)
            if terminated or truncated:
                del obs[i]
    return total / EPISODES


def probe(options: dict[str, object], settings: Sequence[str], steps: int, every: int) -> None:
    """Learn, and write one line for every evaluation."""
    configuration = assemble(options, parse_settings([*settings]))
    run, hyper, begin_s = configuration.run, configuration.hyper, time.monotonic()
    assert not isinstance(hyper, OffPolicyConfig)
    environments = [Environment(run.env_config(), index=i) for i in range(ENVS)]
    metadata = policy_metadata(run, environments[0].spaces)
    trainer = OnPolicyTrainer(environments[0].spaces, hyper, run.seed, metadata, LearnerMetrics())
    rollout = Rollout("probe", environments, run.seed, ActorMetrics(), Troubles())
    done, version, rows = 0, 0, []
    graph = trainer.graph(version, 0.0)
    while done < steps:
        quota = trainer.quota(ENVS)
        notice = Notice(
            generation=1, epoch=0, version=version, quota_steps=quota.steps,
            quota_episodes=quota.episodes, num_bytes=len(graph), sha256="",
        )  # fmt: skip
        before = done
        for segment in rollout.play(Suggester(graph), notice, lambda: False):
            trainer.store(0, segment)
            done += segment.num_steps
        trainer.close_batch()
        rows.append(trainer.learn(done / run.total_steps).row)
        version += 1
        graph = trainer.graph(version, done / run.total_steps)
        if done // every > before // every:
            said = " ".join(f"{name} {np.mean([row[name] for row in rows]):.3f}" for name in SHOWN)
            spent = time.monotonic() - begin_s
            sys.stdout.write(f"{done} {played(run.env, graph):.0f} {said} {spent:.0f} s\n")
            sys.stdout.flush()
            rows = []


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("env")
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--algo", default="a2s")
    parser.add_argument("--steps", type=int, default=300_000)
    parser.add_argument("--total-steps", type=int, default=1_000_000)
    parser.add_argument("--every", type=int, default=50_000)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    torch.set_num_threads(1)
    names = ("env", "seed", "algo", "total_steps")
    options = {name: getattr(given, name) for name in names}
    probe(options, given.set, given.steps, given.every)


if __name__ == "__main__":
    main()
