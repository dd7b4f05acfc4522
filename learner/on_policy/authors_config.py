"""The configuration of the presets ``authors`` and ``paper``; `authors.py` has the constants."""

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

from a2s.learner.on_policy.config import Init, ReturnStatistic
from a2s.learner.settings import Settings, setting

Advantage = Literal["return-v", "q-v"]


Distil = Literal["off", "separate"]


@dataclass(frozen=True, slots=True, kw_only=True)
class AuthorsConfig(Settings):
    """Table 3 of the paper, sizes, and where the published code differs from the text.

    The defaults are the preset ``authors``.

    Raises:
        ValueError: A value is outside its range; one line that names it.
    """

    # Constants that the shared parts read.
    max_policy_lag: ClassVar[int] = 0  # paper, algorithm 1: one policy made the batch
    act_while_learning: ClassVar[bool] = False  # the same
    norm_obs: ClassVar[bool] = False  # authors' code
    norm_return: ClassVar[bool] = False  # authors' code
    return_window_steps: ClassVar[int] = 1  # not used
    layer_norm: ClassVar[bool] = True  # paper, section 5
    init: ClassVar[Init] = "uniform"  # authors' code
    learn_std: ClassVar[bool] = False  # paper, table 3
    std_floor: ClassVar[float] = 0.0  # not used

    suggestions: int = setting(
        10, "K, suggestions for every observation; 1 is A2C", "paper, table 3", low=1, high=1024
    )
    batch_steps: int = setting(500, "Steps in one batch, at least", "authors' code", low=1)
    min_episodes: int = setting(3, "Episodes in one batch, all whole", "authors' code", low=1)
    gamma: float = setting(0.97, "Discount per step", "paper, table 3", low=1e-6, high=1)
    policy_sizes: tuple[int, ...] = setting((64, 64), "Policy: hidden units", "paper, section 5")
    value_sizes: tuple[int, ...] = setting((64, 64), "V: hidden units", "paper, section 5")
    q_sizes: tuple[int, ...] = setting((128, 64), "Q: hidden units", "paper, section 5")
    std: float = setting(
        0.5, "Standard deviation of the policy, fixed", "paper, table 3", low=1e-6, high=1e6
    )
    advantage: Advantage = setting(
        "return-v",
        "``return-v``: discounted return less V before its fit; ``q-v``: Q less V after theirs",
        "paper, section 4",
    )
    distil: Distil = setting(
        "separate", "Equation 6: ``off``, or ``separate`` steps of its own", "paper, equation 6"
    )
    recovery: Literal["off", "authors"] = setting(
        "authors", "Equation 5: ``off``, or as printed", "paper, equation 5"
    )
    recovery_bias: float = setting(
        0.65, "Alpha: a larger one means fewer recoveries", "paper, table 3", low=0e0, high=1e6
    )
    recovery_statistic: ReturnStatistic = setting(
        "max", "``mean`` or ``max`` of the batch's episode returns", "authors' code"
    )
    recovery_offset: float = setting(
        100.0, "Added to the returns in the test alone", "authors' code", low=-1e12, high=1e12
    )
    recovery_learns: bool = setting(
        True,
        "Equation 6 and the policy gradient still learn from the batch that led to recovery",
        "authors' code",
    )
    learning_rate: float = setting(0.001, "At first", "authors' code", low=1e-12, high=1000)
    kl_target: float = setting(
        0.001, "Wanted KL, nats, mean over dimensions", "paper, table 3", low=1e-12, high=1e6
    )

    @property
    def uses_q(self) -> bool:
        """Whether anything reads Q; otherwise it is not fitted."""
        return self.suggestions > 1 or self.distil != "off" or self.advantage == "q-v"

    def as_a2c(self) -> "AuthorsConfig":
        """The A2C of this: one suggestion, no Q, neither equation 5 nor 6."""
        return replace(self, suggestions=1, distil="off", recovery="off", advantage="return-v")
