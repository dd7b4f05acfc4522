"""Everything that learning changes: contents of a checkpoint, and state restored by a recovery."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.networks.form import Form
from a2s.learner.networks.gaussian import Policy
from a2s.learner.networks.normaliser import Normaliser
from a2s.learner.networks.stored import check_tensors
from a2s.learner.on_policy import categorical
from a2s.learner.on_policy.batch import Batch
from a2s.learner.on_policy.calibration import Calibration
from a2s.learner.on_policy.critics import Regression
from a2s.learner.on_policy.learning_rate import LearningRate
from a2s.learner.on_policy.presets import AnyOnPolicyConfig
from a2s.learner.on_policy.recovery import Recovery, RecoveryDecision
from a2s.learner.on_policy.returns import ReturnScale
from a2s.learner.on_policy.window import Kept, Window, is_of_window, stored_window, window_tensors
from a2s.protocol.errors import A2SError

_GENERATORS = ("networks", "order", "q", "recovery")
_BEST = "best."


class Snapshot(NamedTuple):
    """Copies of the state that a recovery restores."""

    tensors: dict[str, Tensor]  # parameters, moments and statistics of observations, by name
    returns: dict[str, float]  # state of the scale of returns
    calibration: dict[str, float]
    act_inverse_temperature: float
    window: Kept  # not copies: a batch does not change
    weights_version: int  # under which the networks made the batch


class TrainState:
    """Networks, their optimisers, normalisers, learning rate, recovery and random generators.

    Attributes:
        normaliser: Of the observations.
        returns: Scale of what Q and V say.
        adam: One optimiser for ``policy``, ``value`` and ``q``, and ``distil`` (of the policy).
        generators: ``networks`` for first weights, ``order`` for minibatches, ``q`` for what only Q
            needs (so that A2C draws the same), ``recovery`` for equation 5.
        best: The networks that reached r*.
        calibration: What Q is worth; the presets ``authors`` and ``paper`` have none.
        window: Batches that Q learns from; the same.
        act_inverse_temperature: Of the actors' choice, per unit of Q's outputs.
        updates: Batches learned from.
        q_trusted: Q may choose. The argmax of an untrained Q is one arbitrary direction everywhere.
    """

    def __init__(
        self,
        obs_size: int,
        action_size: int,
        config: AnyOnPolicyConfig,
        learning_rate: LearningRate,
        recovery: Recovery,
        seed: int,
        *,
        window_steps: int = 0,
    ) -> None:
        root = torch.Generator().manual_seed(seed)
        seeds = torch.randint(2**62, (len(_GENERATORS),), generator=root).tolist()
        self.generators = {
            name: torch.Generator().manual_seed(each)
            for name, each in zip(_GENERATORS, seeds, strict=True)
        }
        first = self.generators["networks"]
        self.normaliser = Normaliser(obs_size, enabled=config.norm_obs)
        self.returns = ReturnScale(
            enabled=config.norm_return, window_steps=config.return_window_steps
        )
        self.policy = make_policy(obs_size, action_size, config, first)
        self.value_net = make_critic(obs_size, config.value_sizes, config, first)
        inputs = obs_size + action_size
        self.q_net = (
            make_q(inputs, config.q_sizes, first)
            if window_steps
            else make_critic(inputs, config.q_sizes, config, first)
        )
        self.calibration = Calibration()
        self.window = Window(window_steps)
        self._flat = {
            "policy": self.policy.value,
            "value": self.value_net.value,
            "q": self.q_net.value,
        }
        self.adam = {name: Adam(value) for name, value in self._flat.items()}
        self.adam["distil"] = Adam(self.policy.value)
        self.learning_rate = learning_rate
        self.recovery = recovery
        self.best: Snapshot | None = None
        self._before: Snapshot | None = None
        self.updates = 0
        self.q_trusted = False
        self.act_inverse_temperature = 0.0

    def fit_of_value(self, norm_obs: Tensor) -> Regression:
        """V, to be fitted on observations ``[N, D]``."""
        return Regression(self.value_net, self.adam["value"], norm_obs)

    def fit_of_q(self, norm_obs: Tensor, action: Tensor) -> Regression:
        """Q, to be fitted on observations ``[N, D]`` and actions ``[N, A]``."""
        inputs = torch.cat([norm_obs, action], 1)
        return Regression(self.q_net, self.adam["q"], inputs)

    def end_update(self) -> None:
        """Count an update.

        Raises:
            A2SError: It left a parameter that is not finite.
        """
        self.updates += 1
        if not all(bool(torch.isfinite(flat).all()) for flat in self._flat.values()):
            raise A2SError(f"update {self.updates}: found non-finite weights, expected finite")

    def judge(self, batch: Batch, *, is_behind: bool) -> RecoveryDecision | None:
        """Test equation 5, and keep the networks that made the batch when they are the best.

        These are the present ones, or those before the last update when the batch is behind.
        ``None`` where recovery is off.
        """
        if self.recovery.rule == "off":
            return None
        draw = float(torch.rand((), generator=self.generators["recovery"]))
        decision = self.recovery.judge(batch.episode_returns.tolist(), draw)
        present = self._capture()
        if decision.improved:
            made_it = self._before if is_behind and self._before is not None else present
            version = int(batch.weights_version.max())
            self.best = made_it._replace(weights_version=version)
        self._before = present
        return decision

    def recover(self, *, networks_only: bool = False) -> None:
        """Go back to the best networks, and with them to their optimisers and observations.

        The scale of returns always goes with the networks: it is the unit of their outputs.
        """
        assert self.best is not None, "there is an r* but no networks that reached it"
        self._restore(self.best, networks_only=networks_only)
        self.learning_rate.after_recovery()

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Everything that `load` needs to go on to the bit: tensors, and numbers for JSON."""
        present = self._capture()
        windows = [present.window] + ([] if self.best is None else [self.best.window])
        tensors = present.tensors | window_tensors(*windows)
        for name, generator in self.generators.items():
            tensors[f"generator.{name}"] = generator.get_state()
        best = None
        if self.best is not None:
            tensors |= {_BEST + name: tensor for name, tensor in self.best.tensors.items()}
            best = _numbers(self.best)
        scalars = {
            "present": _numbers(present),
            "best": best,
            "step_size": self.learning_rate.state(),
            "recovery": self.recovery.state(),
            "updates": self.updates,
            "q_trusted": self.q_trusted,
        }
        return tensors, scalars

    def load(self, tensors: dict[str, Tensor], scalars: dict[str, Any]) -> None:
        """Go back to a state of an object made with the same sizes and hyperparameters.

        Raises:
            A2SError: A tensor is missing or has another shape.
        """
        expected, _ = self.state()
        fixed = {k: v for k, v in expected.items() if not k.startswith(_BEST)}
        check_tensors(tensors, {k: v for k, v in fixed.items() if not is_of_window(k)})
        self.best = None
        if scalars["best"] is not None:
            stored = {
                name.removeprefix(_BEST): tensor.clone()
                for name, tensor in tensors.items()
                if name.startswith(_BEST)
            }
            check_tensors(stored, self._capture().tensors)
            self.best = _snapshot(stored, tensors, scalars["best"])
        self._restore(_snapshot(tensors, tensors, scalars["present"]))
        for name, generator in self.generators.items():
            generator.set_state(tensors[f"generator.{name}"])
        self.learning_rate.load(scalars["step_size"])
        self.recovery.load(scalars["recovery"])
        self.updates = scalars["updates"]
        self.q_trusted = scalars["q_trusted"]

    def begin_with(
        self, tensors: dict[str, Tensor], scalars: dict[str, Any], taken: Sequence[str]
    ) -> None:
        """Take ``policy``, ``value``, ``q`` or ``normaliser`` of another run's `state`.

        With V or Q goes the scale of returns, which is the unit of both, and with Q what it is
        worth.
        """
        present = scalars["present"]
        for name in self._flat.keys() & set(taken):
            self._flat[name].copy_(tensors[name])
        if "normaliser" in taken:
            for name, buffer in self.normaliser.named_buffers():
                buffer.copy_(tensors[f"normaliser.{name}"])
        if "value" in taken or "q" in taken:
            self.returns.load(present["returns"])
        if "q" in taken:
            self.q_trusted = scalars["q_trusted"]
            self.calibration = Calibration(**present["calibration"])
            self.act_inverse_temperature = present["act_inverse_temperature"]

    def _capture(self) -> Snapshot:
        tensors = {name: flat.clone() for name, flat in self._flat.items()}
        for name, buffer in self.normaliser.named_buffers():
            tensors[f"normaliser.{name}"] = buffer.clone()
        for name, adam in self.adam.items():
            tensors |= {f"adam.{name}.{key}": each.clone() for key, each in adam.tensors().items()}
        return Snapshot(
            tensors,
            self.returns.state(),
            self.calibration.state(),
            self.act_inverse_temperature,
            self.window.kept,
            weights_version=0,
        )

    def _restore(self, snapshot: Snapshot, *, networks_only: bool = False) -> None:
        stored = snapshot.tensors
        for name, flat in self._flat.items():
            flat.copy_(stored[name])
        self.returns.load(snapshot.returns)
        self.calibration = Calibration(**snapshot.calibration)
        self.act_inverse_temperature = snapshot.act_inverse_temperature
        self.window.kept = snapshot.window
        if networks_only:
            return
        for name, buffer in self.normaliser.named_buffers():
            buffer.copy_(stored[f"normaliser.{name}"])
        for name, adam in self.adam.items():
            for key, tensor in adam.tensors().items():
                tensor.copy_(stored[f"adam.{name}.{key}"])


