"""Every number and choice of the on-policy algorithm, checked.

There are no defaults here: the values and where they come from are in
``a2s.learner.on_policy.presets``.
"""

import math
from dataclasses import dataclass
from typing import Literal

from a2s.learner.ranges import check, check_most, refuse

ActionMode = Literal["clip", "raw"]
Advantage = Literal["return-v", "q-v", "gae"]
Distil = Literal["off", "separate"]
FitRule = Literal["epochs", "threshold"]
Init = Literal["uniform", "orthogonal"]
KlDims = Literal["joint", "mean"]
KlScope = Literal["update", "policy-gradient"]
LearningRateRule = Literal["constant", "anneal", "kl"]
PolicyLoss = Literal["score", "clip"]
RecoveryRule = Literal["off", "authors", "invariant"]
RecoveryRestores = Literal["networks", "everything"]
ReturnStatistic = Literal["mean", "max"]
Selection = Literal["hard", "soft"]
WarmUp = Literal["none", "first-fit"]

# Closed ranges of integers.
_INTEGERS: dict[str, tuple[int, float]] = {
    "suggestions": (1, 1024),
    "batch_steps": (1, math.inf),
    "batch_steps_first": (1, math.inf),
    "min_episodes": (0, math.inf),
    "max_policy_lag": (0, math.inf),
    "return_window_steps": (1, math.inf),
    "critic_epochs": (1, math.inf),
    "critic_minibatch": (1, math.inf),
    "least_minibatches": (1, math.inf),
    "fit_steps": (1, math.inf),
    "q_fit_extra_steps": (0, math.inf),
    "value_fit_extra_steps": (0, math.inf),
    "policy_epochs": (1, math.inf),
    "policy_minibatch": (0, math.inf),
    "distil_suggestions": (1, 1024),
    "distil_top": (1, 1024),
    "distil_steps": (1, math.inf),
    "distil_minibatch": (1, math.inf),
    "recovery_episodes": (0, math.inf),
    "recovery_cool_down": (0, math.inf),
}
# Closed ranges of numbers; infinity is a value only where it is the upper end.
_NUMBERS: dict[str, tuple[float, float]] = {
    "temperature": (1e-6, 1e6),
    "batch_growth": (1.0, 1e6),
    "gamma": (1e-6, 1.0),
    "gae_lambda": (0.0, 1.0),
    "std": (1e-6, 1e6),
    "std_floor": (0.0, 1e6),
    "fit_threshold": (0.0, math.inf),
    "clip_ratio": (1e-6, 1e6),
    "weight_limit": (0.0, math.inf),
    "entropy_weight": (0.0, 1e6),
    "kl_stop": (0.0, math.inf),
    "distil_kl": (0.0, math.inf),
    "recovery_bias": (0.0, 1e6),
    "recovery_offset": (-1e12, 1e12),
    "recovery_lr_divisor": (1.0, 1e6),
    "recovery_kl_divisor": (1.0, 1e6),
    "learning_rate": (1e-12, 1e3),
    "critic_learning_rate": (1e-12, 1e3),
    "lr_min": (0.0, 1e3),
    "lr_max": (1e-12, math.inf),
    "kl_target": (1e-12, 1e6),
    "max_grad_norm": (0.0, math.inf),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class OnPolicyHyper:
    """The hyperparameters of on-policy A2S; A2C is the same with one suggestion.

    Raises:
        UsageError: A value is outside its range; one line that names it.
    """

    suggestions: int
    """K, actions that the policy suggests for every observation, at least 1; 1 is A2C."""
    selection: Selection
    """``hard``: the suggestion of largest Q; ``soft``: drawn by softmax of Q over its spread."""
    temperature: float
    """Of soft selection, in units of Q's standard deviation over the K suggestions."""
    selection_fades: bool
    """Soft selection becomes indifferent towards the end: temperature / (1 - progress)."""
    action_mode: ActionMode
    """What Q sees: ``clip``: suggestions clipped to the bounds; ``raw``: as they were drawn."""
    warm_up: WarmUp
    """When Q may choose: at once, or after its first fit."""

    batch_steps: int
    """Steps in one batch, at least."""
    batch_steps_first: int
    """Steps in the first batch; batches grow from here to ``batch_steps``."""
    batch_growth: float
    """Factor by which the batches grow from one update to the next, at least 1."""
    min_episodes: int
    """Finished episodes in one batch, at least."""
    whole_episodes: bool
    """Segments are whole episodes; otherwise episodes are cut where the batch is full."""
    max_policy_lag: int
    """Versions that a segment may be older than the newest weights.

    In lockstep, above 0: actors play on while the learner learns, one version behind.
    """

    gamma: float
    """Discount per step, above 0 and at most 1."""
    gae_lambda: float
    """Lambda of the advantages, and of the targets of Q and V, 0..1; 1: discounted returns."""
    time_limit_is_terminal: bool
    """A truncated episode counts as terminated: nothing is expected after it."""
    normalise_obs: bool
    """Observations are shifted and scaled by their running mean and standard deviation."""
    normalise_return: bool
    """Targets of Q and V are shifted and scaled by running statistics of the targets."""
    return_window_steps: int
    """Steps over which the statistics of the targets are remembered, about."""

    policy_sizes: tuple[int, ...]
    """Units of the policy's hidden layers."""
    value_sizes: tuple[int, ...]
    """Units of the value network's hidden layers."""
    q_sizes: tuple[int, ...]
    """Units of the hidden layers of Q."""
    layer_norm: bool
    """Hidden layers are normalised, with gain and offset, before the non-linearity."""
    init: Init
    """First weights: ``uniform`` (the authors') or ``orthogonal``."""
    std: float
    """Standard deviation of the policy, at first or for ever; 1 is half the action range."""
    learn_std: bool
    """The standard deviation is learned, one number per action dimension."""
    std_floor: float
    """Least standard deviation."""

    fit_rule: FitRule
    """Q and V: ``epochs``: passes over the batch; ``threshold``: steps until the loss is low."""
    critic_epochs: int
    """Passes over the batch in the rule ``epochs``."""
    least_minibatches: int
    """Least number of minibatches in a pass over a small batch, of Q and V and of the policy."""
    critic_minibatch: int
    """Steps in one minibatch of Q and V."""
    fit_steps: int
    """Gradient steps that the rule ``threshold`` always makes."""
    q_fit_extra_steps: int
    """Steps that Q may make after those."""
    value_fit_extra_steps: int
    """Steps that V may make after those."""
    fit_threshold: float
    """Running mean of the minibatch losses at which the rule stops, in squared returns."""

    advantage: Advantage
    """What weighs the policy gradient."""
    normalise_advantage: bool
    """Advantages of a batch are brought to mean 0 and standard deviation 1."""
    policy_loss: PolicyLoss
    """``score``: log-density times advantage; ``clip``: the clipped ratio of PPO."""
    clip_ratio: float
    """How far the ratio of densities may go from 1 in the loss ``clip``."""
    weight_limit: float
    """Greatest importance weight of an executed suggestion, for being picked; 0: not weighed."""
    entropy_weight: float
    """Weight of the entropy bonus, nats."""
    policy_epochs: int
    """Passes over the batch of the policy gradient."""
    policy_minibatch: int
    """Steps in one minibatch of the policy gradient; 0: the whole batch."""
    kl_stop: float
    """The policy gradient ends after a pass that finds this KL divergence, joint, nats."""

    distil: Distil
    """Equation 6: ``off``, or ``separate`` steps before the policy gradient."""
    distil_suggestions: int
    """Fresh suggestions per observation for equation 6."""
    distil_top: int
    """The mean moves to the average of this many best suggestions."""
    distil_steps: int
    """Gradient steps of ``separate``."""
    distil_minibatch: int
    """Steps in one minibatch of ``separate``."""
    distil_kl: float
    """``separate`` ends when a minibatch has moved by this KL divergence, joint, nats."""

    recovery: RecoveryRule
    """Equation 5: ``off``, as the ``authors`` have it, or ``invariant`` to scale and sign."""
    recovery_bias: float
    """Alpha: P(recover) = clip(gap - alpha, 0, 1), so a larger one means fewer recoveries."""
    recovery_statistic: ReturnStatistic
    """What is compared: mean or maximum of undiscounted episode returns."""
    recovery_episodes: int
    """Of the last so many episodes; 0: of those that ended in the batch."""
    recovery_offset: float
    """Added to the returns in the test alone, never to rewards."""
    recovery_cool_down: int
    """Updates after a recovery in which there is no other."""
    recovery_restores: RecoveryRestores
    """The networks, or also optimisers and normalisers."""
    recovery_learns: bool
    """Equation 6 and the policy gradient still learn from the batch that led to recovery."""
    recovery_lr_divisor: float
    """A recovery divides the learning rate by this."""
    recovery_kl_divisor: float
    """A recovery divides the wanted KL divergence by this, for good."""

    learning_rate: float
    """Of Adam on the policy, at first."""
    critic_learning_rate: float
    """Of Adam on Q and V, at first."""
    critic_follows_rule: bool
    """The rule scales the learning rate of Q and V too."""
    lr_rule: LearningRateRule
    """``constant``, ``anneal`` to 0 over the run, or ``kl``: adapted to the KL divergence."""
    lr_min: float
    """Least learning rate of the rules."""
    lr_max: float
    """Greatest learning rate of the rules."""
    kl_target: float
    """Wanted KL divergence per update, nats."""
    kl_scope: KlScope
    """Measured over the whole ``update`` or over the ``policy-gradient`` alone."""
    kl_dims: KlDims
    """``joint``: summed over the action dimensions; ``mean``: their mean."""
    max_grad_norm: float
    """Greatest norm of a gradient; 0: not limited."""

    def __post_init__(self) -> None:
        """Check every value, then those that depend on each other."""
        check(self, _INTEGERS, _NUMBERS)
        check_most("distil_top", self.distil_top, "distil_suggestions", self.distil_suggestions)
        check_most("batch_steps_first", self.batch_steps_first, "batch_steps", self.batch_steps)
        check_most("std_floor", self.std_floor, "std", self.std)
        check_most("lr_min", self.lr_min, "lr_max", self.lr_max)
        if self.whole_episodes != (self.min_episodes > 0):
            expected = "at least 1" if self.whole_episodes else "0"
            found = str(self.whole_episodes).lower()
            expected += f" while whole_episodes is {found}"
            refuse("min_episodes", self.min_episodes, expected)

    @property
    def uses_q(self) -> bool:
        """Whether anything reads Q; where nothing does it is not fitted."""
        return self.suggestions > 1 or self.distil != "off" or self.advantage == "q-v"

    def batch_steps_at(self, update: int) -> int:
        """Steps wanted in the batch of update 0, 1, 2...: growing, then ``batch_steps``."""
        growth = math.exp(min(update * math.log(self.batch_growth), 700.0))
        return round(min(self.batch_steps, self.batch_steps_first * growth))
