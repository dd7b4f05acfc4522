"""Off-policy learning in several processes: each has some of the critics, and all else too."""

from collections.abc import Sequence
from dataclasses import asdict

import torch
from torch import Tensor

from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.off_policy.config import OffPolicyConfig
from a2s.learner.off_policy.noise import Noise
from a2s.learner.off_policy.stats import OffPolicyStats
from a2s.learner.off_policy.transitions import Transitions
from a2s.learner.off_policy.update import OffPolicy
from a2s.learner.processes import END, Processes
from a2s.protocol.errors import UsageError

_MAKE = "make"


class Leading(OffPolicy):
    """The algorithm in the first process; whatever all have to do, it has them do first.

    Raises:
        UsageError: The critics cannot be divided.
        A2SError: From all methods: another process is gone.
    """

    def __init__(
        self,
        obs_size: int,
        action_size: int,
        hyper: OffPolicyConfig,
        seed: int,
        processes: Processes,
    ) -> None:
        if hyper.num_critics % processes.count:
            raise UsageError(
                f"torchrun: found {processes.count} processes, expected a number that divides the "
                f"{hyper.num_critics} critics"
            )
        self._processes = processes
        sizes = {"obs_size": obs_size, "action_size": action_size}
        threads = torch.get_num_threads()  # on which the last bits depend
        processes.tell(_MAKE, **sizes, hyper=asdict(hyper), seed=seed, threads=threads)
        super().__init__(obs_size, action_size, hyper, seed, peers=processes)

    def observe(self, obs: Tensor) -> None:
        """In all processes."""
        self._processes.tell("observe", obs)
        super().observe(obs)

    def observe_returns(self, returns: Tensor) -> None:
        """In all processes."""
        self._processes.tell("observe_returns", returns)
        super().observe_returns(returns)

    def update(
        self, batch: Transitions, noise: Noise | None = None, *, learns_policy: bool = True
    ) -> OffPolicyStats:
        """In all processes, which draw the same noise."""
        if noise is not None:
            raise ValueError("found noise, expected none: each process draws it")
        rows = [each.unsqueeze(1) if each.dim() == 1 else each for each in batch]
        self._processes.tell("update", torch.cat(rows, 1), learns_policy=learns_policy)
        return super().update(batch, learns_policy=learns_policy)

    def all_critics(self) -> Ensemble:
        """From all processes."""
        self._processes.tell("all_critics")
        return super().all_critics()

    def is_finite(self) -> bool:
        """In all processes."""
        self._processes.tell("is_finite")
        return super().is_finite()

    def state(self) -> dict[str, Tensor]:
        """Of all processes together: as one process would have it."""
        self._processes.tell("state")
        return super().state()

    def load(self, tensors: dict[str, Tensor]) -> None:
        """In all processes."""
        self.check(tensors)
        names = list(tensors)
        self._processes.tell("load", *tensors.values(), names=names)
        super().load(tensors)

    def begin_with(self, stored: dict[str, Tensor], taken: Sequence[str]) -> None:
        """In all processes."""
        self._processes.tell("begin_with", *stored.values(), names=list(stored), taken=list(taken))
        super().begin_with(stored, taken)


def follow(processes: Processes) -> None:
    """Do what the first process does, until it ends.

    Raises:
        A2SError: It is gone.
    """
    made = processes.hear()
    if made.name == END:
        return
    torch.set_num_threads(made.about.pop("threads"))
    hyper = OffPolicyConfig(**OffPolicyConfig.parse(made.about.pop("hyper")))
    algorithm = OffPolicy(**made.about, hyper=hyper, peers=processes)
    while (call := processes.hear()).name != END:
        if call.name == "update":
            algorithm.update(_rows(call.tensors[0], algorithm), **call.about)
        elif "names" in call.about:
            named = dict(zip(call.about.pop("names"), call.tensors, strict=True))
            getattr(algorithm, call.name)(named, **call.about)
        else:
            getattr(algorithm, call.name)(*call.tensors)


def _rows(joined: Tensor, algorithm: OffPolicy) -> Transitions:
    """Take the columns of a batch apart again."""
    obs, action = algorithm.obs_size, algorithm.action_size
    sizes = {"obs": obs, "action": action, "next_obs": obs}
    columns = torch.split(joined, [sizes.get(name, 1) for name in Transitions._fields], 1)
    named = zip(Transitions._fields, columns, strict=True)
    return Transitions(*(x if name in sizes else x.squeeze(1) for name, x in named))