def make_policy(
    obs_size: int, action_size: int, config: AnyOnPolicyConfig, generator: torch.Generator
) -> Policy:
    """An untrained policy."""
    return Policy(
        (obs_size, *config.policy_sizes, action_size),
        layer_norm=config.layer_norm,
        init=config.init,
        std=config.std,
        learns_std=config.learn_std,
        generator=generator,
    )


def make_critic(
    inputs: int, hidden: tuple[int, ...], config: AnyOnPolicyConfig, generator: torch.Generator
) -> Ensemble:
    """An untrained Q or V, ``[N, in]`` to ``[N, 1]``, in normalised returns."""
    form = Form((inputs, *hidden, 1), activation="tanh", layer_norm=config.layer_norm)
    return Ensemble(form, form.draw(1, generator, init=config.init), single=True)


def make_q(inputs: int, hidden: tuple[int, ...], generator: torch.Generator) -> Ensemble:
    """Two untrained categorical Q, ``[N, in]`` to ``[2, N, BINS]``.

    They are smooth in the action, which relu is not: measured, docs/adr/0021.
    """
    form = Form((inputs, *hidden, categorical.BINS), activation="silu", layer_norm=True)
    q_net = Ensemble(form, form.draw(2, generator))
    q_net.exact.weight[-1].mul_(0.1)
    q_net.exact.bias[-1].zero_()
    return q_net


def _numbers(snapshot: Snapshot) -> dict[str, Any]:
    """Fit for JSON: all of it but the tensors."""
    return {
        "returns": snapshot.returns,
        "calibration": snapshot.calibration,
        "act_inverse_temperature": snapshot.act_inverse_temperature,
        "window": [number for number, _ in snapshot.window],
        "weights_version": snapshot.weights_version,
    }


def _snapshot(
    networks: dict[str, Tensor], tensors: dict[str, Tensor], numbers: dict[str, Any]
) -> Snapshot:
    """Undo `_numbers`; windows are among ``tensors``."""
    window = stored_window(tensors, numbers["window"])
    return Snapshot(networks, **numbers | {"window": window})
