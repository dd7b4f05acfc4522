"""Everything that off-policy learning changes."""

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.networks.form import Form
from a2s.learner.networks.normaliser import Normaliser
from a2s.learner.networks.peers import ALONE, Peers, part_of, whole_of
from a2s.learner.off_policy.config import OffPolicyConfig
from a2s.learner.off_policy.return_size import ReturnSize

_OF_CRITICS = ("critics", "targets", "adam.critics.first", "adam.critics.second")


class TrainState:
    """Networks, their optimisers, the temperature and the normalisers.

    ``generator`` draws the first weights, on the CPU. Of the critics, with all that belongs to
    them, it has this process's part alone.

    Attributes:
        normaliser: Of the observations.
        return_size: The unit of critics and temperature.
        policy: One network, ``[D]`` to ``[2 A]``: means and log standard deviations of u.
        critics: E networks, ``[D + A]`` to the M atoms of a value.
        targets: The same, averaged over time.
        average: The policy, averaged over time; the same object where that is not wanted.
        log_temperature: Logarithm of the weight of the entropy, ``[]``.
        adam: One optimiser for ``policy``, ``critics`` and ``temperature``.
    """

    def __init__(
        self,
        obs_size: int,
        action_size: int,
        hyper: OffPolicyConfig,
        generator: torch.Generator,
        device: torch.device,
        peers: Peers = ALONE,
    ) -> None:
        def make(sizes: tuple[int, ...], members: int, late: int = 0) -> Ensemble:
            form = Form(
                sizes,
                network=hyper.network,
                activation="relu",
                layer_norm=hyper.layer_norm,
                late=late,
            )
            first = form.draw(members, generator)
            if members > 1:
                first = part_of(form, first, peers.own(members))
            return Ensemble(form, first.to(device), bf16=hyper.precision == "bf16")

        self._peers, self._num_critics = peers, hyper.num_critics
        self.normaliser = Normaliser(obs_size, enabled=hyper.norm_obs, quiets_rare=True).to(device)
        self.return_size = ReturnSize(enabled=hyper.norm_return, device=device)
        self.policy = make((obs_size, *hyper.policy_sizes, 2 * action_size), 1)
        joined = obs_size + action_size
        sizes = (joined, *hyper.critic_sizes, hyper.num_quantiles)
        self.critics = make(sizes, hyper.num_critics, late=action_size)
        self.targets = self.critics.copy()
        self._average_updates = hyper.average_updates
        self.average = self.policy
        if hyper.average_updates:
            first = self.policy.value.clone()
            self.average = Ensemble(self.policy.form, first)
        self.log_temperature = torch.tensor(hyper.initial_temperature, device=device).log()
        self.learns_temperature = hyper.temperature_learning_rate > 0
        self.adam = {
            "policy": Adam(self.policy.value),
            "critics": Adam(self.critics.value),
            "temperature": Adam(self.log_temperature),
        }

    def update_average(self) -> None:
        """Move the average towards the policy.

        It reaches back over a tenth of the updates so far, so that the first ones do not last.
        """
        if self.average is not self.policy:
            reach = (self.adam["critics"].steps / 10.0).clamp(1.0, self._average_updates)
            self.average.value.lerp_(self.policy.value, 1.0 / reach)

    def is_finite(self) -> bool:
        """Whether every parameter is a number; waits for the device."""
        found = [self.policy.value, self.critics.value, self.targets.value]
        found += [self.log_temperature] if self.learns_temperature else []
        return all(bool(torch.isfinite(each).all()) for each in found)

    def tensors(self) -> dict[str, Tensor]:
        """All of it by name, not copied."""
        found = {
            "policy": self.policy.value,
            "critics": self.critics.value,
            "targets": self.targets.value,
            "log_temperature": self.log_temperature,
        }
        if self.average is not self.policy:
            found["average"] = self.average.value
        found |= {f"normaliser.{name}": each for name, each in self.normaliser.named_buffers()}
        found |= {f"return_size.{name}": each for name, each in self.return_size.tensors().items()}
        for name, adam in self.adam.items():
            found |= {f"adam.{name}.{key}": each for key, each in adam.tensors().items()}
        return found

    def state(self) -> dict[str, Tensor]:
        """Copies of all of it, as one process alone has it; asked in all at once."""
        return {name: self._whole(name, tensor) for name, tensor in self.tensors().items()}

    def shapes(self) -> dict[str, Tensor]:
        """Tensors of the shapes of `state`, of which nothing but that is to be read."""
        whole = torch.empty(self._num_critics * self.critics.form.length, device="meta")
        return self.tensors() | dict.fromkeys(_OF_CRITICS, whole)

    def all_critics(self) -> Ensemble:
        """Those of all processes, valid until the next update; asked in all at once."""
        if self._peers is ALONE:
            return self.critics
        return Ensemble(self.critics.form, self._whole("critics", self.critics.value))

    def begin_with(self, stored: dict[str, Tensor], taken: Sequence[str]) -> None:
        """Take networks, ``log_temperature`` or ``normaliser`` of another run's `state`.

        With the critics goes the size of returns, which is their unit.
        """
        parts = {*taken, *(["return_size"] if "critics" in taken else [])}
        self._take(stored, [name for name in self.tensors() if name.partition(".")[0] in parts])

    def load(self, stored: dict[str, Tensor]) -> None:
        """Overwrite all of it by a `state` that fits."""
        self._take(stored, self.tensors())

    def _take(self, stored: dict[str, Tensor], names: Iterable[str]) -> None:
        present = self.tensors()
        for name in names:
            present[name].copy_(self._part(name, stored[name]))
        for ensemble in (self.policy, self.critics, self.targets):
            ensemble.refresh()

    def _whole(self, name: str, tensor: Tensor) -> Tensor:
        if name in _OF_CRITICS and self._peers is not ALONE:
            return whole_of(self.critics.form, tensor, self._peers)
        return tensor.clone()

    def _part(self, name: str, whole: Tensor) -> Tensor:
        if name not in _OF_CRITICS:
            return whole
        return part_of(self.critics.form, whole, self._peers.own(self._num_critics))
