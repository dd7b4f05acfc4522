"""On-policy A2S: one update from one batch.

Source: algorithm 1 of the paper, with equations 5 and 6 of section 4.1.1. A2C is the same with one
suggestion and neither equation.
"""

import dataclasses
from typing import Any

import torch
from torch import Tensor

from a2s.learner.networks.stored import check_tensors
from a2s.learner.on_policy.acting import Suggester
from a2s.learner.on_policy.batch import Batch
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.critics import Fits, fit_critics
from a2s.learner.on_policy.policy import PolicyUpdate, policy_now, update_policy
from a2s.learner.on_policy.policy_gradient import entropy
from a2s.learner.on_policy.recovery import Recovery, RecoveryDecision
from a2s.learner.on_policy.state import Learned, Snapshot
from a2s.learner.on_policy.stats import UpdateStats
from a2s.learner.on_policy.step_size import StepSize
from a2s.learner.on_policy.suggestion import choosiness
from a2s.learner.on_policy.targets import Evidence, gather_evidence
from a2s.protocol.errors import A2SError

_GENERATORS = ("networks", "order", "q", "recovery")
_BEST = "best."


class OnPolicy:
    """The learner's networks and everything that learning them needs.

    ::

        algorithm = OnPolicy(obs_size, action_size, hyper, seed)
        while ...:
            graph = export(algorithm.suggester(low, high, progress), ...)
            stats = algorithm.update(batch)

    Args:
        obs_size: D.
        action_size: A.
        hyper: Hyperparameters.
        seed: Of the first weights and of every random choice.
    """

    def __init__(self, obs_size: int, action_size: int, hyper: OnPolicyConfig, seed: int) -> None:
        self.hyper = hyper
        root = torch.Generator().manual_seed(seed)
        seeds = torch.randint(2**62, (len(_GENERATORS),), generator=root).tolist()
        self._generators = {
            name: torch.Generator().manual_seed(each)
            for name, each in zip(_GENERATORS, seeds, strict=True)
        }
        self.learned = Learned(obs_size, action_size, hyper, self._generators["networks"])
        self._step_size = StepSize(hyper)
        self._recovery = Recovery(
            rule=hyper.recovery,
            bias=hyper.recovery_bias,
            statistic=hyper.recovery_statistic,
            episodes=hyper.recovery_episodes,
            offset=hyper.recovery_offset,
            cool_down=hyper.recovery_cool_down,
        )
        self._best: Snapshot | None = None
        self._before: Snapshot | None = None
        self._updates = 0
        self._q_trusted = hyper.warm_up == "none"

    @property
    def updates(self) -> int:
        """Batches seen."""
        return self._updates

    def suggester(
        self, action_low: Tensor, action_high: Tensor, progress: float = 0.0
    ) -> Suggester:
        """The present way of acting; it shares the networks and is valid until the next update.

        Args:
            action_low: Of the environment, float32 ``[A]``.
            action_high: Of the environment, float32 ``[A]``.
            progress: Fraction of the run that is done, 0..1; only ``anneal_selection`` reads it.
        """
        hyper, learned = self.hyper, self.learned
        choosy = choosiness(progress, fades=hyper.anneal_selection)
        picks = self._q_trusted and hyper.suggestions > 1
        return Suggester(
            normaliser=learned.normaliser,
            policy=learned.policy,
            q_net=learned.q_net if picks else None,
            action_low=action_low,
            action_high=action_high,
            mode=hyper.selection if picks else "first",
            suggestions=hyper.suggestions if picks else 1,
            temperature=hyper.selection_temperature / choosy,
            action_mode=hyper.action_mode,
            q_scale=learned.returns.std,
        )

    def update(
        self, batch: Batch, progress: float = 0.0, *, is_behind: bool = False
    ) -> UpdateStats:
        """Learn from a batch, or go back to the best networks.

        Args:
            batch: Segments made by the present networks, or by ones not much older.
            progress: Fraction of the run that is done, 0..1; only ``lr_rule = anneal`` reads it.
            is_behind: The networks before the last update made it, not the present ones.

        Raises:
            A2SError: The networks are no longer finite.
        """
        learned, step_size = self.learned, self._step_size
        decision = self._judge(batch, is_behind)
        recovers = decision is not None and decision.recover
        collected = policy_now(learned, batch.obs)
        learned.normaliser.update(batch.obs)
        evidence = gather_evidence(batch, learned, self.hyper)
        step_size.adapt(progress)
        if recovers:
            self._recover()
            collected = policy_now(learned, batch.obs)
        rates = step_size.rates(progress)
        seen = learned.normaliser(batch.obs)
        fits, moved = Fits(), PolicyUpdate()
        if not recovers:
            fits = self._fit(batch, seen, evidence, rates[1])
        if not recovers or self.hyper.recovery_learns:
            moved = update_policy(
                batch,
                seen,
                evidence,
                collected,
                learned,
                self.hyper,
                distil=self._q_trusted,
                learning_rate=rates[0],
                order=self._generators["order"],
                q_order=self._generators["q"],
            )
            per_dim = self.hyper.kl_dims == "mean"
            step_size.last_kl = moved.improvement.kl / (batch.suggestion.shape[1] if per_dim else 1)
        self._updates += 1
        if not learned.is_finite():
            raise A2SError(f"update {self._updates}: found non-finite weights, expected finite")
        return self._stats(batch, evidence, fits, moved, decision, rates)

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Everything that `load` needs to go on to the bit.

        Returns:
            Tensors by name, and numbers that survive JSON.
        """
        present = self.learned.capture(0)
        tensors = dict(present.tensors)
        for name, generator in self._generators.items():
            tensors[f"generator.{name}"] = generator.get_state()
        best = None
        if self._best is not None:
            tensors |= {_BEST + name: tensor for name, tensor in self._best.tensors.items()}
            best = {
                "returns": self._best.returns,
                "weights_version": self._best.weights_version,
            }
        scalars = {
            "returns": present.returns,
            "best": best,
            "step_size": self._step_size.state(),
            "recovery": self._recovery.state(),
            "updates": self._updates,
            "q_trusted": self._q_trusted,
        }
        return tensors, scalars

    def load(self, tensors: dict[str, Tensor], scalars: dict[str, Any]) -> None:
        """Go back to a state of an object made with the same sizes and hyperparameters.

        Raises:
            RunDirectoryError: A tensor is missing or has another shape.
        """
        expected, _ = self.state()
        check_tensors(tensors, {k: v for k, v in expected.items() if not k.startswith(_BEST)})
        present = Snapshot(tensors=tensors, returns=scalars["returns"], weights_version=0)
        self._best = None
        best = scalars["best"]
        if best is not None:
            stored = {
                name.removeprefix(_BEST): tensor.clone()
                for name, tensor in tensors.items()
                if name.startswith(_BEST)
            }
            check_tensors(stored, self.learned.capture(0).tensors)
            self._best = Snapshot(tensors=stored, **best)
        self.learned.restore(present, everything=True)
        for name, generator in self._generators.items():
            generator.set_state(tensors[f"generator.{name}"])
        self._step_size.load(scalars["step_size"])
        self._recovery.load(scalars["recovery"])
        self._updates = scalars["updates"]
        self._q_trusted = scalars["q_trusted"]

    def _judge(self, batch: Batch, is_behind: bool) -> RecoveryDecision | None:
        """Test equation 5, and keep the networks that made the batch when they are the best."""
        if self.hyper.recovery == "off":
            return None
        draw = float(torch.rand((), generator=self._generators["recovery"]))
        decision = self._recovery.judge(batch.episode_returns.tolist(), draw)
        present = self.learned.capture(0)
        if decision.improved:
            made_it = self._before if is_behind and self._before is not None else present
            version = int(batch.weights_version.max())
            self._best = dataclasses.replace(made_it, weights_version=version)
        self._before = present
        return decision

    def _recover(self) -> None:
        if self._best is None:
            raise AssertionError("there is an r* but no networks that reached it")
        everything = self.hyper.recovery_restores == "everything"
        self.learned.restore(self._best, everything=everything)
        self._step_size.after_recovery()

    def _fit(self, batch: Batch, seen: Tensor, evidence: Evidence, rate: float) -> Fits:
        """Fit Q and V; from now on Q may choose."""
        fits = fit_critics(
            batch,
            seen,
            evidence.target,
            self.learned,
            self.hyper,
            learning_rate=rate,
            order=self._generators["order"],
            q_order=self._generators["q"],
        )
        self._q_trusted = True
        return fits

    def _stats(
        self,
        batch: Batch,
        evidence: Evidence,
        fits: Fits,
        moved: PolicyUpdate,
        decision: RecoveryDecision | None,
        rates: tuple[float, float],
    ) -> UpdateStats:
        learned = self.learned
        recovered = self._best if decision is not None and decision.recover else None
        return UpdateStats(
            num_steps=batch.num_steps,
            policy_loss=moved.improvement.policy_loss,
            distil_loss=moved.distil_loss,
            q_loss=fits.q_loss,
            value_loss=fits.value_loss,
            q_fit_steps=fits.q_steps,
            value_fit_steps=fits.value_steps,
            distil_steps=moved.distil_steps,
            policy_epochs=moved.improvement.epochs,
            kl=self._step_size.last_kl if moved.improvement.epochs else 0.0,
            kl_target=self._step_size.kl_target,
            learning_rate=rates[0],
            critic_learning_rate=rates[1],
            q_explained_variance=evidence.q_explained_variance,
            q_action_correlation=evidence.q_action_correlation,
            value_explained_variance=evidence.value_explained_variance,
            advantage_std=moved.advantage_std,
            entropy=float(entropy(learned.policy.log_std)),
            std=float(learned.policy.std().mean()),
            return_mean=learned.returns.mean,
            return_std=learned.returns.std,
            q_trusted=int(self._q_trusted),
            improved=int(decision is not None and decision.improved),
            recovered=int(recovered is not None),
            restored_version=recovered.weights_version if recovered else -1,
            recovery=decision,
        )
