"""Every number and choice of the off-policy algorithm, checked.

There are no defaults here: the values and where they come from are in
``a2s.learner.off_policy.presets``.
"""

import math
from dataclasses import dataclass
from typing import Literal

from a2s.learner.networks.options import Network, Precision
from a2s.learner.on_policy.hyperparameters import Selection
from a2s.learner.ranges import check, check_most, refuse

OffPolicyLoss = Literal["pathwise", "score"]
Selector = Literal["one", "mean"]

_INTEGERS: dict[str, tuple[int, float]] = {
    "act_suggestions": (1, 1024),
    "target_suggestions": (1, 1024),
    "target_groups": (1, 1024),
    "distil_suggestions": (1, 1024),
    "critics": (1, 64),
    "quantiles": (1, 1024),
    "dropped_quantiles": (0, 1023),
    "average_updates": (0, math.inf),
    "n_step": (1, 1024),
    "batch_rows": (1, 2**20),
    "warm_up_steps": (1, math.inf),
    "replay_rows": (1, 10**9),
    "send_every_steps": (1, math.inf),
    "lead_steps": (1, math.inf),
}
_NUMBERS: dict[str, tuple[float, float]] = {
    "gamma": (1e-6, 1.0),
    "tau": (1e-6, 1.0),
    "updates_per_step": (1e-6, 1e3),
    "learning_rate": (1e-12, 1e3),
    "critic_learning_rate": (1e-12, 1e3),
    "temperature_learning_rate": (0.0, 1e3),
    "huber_width": (1e-9, 1e9),
    "initial_temperature": (0.0, 1e6),
    "entropy_per_action": (-1e3, 1e3),
    "priority_exponent": (0.0, 1.0),
    "importance_exponent": (0.0, 1.0),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class OffPolicyHyper:
    """The hyperparameters of off-policy A2S; SAC is the same with one suggestion everywhere.

    Raises:
        UsageError: A value is outside its range; one line that names it.
    """

    act_suggestions: int
    """K_act, actions among which Q picks what is executed, at least 1."""
    selection: Selection
    """``hard``: the largest score; ``soft``: drawn, as if from the Boltzmann distribution of Q."""
    target_suggestions: int
    """K_target, suggestions of each group in the next state, equation 7."""
    target_groups: int
    """N, groups over which equation 8 takes its mean."""
    selector: Selector
    """Who picks in the update: ``one`` online critic, drawn anew, or the ``mean`` of all."""

    critics: int
    """Q networks; the minimum of their targets evaluates."""
    quantiles: int
    """Atoms of each critic; 1: its output is the value itself."""
    dropped_quantiles: int
    """Atoms per critic that a target leaves out, the largest of all; fewer than ``quantiles``."""
    huber_width: float
    """Errors of atoms beyond it count by their size, within it by their square."""
    network: Network
    """``mlp``; ``residual``: a block that adds to its input for each size after the first;
    ``trunk``: critics whose first layer sees no action, so that several of one observation cost
    less."""
    critic_sizes: tuple[int, ...]
    """Units of the hidden layers of each critic."""
    policy_sizes: tuple[int, ...]
    """Units of the policy's hidden layers."""
    layer_norm: bool
    """Hidden layers are normalised, with gain and offset."""
    normalise_obs: bool
    """Observations are shifted and scaled by their running mean and standard deviation."""
    quiet_rare_obs: bool
    """Normalised ones are scaled further, by the share of steps in which they are not 0."""
    normalise_return: bool
    """Rewards are divided by the root mean square of returns over 64 steps of the replay; the
    temperature and ``huber_width`` are in units of that."""
    precision: Precision
    """Of matrix products: ``f32``, or ``bf16``, faster where the processor has it."""

    policy_loss: OffPolicyLoss
    """``pathwise``: along the gradient of Q; ``score``: log-density times advantage."""
    distil_suggestions: int
    """K_distil, fresh suggestions per observation for the loss ``score``."""
    entropy_per_action: float
    """Wanted entropy of the policy per action dimension, nats."""
    initial_temperature: float
    """Weight of the entropy at first."""
    temperature_learning_rate: float
    """Of Adam on the logarithm of the temperature; 0: it stays as it is."""
    average_updates: int
    """Updates over which the policy that is kept is averaged, at most a tenth of all; 0: not."""

    gamma: float
    """Discount per step, above 0 and at most 1."""
    tau: float
    """Fraction of their distance to the critics that the target critics move per update."""
    n_step: int
    """Rewards of so many steps are summed before the critics take over."""
    batch_rows: int
    """Rows of the replay in one update."""
    updates_per_step: float
    """Updates for each environment step."""
    learning_rate: float
    """Of Adam on the policy."""
    critic_learning_rate: float
    """Of Adam on the critics."""

    warm_up_steps: int
    """Environment steps with uniform random actions, before the first update."""
    replay_rows: int
    """Steps that the replay keeps; the oldest go first."""
    prioritised: bool
    """Rows with a large error are sampled more often."""
    priority_exponent: float
    """Alpha: priorities are the errors to this power, 0..1."""
    importance_exponent: float
    """Beta: weights undo the priorities to this power, 0..1."""
    send_every_steps: int
    """Steps after which an actor sends what it has."""
    lead_steps: int
    """Environment steps that either side may be ahead of ``updates_per_step``; it then waits."""

    def __post_init__(self) -> None:
        """Check every value, then those that depend on each other."""
        check(self, _INTEGERS, _NUMBERS)
        check_most("batch_rows", self.batch_rows, "replay_rows", self.replay_rows)
        for other in ("lead_steps", "replay_rows"):
            check_most("send_every_steps", self.send_every_steps, other, getattr(self, other))
        if self.dropped_quantiles >= self.quantiles:
            expected = f"fewer than quantiles ({self.quantiles})"
            refuse("dropped_quantiles", self.dropped_quantiles, expected)
        if self.initial_temperature == 0.0:
            if self.temperature_learning_rate > 0.0:
                refuse("initial_temperature", 0.0, "above 0 where temperature_learning_rate is")
            if self.selection == "soft" and self.act_suggestions > 1:
                refuse("initial_temperature", 0.0, "above 0 with selection soft")
        if self.network == "trunk" and len(self.critic_sizes) < 2:
            refuse("critic_sizes", self.critic_sizes, "at least two with network trunk")
        if self.policy_loss == "score" and self.distil_suggestions == 1:
            refuse("distil_suggestions", 1, "at least 2 with policy_loss score")
