"""The configuration of off-policy A2S, and its presets.

``modern`` is meant for use: ten suggestions to act by, critics of quantiles, residual networks.
``sac`` is SAC with normalised observations: one suggestion, two values, plain networks.
``paper`` is algorithm 2 of the paper as printed.
"""

from dataclasses import dataclass, replace
from typing import Literal

from a2s.learner.settings import Preset, Settings, check_most, refuse, setting

Selection = Literal["hard", "soft"]
Network = Literal["mlp", "residual", "trunk"]
Precision = Literal["fastest", "f32", "bf16"]
OffPolicyLoss = Literal["pathwise", "score"]

_SAC_PAPER = "SAC (Haarnoja et al. 2018), table 1"
_CROSSQ_PAPER = "CrossQ (Bhatt et al. 2024): normalised critics bear it; docs/adr/0008"


@dataclass(frozen=True, slots=True, kw_only=True)
class OffPolicyConfig(Settings):
    """The hyperparameters of off-policy A2S; SAC is the same with one suggestion everywhere.

    The defaults are the preset ``modern``.

    Raises:
        ValueError: A value is outside its range; one line that names it.
    """

    act_suggestions: int = setting(
        10,
        "K_act, actions among which Q picks the executed one",
        "paper, table 3",
        low=1,
        high=1024,
    )
    selection: Selection = setting(
        "soft",
        "``hard``: the largest score; ``soft``: drawn, as if from the Boltzmann distribution of Q",
        "hard ones explore too little; docs/adr/0011",
    )
    target_suggestions: int = setting(
        1,
        "K_target of equation 7, suggestions of each group",
        "4 cost a quarter and gained nothing; docs/adr/0008",
        low=1,
        high=1024,
    )
    target_groups: int = setting(
        1, "N of equation 8, groups averaged", "a batch is a mean already", low=1, high=1024
    )
    num_critics: int = setting(
        2, "Q networks; the smallest target is used", "TD3 (Fujimoto et al. 2018)", low=1, high=64
    )
    num_quantiles: int = setting(
        25,
        "Atoms of each critic; 1: its output is the value itself",
        "TQC (Kuznetsov et al. 2020), section 4; docs/adr/0009",
        low=1,
        high=1024,
    )
    quantiles_to_drop: int = setting(
        2,
        "Atoms per critic that a target leaves out, the largest of all",
        "TQC (Kuznetsov et al. 2020), section 4; docs/adr/0009",
        low=0,
        high=1023,
    )
    kappa: float = setting(
        0.02,
        "Huber threshold: beyond it errors count by their size",
        "a few units of return, as TQC's 1; docs/adr/0012",
        low=1e-9,
        high=1e9,
    )
    network: Network = setting(
        "residual",
        "``mlp``; ``residual`` blocks; ``trunk``: the critics' first layer sees no action",
        "SimBa (Lee et al. 2024); docs/adr/0009",
    )
    critic_sizes: tuple[int, ...] = setting(
        (256, 256), "Units of the hidden layers of each critic", _SAC_PAPER
    )
    policy_sizes: tuple[int, ...] = setting(
        (256, 256), "Units of the policy's hidden layers", _SAC_PAPER
    )
    layer_norm: bool = setting(
        True,
        "Hidden layers are normalised, with gain and offset",
        "Nauman et al. 2024: above remedies particular to RL",
    )
    norm_obs: bool = setting(
        True,
        "Observations are shifted and scaled by their running mean and standard deviation",
        "SimBa (Lee et al. 2024)",
    )
    norm_return: bool = setting(
        True,
        "Rewards are divided by the size of returns; temperature and ``kappa`` are in that unit",
        "SimbaV2 (Lee et al. 2025); docs/adr/0012",
    )
    precision: Precision = setting(
        "fastest",
        "Of matrix products; ``fastest``: bf16 where that is faster",
        "matrix units and AMD's vectors are; docs/adr/0029",
    )
    policy_loss: OffPolicyLoss = setting(
        "pathwise",
        "``pathwise``: the gradient of Q; ``score``: log-density times advantage over K_act",
        _SAC_PAPER,
    )
    entropy_per_action: float = setting(
        -1.0,
        "Wanted entropy of the policy per action dimension, nats",
        _SAC_PAPER,
        low=-1000,
        high=1000,
    )
    initial_temperature: float = setting(
        0.01,
        "Weight of the entropy at first",
        "SimbaV2 (Lee et al. 2025); docs/adr/0012",
        low=0.0,
        high=1e6,
    )
    temperature_learning_rate: float = setting(
        0.0003,
        "Of Adam on the logarithm of the temperature; 0: it stays as it is",
        "SAC; 1e-3 explores too little; docs/adr/0014",
        low=0.0,
        high=1000,
    )
    average_updates: int = setting(
        1000,
        "Updates over which the policy that is kept is averaged, at most a tenth of all; 0: not",
        "the latest mean action falls now and then; docs/adr/0010",
        low=0,
    )
    gamma: float = setting(
        0.995,
        "Discount per step",
        "at 0.99 a fall costs too little; docs/adr/0015",
        low=1e-6,
        high=1,
    )
    tau: float = setting(
        0.02,
        "Fraction of their distance to the critics that the target critics move per update",
        "faster from the start in every probe; docs/adr/0009",
        low=1e-6,
        high=1,
    )
    n_step: int = setting(
        1,
        "Steps whose rewards are summed before the critics take over",
        _SAC_PAPER,
        low=1,
        high=1024,
    )
    batch_rows: int = setting(
        256, "Rows of the replay in one update", _SAC_PAPER, low=1, high=2**20
    )
    utd_ratio: float = setting(
        1.0, "Updates for each environment step", _SAC_PAPER, low=1e-6, high=1000
    )
    learning_rate: float = setting(
        0.001, "Of Adam on the policy", _CROSSQ_PAPER, low=1e-12, high=1000
    )
    critic_learning_rate: float = setting(
        0.001, "Of Adam on the critics", _CROSSQ_PAPER, low=1e-12, high=1000
    )
    policy_every: int = setting(
        2,
        "In every so many updates of the critics policy and temperature learn too",
        "TD3 (Fujimoto et al. 2018); docs/adr/0039",
        low=1,
        high=10**6,
    )
    warm_up_steps: int = setting(
        5000,
        "Random steps before the first update, at most a tenth of a run",
        "CleanRL; REDQ (Chen et al. 2021)",
        low=1,
    )
    replay_rows: int = setting(
        1_000_000, "Steps that the replay keeps; the oldest go first", _SAC_PAPER, low=1, high=10**9
    )
    prioritised: bool = setting(
        False,
        "Rows with a large error are sampled more often",
        "large errors of a maximum are its optimism too",
    )
    priority_exponent: float = setting(
        0.6, "Alpha, power of the errors", "Schaul et al. 2016, table 3", low=0.0, high=1
    )
    importance_exponent: float = setting(
        0.4, "Beta, power of the weights", "Schaul et al. 2016, table 3", low=0.0, high=1
    )
    send_every_steps: int = setting(
        8,
        "Steps after which an actor sends what it has",
        "a round of 16 environments is then 128 steps",
        low=1,
    )
    short_steps: int = setting(
        200,
        "Steps of the short episodes in which actors make half of their steps; 0: none",
        "a start is one step of a thousand; docs/adr/0038",
        low=0,
        high=10**9,
    )
    lead_steps: int = setting(
        16,
        "Steps that acting or learning may be ahead of ``utd_ratio`` before it waits",
        "at 256 actors play weights 250 updates old; docs/adr/0013",
        low=1,
    )

    def __post_init__(self) -> None:
        """Check every value, then those that depend on each other."""
        Settings.__post_init__(self)
        check_most("batch_rows", self.batch_rows, "replay_rows", self.replay_rows)
        for other in ("lead_steps", "replay_rows"):
            check_most("send_every_steps", self.send_every_steps, other, getattr(self, other))
        if self.quantiles_to_drop >= self.num_quantiles:
            expected = f"fewer than num_quantiles ({self.num_quantiles})"
            refuse("quantiles_to_drop", self.quantiles_to_drop, expected)
        if self.initial_temperature == 0.0:
            if self.temperature_learning_rate > 0.0:
                refuse("initial_temperature", 0.0, "above 0 where temperature_learning_rate is")
            if self.selection == "soft" and self.act_suggestions > 1:
                refuse("initial_temperature", 0.0, "above 0 with selection soft")
        if self.network == "trunk" and len(self.critic_sizes) < 2:
            refuse("critic_sizes", self.critic_sizes, "at least two with network trunk")


