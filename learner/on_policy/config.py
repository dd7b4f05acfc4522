"""The configuration of on-policy A2S, and its presets.

``modern`` is meant for use, ``authors`` repeats the paper's published code, ``paper`` its text.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

from a2s.learner.settings import Settings, check_most, refuse, setting

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


@dataclass(frozen=True, slots=True, kw_only=True)
class OnPolicyConfig(Settings):
    """The hyperparameters of on-policy A2S; A2C is the same with one suggestion.

    The defaults are the preset ``modern``.

    Raises:
        ValueError: A value is outside its range; one line that names it.
    """

    suggestions: int = setting(
        10,
        "K, actions that the policy suggests for every observation, at least 1; 1 is A2C",
        "paper, table 3",
        low=1,
        high=1024,
    )
    selection: Selection = setting(
        "soft",
        "``hard``: the suggestion of largest Q; ``soft``: drawn by softmax of Q over its spread",
        "probe on Hopper: a hard argmax leaves the mean behind",
    )
    selection_temperature: float = setting(
        3.0,
        "Of soft selection, in units of Q's standard deviation over the K suggestions",
        "measured: at 1 the weights leave a third of the batch, adr/0006",
        low=1e-6,
        high=1e6,
    )
    anneal_selection: bool = setting(
        True,
        "Soft selection becomes indifferent towards the end: temperature / (1 - progress)",
        "measured on HalfCheetah: else the mean action is left behind",
    )
    action_mode: ActionMode = setting(
        "clip",
        "What Q sees: ``clip``: suggestions clipped to the bounds; ``raw``: as they were drawn",
        "environments charge for what they are given",
    )
    warm_up: WarmUp = setting(
        "first-fit",
        "When Q may choose: at once, or after its first fit",
        "the argmax of an untrained Q is an arbitrary direction",
    )
    batch_steps: int = setting(2048, "Steps in one batch, at least", "PPO paper, table 3", low=1)
    first_batch_steps: int = setting(
        256,
        "Steps in the first batch; batches grow from here to ``batch_steps``",
        "measured: InvertedPendulum is solved in 15 small batches",
        low=1,
    )
    batch_growth: float = setting(
        1.1,
        "Factor by which the batches grow from one update to the next, at least 1",
        "measured, with the size of the first batch",
        low=1,
        high=1e6,
    )
    min_episodes: int = setting(
        0, "Finished episodes in one batch, at least", "batches are counted in steps", low=0
    )
    whole_episodes: bool = setting(
        False,
        "Segments are whole episodes; otherwise episodes are cut where the batch is full",
        "cut episodes are bootstrapped",
    )
    max_policy_lag: int = setting(
        1,
        "Versions that a segment may be behind; in lockstep, above 0: acting overlaps learning",
        "acting and learning at the same time",
        low=0,
    )
    gamma: float = setting(
        0.99, "Discount per step, above 0 and at most 1", "PPO paper, table 3", low=1e-6, high=1
    )
    gae_lambda: float = setting(
        0.95,
        "Lambda of the advantages, and of the targets of Q and V, 0..1; 1: discounted returns",
        "PPO paper, table 3",
        low=0e0,
        high=1,
    )
    time_limit_is_terminal: bool = setting(
        False,
        "A truncated episode counts as terminated: nothing is expected after it",
        "Pardo et al. 2018",
    )
    norm_obs: bool = setting(
        True,
        "Observations are shifted and scaled by their running mean and standard deviation",
        "Andrychowicz et al. 2021",
    )
    norm_return: bool = setting(
        True,
        "Targets of Q and V are shifted and scaled by running statistics of the targets",
        "Andrychowicz et al. 2021",
    )
    return_window_steps: int = setting(
        20480,
        "Steps over which the statistics of the targets are remembered, about",
        "ten batches",
        low=1,
    )
    policy_sizes: tuple[int, ...] = setting(
        (64, 64), "Units of the policy's hidden layers", "paper, section 5"
    )
    value_sizes: tuple[int, ...] = setting(
        (64, 64), "Units of the value network's hidden layers", "paper, section 5"
    )
    q_sizes: tuple[int, ...] = setting(
        (128, 64), "Units of the hidden layers of Q", "paper, section 5"
    )
    layer_norm: bool = setting(
        True,
        "Hidden layers are normalised, with gain and offset, before the non-linearity",
        "authors' code",
    )
    init: Init = setting(
        "orthogonal",
        "First weights: ``uniform`` (the authors') or ``orthogonal``",
        "Andrychowicz et al. 2021",
    )
    std: float = setting(
        0.5,
        "Standard deviation of the policy, at first or for ever; 1 is half the action range",
        "paper, table 3",
        low=1e-6,
        high=1e6,
    )
    learn_std: bool = setting(
        True,
        "The standard deviation is learned, one number per action dimension",
        "PPO paper, table 3",
    )
    std_floor: float = setting(
        0.15, "Least standard deviation", "selection shrinks a learned std", low=0e0, high=1e6
    )
    fit_rule: FitRule = setting(
        "epochs",
        "Q and V: ``epochs``: passes over the batch; ``threshold``: steps until the loss is low",
        "a threshold on raw losses fails at other scales of reward",
    )
    critic_epochs: int = setting(
        10, "Passes over the batch in the rule ``epochs``", "PPO paper, table 3", low=1
    )
    min_minibatches: int = setting(
        8,
        "Least number of minibatches in a pass over a small batch, of Q and V and of the policy",
        "measured: InvertedPendulum solved in 4,400 steps, not 8,500",
        low=1,
    )
    critic_minibatch: int = setting(
        256, "Steps in one minibatch of Q and V", "as the policy", low=1
    )
    fit_steps: int = setting(100, "Gradient steps that the rule ``threshold`` always makes", low=1)
    q_fit_extra_steps: int = setting(0, "Steps that Q may make after those", low=0)
    value_fit_extra_steps: int = setting(0, "Steps that V may make after those", low=0)
    fit_threshold: float = setting(
        0.0,
        "Running mean of the minibatch losses at which the rule stops, in squared returns",
        low=0e0,
    )
    advantage: Advantage = setting("gae", "What weighs the policy gradient", "Schulman et al. 2016")
    norm_advantage: bool = setting(
        True,
        "Advantages of a batch are brought to mean 0 and standard deviation 1",
        "common practice",
    )
    policy_loss: PolicyLoss = setting(
        "clip",
        "``score``: log-density times advantage; ``clip``: the clipped ratio of PPO",
        "PPO paper, equation 7",
    )
    clip_ratio: float = setting(
        0.2,
        "How far the ratio of densities may go from 1 in the loss ``clip``",
        "PPO paper, table 3",
        low=1e-6,
        high=1e6,
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
        10, "Passes over the batch of the policy gradient", "PPO paper, table 3", low=1
    )
    policy_minibatch: int = setting(
        256,
        "Steps in one minibatch of the policy gradient; 0: the whole batch",
        "measured: 64 and 128 no better on HalfCheetah, and slower",
        low=0,
    )
    kl_stop: float = setting(
        0.05,
        "The policy gradient ends after a pass that finds this KL divergence, joint, nats",
        "bounds the whole update, equation 6 included",
        low=0e0,
    )
    distil: Distil = setting(
        "off",
        "Equation 6: ``off``, or ``separate`` steps before the policy gradient",
        "measured: it follows the noise of Q, adr/0006",
    )
    distil_suggestions: int = setting(
        10, "Fresh suggestions per observation for equation 6", low=1, high=1024
    )
    distil_top: int = setting(
        1, "The mean moves to the average of this many best suggestions", low=1, high=1024
    )
    distil_steps: int = setting(50, "Gradient steps of ``separate``", low=1)
    distil_minibatch: int = setting(128, "Steps in one minibatch of ``separate``", low=1)
    distil_kl: float = setting(
        0.02,
        "``separate`` ends when a minibatch has moved by this KL divergence, joint, nats",
        low=0e0,
    )
    recovery: RecoveryRule = setting(
        "invariant",
        "Equation 5: ``off``, as the ``authors`` have it, or ``invariant`` to scale and sign",
        "equation 5 needs positive returns",
    )
    recovery_bias: float = setting(
        0.5,
        "Alpha: P(recover) = clip(gap - alpha, 0, 1), so a larger one means fewer recoveries",
        "ours, to be tuned",
        low=0e0,
        high=1e6,
    )
    recovery_statistic: ReturnStatistic = setting(
        "mean",
        "What is compared: mean or maximum of undiscounted episode returns",
        "a single lucky episode sets a maximum for ever",
    )
    recovery_episodes: int = setting(
        50,
        "Of the last so many episodes; 0: of those that ended in the batch",
        "measured: the mean of 10 falls to half by chance, adr/0006",
        low=0,
    )
    recovery_offset: float = setting(
        0.0,
        "Added to the returns in the test alone, never to rewards",
        "not needed by the invariant rule",
        low=-1e12,
        high=1e12,
    )
    recovery_cool_down: int = setting(
        3, "Updates after a recovery in which there is no other", "ours, to be tuned", low=0
    )
    recovery_restores: RecoveryRestores = setting(
        "everything",
        "The networks, or also optimisers and normalisers",
        "the momentum led to the crash",
    )
    recovery_learns: bool = setting(
        False,
        "Equation 6 and the policy gradient still learn from the batch that led to recovery",
        "the batch is of other networks",
    )
    recovery_lr_divisor: float = setting(
        2.0, "A recovery divides the learning rate by this", "ours, to be tuned", low=1, high=1e6
    )
    recovery_kl_divisor: float = setting(
        1.0,
        "A recovery divides the wanted KL divergence by this, for good",
        "nothing undoes it",
        low=1,
        high=1e6,
    )
    learning_rate: float = setting(
        0.0005,
        "Of Adam on the policy, at first",
        "measured: 1e-3 no better on InvertedPendulum",
        low=1e-12,
        high=1000,
    )
    critic_learning_rate: float = setting(
        0.0005, "Of Adam on Q and V, at first", "as the policy", low=1e-12, high=1000
    )
    critic_follows_rule: bool = setting(
        False, "The rule scales the learning rate of Q and V too", "ours, to be tuned"
    )
    lr_rule: LearningRateRule = setting(
        "anneal",
        "``constant``, ``anneal`` to 0 over the run, or ``kl``: adapted to the KL divergence",
        "common practice",
    )
    lr_min: float = setting(
        1e-05, "Least learning rate of the rules", "ours, to be tuned", low=0e0, high=1000
    )
    lr_max: float = setting(
        0.003, "Greatest learning rate of the rules", "ours, to be tuned", low=1e-12
    )
    kl_target: float = setting(
        0.01, "Wanted KL divergence per update, nats", "ours, to be tuned", low=1e-12, high=1e6
    )
    kl_scope: KlScope = setting(
        "update",
        "Measured over the whole ``update`` or over the ``policy-gradient`` alone",
        "equation 6 moves the policy too",
    )
    kl_dims: KlDims = setting(
        "joint",
        "``joint``: summed over the action dimensions; ``mean``: their mean",
        "the divergence of the densities",
    )
    max_grad_norm: float = setting(
        0.5, "Greatest norm of a gradient; 0: not limited", "common practice", low=0e0
    )

    def __post_init__(self) -> None:
        """Check every value, then those that depend on each other."""
        Settings.__post_init__(self)
        check_most("distil_top", self.distil_top, "distil_suggestions", self.distil_suggestions)
        check_most("first_batch_steps", self.first_batch_steps, "batch_steps", self.batch_steps)
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
        return round(min(self.batch_steps, self.first_batch_steps * growth))


class Preset(NamedTuple):
    """A named configuration, and where its values come from that are no defaults."""

    config: OnPolicyConfig
    source: str


_AUTHORS = replace(
    OnPolicyConfig(),
    selection="hard",  # paper, algorithm 1
    selection_temperature=1.0,  # not used here
    anneal_selection=False,  # not used here
    action_mode="raw",  # authors' code
    warm_up="none",  # authors' code
    batch_steps=500,  # authors' code
    first_batch_steps=500,  # authors' code
    batch_growth=1.0,  # authors' code
    min_episodes=3,  # authors' code
    whole_episodes=True,  # paper, algorithm 1
    max_policy_lag=0,  # authors' code
    gamma=0.97,  # paper, table 3
    gae_lambda=1.0,  # paper, section 4.1
    time_limit_is_terminal=True,  # authors' code
    norm_obs=False,  # authors' code
    norm_return=False,  # authors' code
    init="uniform",  # authors' code
    learn_std=False,  # paper, table 3
    std_floor=0.3,  # authors' code
    fit_rule="threshold",  # authors' code
    min_minibatches=1,  # not used here
    critic_minibatch=128,  # authors' code
    q_fit_extra_steps=5000,  # authors' code
    value_fit_extra_steps=100,  # authors' code
    fit_threshold=100.0,  # authors' code
    advantage="return-v",  # paper, section 4
    norm_advantage=False,  # authors' code
    policy_loss="score",  # paper, equation 4
    weight_limit=0.0,  # the selection is ignored, paper, section 4
    policy_epochs=1,  # authors' code
    policy_minibatch=0,  # authors' code
    kl_stop=math.inf,  # authors' code
    distil="separate",  # authors' code
    distil_kl=math.inf,  # authors' code
    recovery="authors",  # paper, equation 5
    recovery_bias=0.65,  # paper, table 3
    recovery_statistic="max",  # authors' code
    recovery_episodes=0,  # authors' code
    recovery_offset=100.0,  # authors' code
    recovery_cool_down=0,  # authors' code
    recovery_restores="networks",  # authors' code
    recovery_learns=True,  # authors' code
    recovery_lr_divisor=5.0,  # authors' code
    recovery_kl_divisor=1.1,  # authors' code
    learning_rate=0.001,  # authors' code
    critic_learning_rate=0.001,  # authors' code
    critic_follows_rule=True,  # authors' code
    lr_rule="kl",  # paper, section 4.1.1
    lr_min=0.0,  # authors' code
    lr_max=math.inf,  # authors' code
    kl_target=0.001,  # paper, table 3
    kl_scope="policy-gradient",  # authors' code
    kl_dims="mean",  # authors' code
    max_grad_norm=0.0,  # authors' code
)
_PAPER = replace(
    _AUTHORS,
    batch_steps=1,  # paper, algorithm 1: one episode
    first_batch_steps=1,  # paper, algorithm 1: one episode
    min_episodes=1,  # paper, algorithm 1
    advantage="q-v",  # paper, algorithm 1
    recovery_statistic="mean",  # paper, section 4.1.1
    recovery_offset=0.0,  # paper, equation 5
    recovery_learns=False,  # paper, section 4.1.1
)
PRESETS = {
    "modern": Preset(OnPolicyConfig(), ""),
    "authors": Preset(_AUTHORS, "authors' code"),
    "paper": Preset(_PAPER, "paper, or else authors' code"),
}


def as_a2c(config: OnPolicyConfig) -> OnPolicyConfig:
    """Give the A2C of a configuration: one suggestion, no Q, neither equation 5 nor 6."""
    advantage: Advantage = "return-v" if config.advantage == "q-v" else config.advantage
    return replace(config, suggestions=1, distil="off", recovery="off", advantage=advantage)
