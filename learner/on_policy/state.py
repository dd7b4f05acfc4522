"""Everything that learning changes and recovery can restore."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from a2s.learner.networks.adam import Adam, FlatParameters
from a2s.learner.networks.networks import Normaliser, Policy, Q, Value
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.returns import ReturnScale
from a2s.protocol.errors import RunDirectoryError


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
        self.policy = Policy(obs_size, action_size, hyper, generator)
        self.value_net = Value(obs_size, hyper, generator)
        self.q_net = Q(obs_size, action_size, hyper, generator)
        self._flat = {
            "policy": FlatParameters(self.policy),
            "value": FlatParameters(self.value_net),
            "q": FlatParameters(self.q_net),
        }
        self.adam = {
            "policy": Adam(self._flat["policy"]),
            "value": Adam(self._flat["value"]),
            "q": Adam(self._flat["q"]),
            "distil": Adam(self._flat["policy"]),
        }

    def is_finite(self) -> bool:
        """Whether every parameter is a number."""
        return all(bool(torch.isfinite(flat.value).all()) for flat in self._flat.values())

    def capture(self, weights_version: int) -> Snapshot:
        """Copy everything."""
        tensors = {name: flat.value.clone() for name, flat in self._flat.items()}
        for name, buffer in self.normaliser.named_buffers():
            tensors[f"normaliser.{name}"] = buffer.clone()
        for name, adam in self.adam.items():
            tensors |= {f"adam.{name}.{key}": value for key, value in adam.state().items()}
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
            flat.load(stored[name])
        self.returns.load(snapshot.returns)
        if not everything:
            return
        for name, buffer in self.normaliser.named_buffers():
            buffer.copy_(stored[f"normaliser.{name}"])
        for name, adam in self.adam.items():
            adam.load({key: stored[f"adam.{name}.{key}"] for key in adam.state()})


def check_tensors(found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    """Refuse stored tensors that do not fit.

    Raises:
        RunDirectoryError: One is missing or has another shape.
    """
    for name, tensor in expected.items():
        if name not in found:
            wrong = f"found no tensor {name!r}, expected one"
        elif found[name].shape != tensor.shape:
            shapes = f"found shape {list(found[name].shape)}, expected {list(tensor.shape)}"
            wrong = f"{name}: {shapes}"
        else:
            continue
        raise RunDirectoryError(
            f"learner state: {wrong}; it is of other hyperparameters or of another version of a2s: "
            "begin a new run"
        )