_SAC = replace(
    OffPolicyConfig(),
    act_suggestions=1,  # SAC has one
    selection="hard",  # not used here
    num_quantiles=1,  # SAC's critics have one value
    quantiles_to_drop=0,  # not used here
    kappa=1.0,  # not used here
    network="mlp",  # SAC (Haarnoja et al. 2018), table 1
    norm_return=False,  # SAC (Haarnoja et al. 2018), table 1
    initial_temperature=0.1,  # from 1 it is 5,000 updates on the way; docs/adr/0008
    temperature_learning_rate=0.001,  # CrossQ; docs/adr/0008
    average_updates=0,  # SAC (Haarnoja et al. 2018), table 1
    gamma=0.99,  # SAC (Haarnoja et al. 2018), table 1
    tau=0.005,  # SAC (Haarnoja et al. 2018), table 1
    policy_every=1,  # SAC (Haarnoja et al. 2018), table 1
    short_steps=0,  # SAC (Haarnoja et al. 2018), table 1
)
_PAPER = replace(
    OffPolicyConfig(),
    selection="hard",  # paper, algorithm 2
    target_suggestions=10,  # paper, table 3
    target_groups=3,  # paper, section 4.2: low; the authors' code has 1 to 3
    num_critics=1,  # paper, algorithm 2
    num_quantiles=1,  # paper, algorithm 2
    quantiles_to_drop=0,  # not used here
    kappa=1.0,  # not used here
    network="mlp",  # paper, algorithm 2
    critic_sizes=(128, 64),  # paper, section 5
    policy_sizes=(64, 64),  # paper, section 5
    norm_obs=False,  # authors' code
    norm_return=False,  # paper, algorithm 2
    precision="f32",  # networks too small to gain
    policy_loss="score",  # paper, algorithm 2
    initial_temperature=0.0,  # paper, algorithm 2
    temperature_learning_rate=0.0,  # paper, algorithm 2
    average_updates=0,  # paper, algorithm 2
    gamma=0.97,  # paper, table 3
    tau=1.0,  # paper, algorithm 2: no target network
    policy_every=1,  # paper, algorithm 2
    short_steps=0,  # paper, algorithm 2
    warm_up_steps=1000,  # the box has none; an untrained Q prefers one direction
)
PRESETS = {
    "modern": Preset(OffPolicyConfig(), ""),
    "sac": Preset(_SAC, "SAC (Haarnoja et al. 2018), table 1; docs/adr/0008"),
    "paper": Preset(_PAPER, "paper, algorithm 2 and section 5"),
}
