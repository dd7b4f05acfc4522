"""What is run: suites of environments, labels, seeds and steps. Seeds were fixed before any run."""

from dataclasses import dataclass
from pathlib import Path

PENDULUM = "InvertedPendulum-v5"
MUJOCO = ("Hopper-v5", "Walker2d-v5", "HalfCheetah-v5")
REFERENCE = "sb3-sac"

# Changed by `arms.py`, not by an option.
ARMS = ("placebo", "pathwise", "no-ppo", "centred")

_OFF = ("--variant", "off-policy")


def _set(**options: object) -> tuple[str, ...]:
    return tuple(word for item in options.items() for word in ("--set", "{}={}".format(*item)))


def _off(**options: object) -> tuple[str, ...]:
    """Off-policy A2S of before ADR 38 and 39, with something else than its default."""
    return (*_OFF, *_set(short_steps=0, policy_every=1, **options))


def _a2c(**options: object) -> tuple[str, ...]:
    """A2C with something else than its default."""
    return ("--algo", "a2c", *_set(**options))


# What A2C might do with the computing that the suggestions cost, or with other settings.
_A2C_TRIALS = {
    "a2c-20-epochs": _a2c(policy_epochs=20, critic_epochs=20),
    "a2c-30-epochs": _a2c(policy_epochs=30, critic_epochs=30, kl_stop=0.1),
    "a2c-minibatch-64": _a2c(policy_minibatch=64, critic_minibatch=64),
    "a2c-batch-1024": _a2c(batch_steps=1024),
    "a2c-rates-5e-4": _a2c(learning_rate=0.0005, critic_learning_rate=0.0015),
    "a2c-128-128": _a2c(policy_sizes=[128, 128], value_sizes=[128, 128], critic_epochs=20),
    "a2c-lambda-0.9": _a2c(gae_lambda=0.9),
    "a2c-gamma-0.99": _a2c(gamma=0.99),
    "a2c-floor-0.1": _a2c(std_floor=0.1),
    "a2c-clip-0.3": _a2c(clip_ratio=0.3, kl_stop=0.1),
}

_BOTH = ("off-policy", "off-policy-k1")
# Beside both, one K is varied at a time, and then both.
_BEST_OF_K = {
    f"act-{act}-target-{target}": _off(act_suggestions=act, target_suggestions=target)
    for act, target in ((4, 1), (1, 4), (1, 10), (10, 4))
}
_PARTS = {
    "no-obs-norm": _off(norm_obs=False),
    "no-return-norm": _off(norm_return=False, kappa=1, initial_temperature=0.1),
    "no-layer-norm": _off(layer_norm=False),
    "mlp": _off(network="mlp"),
    "one-value": _off(num_quantiles=1, quantiles_to_drop=0),
    "act-hard": _off(selection="hard"),
    "n-step-3": _off(n_step=3),
    "two-updates": _off(utd_ratio=2),
    "trunk": _off(network="trunk"),
    "tau-0.005": _off(tau=0.005),
}
LABELS: dict[str, tuple[str, ...]] = {
    "modern": (),
    "a2c": ("--algo", "a2c"),
    "authors": ("--preset", "authors"),
    "authors-a2c": ("--preset", "authors", "--algo", "a2c"),
    "k1": ("--suggestions", "1"),
    "k2": ("--suggestions", "2"),
    "k4": ("--suggestions", "4"),
    "k32": ("--suggestions", "32"),
    "no-recovery": ("--set", "recovery=off"),
    "no-window": ("--set", "window_steps=1"),
    **dict.fromkeys(ARMS, ()),
    **_A2C_TRIALS,
    "short": _OFF,
    "short-k1": (*_OFF, *_set(act_suggestions=1)),
    "off-policy": _off(),
    "off-policy-k1": _off(act_suggestions=1),
    "gamma-0.99": _off(gamma=0.99),
    **_BEST_OF_K,
    **_PARTS,
}
# What the authors had: one environment.
_ONE_ENV = ("authors", "authors-a2c")


