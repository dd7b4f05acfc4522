"""The options of a run, as the command line has them, checked."""

import math
from dataclasses import dataclass
from typing import Literal

from a2s.learner.settings import Settings, setting
from a2s.protocol.env_config import TIMEOUT_S, EnvConfig, kwargs_of, wrapper_of
from a2s.protocol.errors import MalformedMessageError, UsageError
from a2s.protocol.evaluation_messages import MAX_EPISODES
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Clock

Variant = Literal["on-policy", "off-policy"]
# What is counted as an update.
COUNTED = {"on-policy": "updates", "off-policy": "gradient steps"}
Algo = Literal["a2s", "a2c"]
Device = Literal["cpu", "cuda"]

_HALF = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class RunConfig(Settings):
    """The options of a run.

    Raises:
        ValueError: A value is impossible; one line that names it.
    """

    run: str = setting("default", "Name of the run, a part of every key on the network")
    env: str = setting("Hopper-v5", "Gymnasium id, module:Id-v0, module:Class, or FILE.py: either")
    env_kwargs: tuple[str, ...] = setting((), "KEY=VALUE of its constructor; JSON, or else text")
    wrappers: tuple[str, ...] = setting((), "module:Class or module:Class={JSON}, innermost first")
    action_repeat: int = setting(1, "Environment steps for each action", low=1, high=1000)
    frame_stack: int = setting(1, "Latest observations seen at once", low=1, high=1000)
    max_episode_steps: int = setting(
        0, "Steps after which an episode is cut; 0: the environment's own", low=0, high=2**31 - 1
    )
    env_timeout_s: float = setting(
        TIMEOUT_S, "Seconds in which a call into an environment has to return", low=0.001, high=1e9
    )
    info_metrics: tuple[str, ...] = setting((), "Keys of info kept with each episode")
    variant: Variant = setting("on-policy", "Algorithm 1 of the paper, or 2")
    algo: Algo = setting("a2s", "a2s, or a2c: one suggestion, no Q")
    preset: str = setting("modern", "Named set of hyperparameters")
    total_steps: int = setting(
        1_000_000, "Environment steps at which the run ends", low=1, high=2**63 - 1
    )
    seed: int = setting(0, "Seed of everything", low=0, high=2**63 - 1)
    clock: Clock = setting("lockstep", "lockstep: one version, one batch; async: actors never wait")
    init_from: str = setting("", "Run directory whose weights it begins with, as far as they fit")
    prior: str = setting("", "Directory of prior data, of which every batch has a share")
    prior_share: float = setting(
        _HALF, "Share of a batch that is prior data; RLPD: half", low=0.01, high=0.99
    )
    n: int = setting(1, "Actor processes that the first weights wait for", low=1)
    envs: int = setting(8, "Environments in each actor process", low=1, high=4096)
    checkpoint_every_updates: int = setting(20, "Updates between checkpoints", low=1)
    keep_policy_every_updates: int = setting(
        0, "Updates between policies that are kept for good; 0 keeps none", low=0
    )
    evaluate_every: int = setting(
        0, "Steps between evaluations by an evaluator; 0: there are none", low=0
    )
    evaluation_episodes: int = setting(10, "Episodes of an evaluation", low=1, high=MAX_EPISODES)
    stop_at_return: float = setting(
        math.inf, "The run ends when an evaluation has this mean return, or more"
    )
    tensorboard: bool = setting(False, "Write tensorboard/ in the run directory as well")
    threads: int = setting(1, "Threads of torch; small networks are fastest with one", low=1)
    device: Device = setting("cpu", "Where off-policy networks learn; actors need no GPU")

    def __post_init__(self) -> None:
        """Check every value, then those that depend on each other."""
        Settings.__post_init__(self)
        Keys(self.run)
        self.env_config()
        if self.stop_at_return < math.inf and not self.evaluate_every:
            raise UsageError("stop_at_return: only evaluations are looked at; add --evaluate-every")
        if self.prior and self.variant != "off-policy":
            raise UsageError(
                f"prior: found {self.prior}, expected none with variant {self.variant}; "
                "add --variant off-policy"
            )
        if self.prior_share != _HALF and not self.prior:
            raise UsageError("prior_share: there are no prior data to draw from; add --prior")
        name, only = ("algo", "a2s") if self.variant == "off-policy" else ("device", "cpu")
        if (found := getattr(self, name)) != only:
            raise UsageError(f"{name}: found {found}, expected {only} with variant {self.variant}")

    def env_config(self) -> EnvConfig:
        """How the environment is made.

        Raises:
            UsageError: An argument or a wrapper cannot be read.
        """
        for wrapper in self.wrappers:
            wrapper_of(wrapper)
        try:
            return EnvConfig(
                env_id=self.env,
                kwargs=kwargs_of(self.env_kwargs),
                wrappers=self.wrappers,
                action_repeat=self.action_repeat,
                frame_stack=self.frame_stack,
                max_episode_steps=self.max_episode_steps,
                timeout_s=self.env_timeout_s,
                info_metrics=self.info_metrics,
            )
        except MalformedMessageError as error:
            raise UsageError(str(error)) from None
