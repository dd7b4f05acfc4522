"""Everything that learning changes and recovery can restore."""

from dataclasses import dataclass

import torch
from torch import Tensor

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.networks.form import Form
from a2s.learner.networks.gaussian import Policy
from a2s.learner.networks.normaliser import Normaliser
from a2s.learner.networks.stored import check_tensors
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.returns import ReturnScale


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """Copies of what was learned, as ``Learned.capture`` made them.

    Attributes:
        tensors: Parameters, moments and statistics of observations, by name.
        returns: State of the scale of returns.
        weights_version: Version under which the networks made the batch.
    """

    tensors: dict[str, Tensor]
    returns: dict[str, float]
    weights_version: int


class Learned:
    """Networks, their optimisers and their normalisers.

    Attributes:
        normaliser: Of the observations.
        returns: Scale of what Q and V say.
        policy: Suggests.
        value_net: V.
        q_net: Q.
        adam: One optimiser for ``policy``, ``value`` and ``q``, and ``distil`` (of the policy).
    """

    def __init__(
        self, obs_size: int, action_size: int, hyper: OnPolicyConfig, generator: torch.Generator
    ) -> None:
        self.normaliser = Normaliser(obs_size, enabled=hyper.norm_obs)
        self.returns = ReturnScale(
            enabled=hyper.norm_return, window_steps=hyper.return_window_steps
        )
        self.policy = make_policy(obs_size, action_size, hyper, generator)
        self.value_net = make_critic(obs_size, hyper.value_sizes, hyper, generator)
        self.q_net = make_critic(obs_size + action_size, hyper.q_sizes, hyper, generator)
        self._flat = {
            "policy": self.policy.value,
            "value": self.value_net.value,
            "q": self.q_net.value,
        }
        self.adam = {name: Adam(value) for name, value in self._flat.items()}
        self.adam["distil"] = Adam(self.policy.value)

    def is_finite(self) -> bool:
        """Whether every parameter is a number."""
        return all(bool(torch.isfinite(flat).all()) for flat in self._flat.values())

    def capture(self, weights_version: int) -> Snapshot:
        """Copy everything."""
        tensors = {name: flat.clone() for name, flat in self._flat.items()}
        for name, buffer in self.normaliser.named_buffers():
            tensors[f"normaliser.{name}"] = buffer.clone()
        for name, adam in self.adam.items():
            tensors |= {f"adam.{name}.{key}": each.clone() for key, each in adam.tensors().items()}
        return Snapshot(
            tensors=tensors, returns=self.returns.state(), weights_version=weights_version
        )

    def restore(self, snapshot: Snapshot, *, everything: bool) -> None:
        """Go back to a snapshot.

        Args:
            snapshot: From `capture`.
            everything: Also optimisers and the statistics of observations. The scale of returns
                always goes with the networks: it is the unit in which they speak.

        Raises:
            RunDirectoryError: A tensor is missing or has another shape.
        """
        stored = snapshot.tensors
        check_tensors(stored, self.capture(0).tensors)
        for name, flat in self._flat.items():
            flat.copy_(stored[name])
        self.returns.load(snapshot.returns)
        if not everything:
            return
        for name, buffer in self.normaliser.named_buffers():
            buffer.copy_(stored[f"normaliser.{name}"])
        for name, adam in self.adam.items():
            for key, tensor in adam.tensors().items():
                tensor.copy_(stored[f"adam.{name}.{key}"])


def make_policy(
    obs_size: int, action_size: int, hyper: OnPolicyConfig, generator: torch.Generator
) -> Policy:
    """An untrained policy."""
    return Policy(
        (obs_size, *hyper.policy_sizes, action_size),
        layer_norm=hyper.layer_norm,
        init=hyper.init,
        std=hyper.std,
        std_floor=hyper.std_floor,
        learns_std=hyper.learn_std,
        generator=generator,
    )


def make_critic(
    inputs: int, hidden: tuple[int, ...], hyper: OnPolicyConfig, generator: torch.Generator
) -> Ensemble:
    """An untrained Q or V, ``[N, in]`` to ``[N, 1]``, in normalised returns."""
    form = Form((inputs, *hidden, 1), activation="tanh", layer_norm=hyper.layer_norm)
    return Ensemble(form, form.draw(1, generator, init=hyper.init), single=True)
