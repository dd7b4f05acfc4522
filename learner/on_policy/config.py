"""The configuration of on-policy A2S. `presets.py` has its presets."""

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

from a2s.learner.settings import Settings, check_most, refuse, setting

Init = Literal["uniform", "orthogonal"]
LearningRateRule = Literal["constant", "anneal", "kl"]
RecoveryRule = Literal["off", "authors", "invariant"]
ReturnStatistic = Literal["mean", "max"]


@dataclass(frozen=True, slots=True, kw_only=True)
class OnPolicyConfig(Settings):
    """The hyperparameters of on-policy A2S; A2C is the same with one suggestion.

    The defaults are the preset ``modern``.

    Raises:
        ValueError: A value is outside its range; one line that names it.
    """

    # Constants of the networks, which the presets `authors` and `paper` have otherwise.
    init: ClassVar[Init] = "orthogonal"  # Andrychowicz et al. 2021
    learn_std: ClassVar[bool] = True  # PPO paper, table 3

    suggestions: int = setting(
        10, "K, suggestions for every observation; 1 is A2C", "paper, table 3", low=1, high=1024
    )
    act_least_share: float = setting(
        0.97,
        "Actors choose softly: so much of the K counts, at least; 1: any of them",
        "measured: at .9 the mean action is left behind",
        low=1e-6,
        high=1,
    )
    batch_steps: int = setting(2048, "Steps in one batch, at least", "PPO paper, table 3", low=1)
    first_batch_steps: int = setting(
        256, "Steps in the first batch", "measured: InvertedPendulum takes 15 small batches", low=1
    )
    batch_growth: float = setting(
        1.1, "Factor from one batch to the next, up to ``batch_steps``", "measured", low=1, high=1e6
    )
    max_policy_lag: int = setting(
        1,
        "Versions that a segment may be behind",
        "async, and late ones; they are weighed for it",
        low=0,
    )
    act_while_learning: bool = setting(
        False,
        "Lockstep: the next batch is played while this one is learned from, a version behind",
        "measured: Q then pulls where it knows nothing; docs/adr/0024",
    )
    gamma: float = setting(
        0.993,
        "Discount per step",
        "at 0.99 a fall costs too little; docs/adr/0015",
        low=1e-6,
        high=1,
    )
    gae_lambda: float = setting(
        0.95,
        "Of advantages and targets; 1: whole returns",
        "PPO paper, table 3",
        low=0e0,
        high=1,
    )
    norm_obs: bool = setting(
        True, "Observations have running mean 0 and deviation 1", "Andrychowicz et al. 2021"
    )
    norm_return: bool = setting(
        True,
        "Targets of V have running mean 0, deviation 1; Q's are in that unit",
        "Andrychowicz et al. 2021",
    )
    return_window_steps: int = setting(
        20480, "Steps that the statistics of targets remember, about", "ten batches", low=1
    )
    policy_sizes: tuple[int, ...] = setting((64, 64), "Policy: hidden units", "paper, section 5")
    value_sizes: tuple[int, ...] = setting((64, 64), "V: hidden units", "paper, section 5")
    q_sizes: tuple[int, ...] = setting((128, 128), "Q: hidden units, of both critics", "measured")
    layer_norm: bool = setting(
        True, "Hidden layers are normalised before the non-linearity", "authors' code"
    )
    std: float = setting(
        0.5,
        "Policy's deviation at first; 1: half the range",
        "paper, table 3",
        low=1e-6,
        high=1e6,
    )
    std_floor: float = setting(
        0.3,
        "Least standard deviation, at first",
        "measured",
        low=0e0,
        high=1e6,
    )
    last_std_floor: float = setting(
        0.1, "What it falls to over the run, linearly", "measured", low=0e0, high=1e6
    )
    critic_epochs: int = setting(10, "Passes over the batch: V", "PPO paper, table 3", low=1)
    min_minibatches: int = setting(
        8,
        "Least number of minibatches in a pass over a small batch, of V and of the policy",
        "measured: InvertedPendulum solved in 4,400 steps, not 8,500",
        low=1,
    )
    critic_minibatch: int = setting(256, "Steps in a minibatch: V", "as the policy", low=1)
    norm_advantage: bool = setting(
        True, "Advantages of a batch have mean 0 and standard deviation 1", "common practice"
    )
    clip_ratio: float = setting(
        0.2, "Epsilon of PPO's clipped loss", "PPO paper, table 3", low=1e-6, high=1e6
    )
    weight_limit: float = setting(
        5.0,
        "Greatest importance weight of an executed suggestion, for being picked; 0: not weighed",
        "measured: without weights the std shrinks, Hopper stalls",
        low=0e0,
    )
    entropy_weight: float = setting(
        0.0, "Weight of the entropy bonus, nats", "PPO paper, table 3", low=0e0, high=1e6
    )
    policy_epochs: int = setting(
        10,
        "Passes over the batch: policy; 1 with ``policy_minibatch`` 0 is A2C's gradient",
        "PPO paper, table 3",
        low=1,
    )
    policy_minibatch: int = setting(
        256, "Steps in a minibatch: policy; 0: the batch", "64 measured no better, slower", low=0
    )
    kl_stop: float = setting(
        0.05,
        "The pass that finds this joint KL, nats, is the last",
        "bounds the whole update",
        low=0e0,
    )
    pull: float = setting(
        1.0,
        "Equation 6: how much the suggestions pull at most, beside the policy gradient",
        "measured; docs/adr/0021",
        low=0e0,
        high=1e6,
    )
    pull_temperature: float = setting(
        0.1,
        "Of a softmax over the K, in deviations of the advantage: it tells how strong the pull is",
        "measured; docs/adr/0021",
        low=1e-6,
        high=1e6,
    )
    pull_least_share: float = setting(
        0.95,
        "How far the pull goes: to the softmax at which so much of the K counts",
        "measured; docs/adr/0021",
        low=1e-6,
        high=1,
    )
    window_steps: int = setting(
        32768, "Q learns from the latest batches: as few as hold so many steps", "measured", low=1
    )
    q_steps: int = setting(
        200, "Gradient steps of Q in an update of a full batch", "measured", low=1
    )
    q_minibatch: int = setting(
        128, "Steps in a minibatch: Q", "256 measured no better, slower", low=1
    )
    q_lambda: float = setting(0.95, "Of Q's targets, by V-trace", "as gae_lambda", low=0e0, high=1)
    recovery: RecoveryRule = setting(
        "invariant",
        "Equation 5: ``off``, as the ``authors`` have it, or ``invariant`` to scale and sign",
        "equation 5 needs positive returns",
    )
    recovery_bias: float = setting(
        0.5, "Alpha: a larger one means fewer recoveries", "ours, to be tuned", low=0e0, high=1e6
    )
    recovery_statistic: ReturnStatistic = setting(
        "mean", "``mean`` or ``max`` of episode returns", "one lucky episode sets a lasting maximum"
    )
    recovery_episodes: int = setting(
        50, "Latest episodes compared; 0: the batch's", "10 halve by chance, adr/0006", low=0
    )
    recovery_cool_down: int = setting(
        3, "Updates after a recovery in which there is no other", "ours, to be tuned", low=0
    )
    recovery_lr_divisor: float = setting(
        2.0, "A recovery divides the learning rate by this", "ours, to be tuned", low=1, high=1e6
    )
    learning_rate: float = setting(
        0.0003, "Of the policy, at first", "5e-4 measured worse on Hopper", low=1e-12, high=1000
    )
    critic_learning_rate: float = setting(
        0.001, "Of V, at first", "5e-4 measured worse on Hopper", low=1e-12, high=1000
    )
    q_learning_rate: float = setting(0.0006, "Of Q, at first", "measured", low=1e-12, high=1000)
    lr_rule: LearningRateRule = setting(
        "anneal",
        "``constant``, ``anneal`` to 0 over the run, or ``kl``: by the last KL, 1/50 to 6 times",
        "common practice",
    )
    kl_target: float = setting(
        0.01, "Wanted KL divergence per update, nats", "ours, to be tuned", low=1e-12, high=1e6
    )
    max_grad_norm: float = setting(
        0.5, "Greatest norm of a gradient; 0: not limited", "common practice", low=0e0
    )

    def __post_init__(self) -> None:
        """Check every value, then those that depend on each other."""
        Settings.__post_init__(self)
        check_most("first_batch_steps", self.first_batch_steps, "batch_steps", self.batch_steps)
        check_most("std_floor", self.std_floor, "std", self.std)
        if self.act_while_learning and self.max_policy_lag == 0:
            refuse("act_while_learning", True, "false where max_policy_lag is 0")
        check_most("last_std_floor", self.last_std_floor, "std_floor", self.std_floor)

    @property
    def uses_q(self) -> bool:
        """Whether anything reads Q; otherwise it is not fitted."""
        return self.suggestions > 1

    def as_a2c(self) -> "OnPolicyConfig":
        """The A2C of this: one suggestion, hence no Q and no equation 6, and no equation 5."""
        return replace(self, suggestions=1, recovery="off")

    def std_floor_at(self, progress: float) -> float:
        """Least standard deviation when a fraction of the run, 0..1, is done."""
        return self.std_floor + (self.last_std_floor - self.std_floor) * progress

    def batch_steps_at(self, update: int) -> int:
        """Steps wanted in the batch of update 0, 1, 2...: growing, then ``batch_steps``."""
        growth = math.exp(min(update * math.log(self.batch_growth), 700.0))
        return round(min(self.batch_steps, self.first_batch_steps * growth))