@dataclass(frozen=True)
class Suite:
    """One table and one picture.

    Attributes:
        folder: Where results are kept beside this file.
        envs: Environments.
        labels: Of `LABELS`, or `REFERENCE`: Stable-Baselines3's SAC with its defaults.
        seeds: Of every label.
        steps: Of every run.
        num_envs: Environments of the actor process.
        continues: A suite of fewer steps: runs that it has as well go on from where they ended.
        keep_every: Updates after which a policy is kept, to be evaluated when the run has ended.
    """

    folder: str
    envs: tuple[str, ...]
    labels: tuple[str, ...]
    seeds: tuple[int, ...]
    steps: int
    num_envs: int
    continues: str | None = None
    keep_every: int = 0

    def options(self, env: str, label: str, seed: int) -> tuple[str, ...]:
        """Of the run."""
        num_envs = 1 if label in _ONE_ENV else self.num_envs
        kept = ("--keep-policy-every", str(self.keep_every)) if self.keep_every else ()
        return (
            "--env", env, "--total-steps", str(self.steps), "--seed", str(seed), "--n", "1",
            "--envs", str(num_envs), *LABELS[label], *kept,
        )  # fmt: skip


_ABLATED = ("Hopper-v5", "HalfCheetah-v5")
_OFF_ABLATED = ("Walker2d-v5", "HalfCheetah-v5")

SUITES = {
    "figure-2": Suite(
        "on_policy",
        (PENDULUM,),
        ("modern", "no-recovery", "a2c"),
        (0, 1, 2, 3, 4),
        20_000,
        16,
        keep_every=1,
    ),
    "million": Suite(
        "on_policy", MUJOCO, ("modern", "a2c", "authors", "authors-a2c"), (0, 1, 2), 1_000_000, 16
    ),
    # 25 updates of 2,048 steps are 51,200.
    "suggestions": Suite(
        "on_policy", MUJOCO, ("modern", "a2c"), tuple(range(20, 30)), 1_000_000, 16, keep_every=25
    ),
    "suggestions-300k": Suite(
        "on_policy",
        MUJOCO,
        ("modern", "a2c", "k2", "k4", "k32", "no-window", *ARMS),
        tuple(range(20, 25)),
        300_000,
        16,
        keep_every=25,
    ),
    # The best of these in all three environments is the tuned A2C of the table.
    "a2c-trials": Suite(
        "on_policy", MUJOCO, ("a2c", *_A2C_TRIALS), (100, 101), 300_000, 16, keep_every=25
    ),
    # The results have more labels, of options that are gone since.
    "ablation": Suite(
        "on_policy", _ABLATED, ("modern", "k1", "k4", "no-recovery"), (0, 1, 2), 300_000, 16
    ),
    "best-of-k": Suite("off_policy", _OFF_ABLATED, (*_BOTH, *_BEST_OF_K), (1, 2), 50_000, 1),
    "parts": Suite("off_policy", _OFF_ABLATED, ("off-policy", *_PARTS), (1, 2), 50_000, 1),
    "100k": Suite(
        "off_policy",
        (*MUJOCO, "Ant-v5"),
        (*_BOTH, "gamma-0.99", "loud-rare-obs", REFERENCE),
        (0, 1, 2),
        100_000,
        1,
        continues="best-of-k",
    ),
    "short-100k": Suite(
        "off_policy", (*MUJOCO, "Ant-v5"), ("short", "short-k1"), tuple(range(20, 25)), 100_000, 1
    ),
    "300k": Suite(
        "off_policy", (*_OFF_ABLATED, "Ant-v5"), _BOTH, (0, 1, 2), 300_000, 1, continues="100k"
    ),
}


def name_of(suite: str, env: str, label: str, seed: int) -> str:
    """Name of a run, also of its kept episodes."""
    return f"{env}-{label}-{SUITES[suite].steps}-{seed}"


def kept_evaluations(folder: Path, suite: str, name: str) -> Path:
    """Where the evaluations of a run's policies are kept: ``env_steps,mean,wall_s``."""
    return folder / "evaluations" / suite / f"{name}.csv"


def kept_episodes(folder: Path, suite: str, name: str) -> Path:
    """Where the episodes of a run of this name are kept: beside the ``results.csv`` of a folder."""
    return folder / "episodes" / suite / f"{name}.csv.gz"
