"""An off-policy suggester as an ONNX graph: the contract of ``export.py``.

``suggestion`` is the canonical action itself, within -1..1, and ``log_prob`` its density there.
"""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from a2s.learner.export.graph import (
    Nodes,
    Numbers,
    as_array,
    common_numbers,
    constant,
    fill,
    own_metadata,
)
from a2s.learner.networks.ensemble import Ensemble, Form
from a2s.learner.networks.layer_norm import LAYER_NORM_EPS
from a2s.learner.networks.layers import Layer, Linear, Norm, Relu, Residual
from a2s.learner.off_policy.acting import OffPolicySuggester
from a2s.learner.off_policy.config import Network
from a2s.learner.off_policy.squashed import LOG_NORM, LOG_STD_LEAST, LOG_STD_MOST


class _Kind(NamedTuple):
    """All that decides which nodes there are."""

    policy_sizes: tuple[int, ...]
    critic_sizes: tuple[int, ...]
    critics: int
    network: Network
    layer_norm: bool
    suggestions: int
    mode: str
    normalises: bool


def export(
    suggester: OffPolicySuggester, weights_version: int, metadata: Mapping[str, str]
) -> bytes:
    """Write a suggester with its present weights as one self-contained ONNX file.

    Args:
        suggester: What to write; any of its modes.
        weights_version: Goes into the file's metadata.
        metadata: Further entries; those of the file itself take precedence, as in ``export.py``.
    """
    policy, critics = suggester.policy.form, suggester.critics.form
    kind = _Kind(
        policy_sizes=policy.sizes,
        critic_sizes=critics.sizes,
        critics=suggester.critics.members,
        network=policy.network,
        layer_norm=policy.layer_norm,
        suggestions=suggester.suggestions,
        mode=suggester.mode,
        normalises=suggester.normaliser.enabled,
    )
    own = own_metadata(suggester, policy.sizes[0], weights_version)
    return fill(_template(kind), _numbers(suggester), {**metadata, **own})


def _numbers(suggester: OffPolicySuggester) -> Numbers:
    low, high = as_array(suggester.action_low), as_array(suggester.action_high)
    numbers = common_numbers(low, high, suggester.normaliser)
    if suggester.mode == "uniform":
        density = -math.log(2.0) * len(low)
        return numbers | {
            "root_half": constant(math.sqrt(0.5)),
            "zero": constant([0.0]),
            "uniform_density": constant([density]),
        }
    numbers |= _network_numbers("policy", suggester.policy, 0)
    numbers |= {
        "log_std_least": constant(LOG_STD_LEAST),
        "log_std_most": constant(LOG_STD_MOST),
        "minus_half": constant(-0.5),
        "minus_two": constant(-2.0),
        "two": constant(2.0),
        "minus_one": constant(-1.0),
        "plus_one": constant(1.0),
        "log_norm": constant([len(low) * LOG_NORM]),
        "axis_2": np.array([2], np.int64),
    }
    if suggester.mode == "first":
        return numbers | {"zero": constant([0.0])}
    for member in range(suggester.critics.members):
        name = f"q{member}"
        numbers |= _network_numbers(name, suggester.critics, member)
        first = numbers.pop(f"{name}.{suggester.critics.form.first.weight}")
        split = len(first) - len(low)
        numbers |= {f"{name}.obs": first[:split], f"{name}.action": first[split:]}
    if suggester.mode == "soft":
        numbers["temperature"] = as_array(suggester.temperature)
        numbers["log_k"] = constant([math.log(suggester.suggestions)])
    return numbers | {"return_size": as_array(suggester.return_size)}


def _network_numbers(name: str, ensemble: Ensemble, member: int) -> Numbers:
    """Parameters by number; vectors without their row."""
    arrays = [as_array(view[member]) for view in ensemble.weights.full]
    matrices = _matrices(ensemble.form)
    return {
        f"{name}.{index}": array if index in matrices else array[0]
        for index, array in enumerate(arrays)
    }


def _matrices(form: Form) -> set[int]:
    return set(range(0, len(form.shapes), 2)) - form.gains


class _Suggester:
    """The nodes of one kind."""

    def __init__(self, kind: _Kind) -> None:
        self.kind = kind
        self.nodes = Nodes()
        self.add = self.nodes.add

    def network(self, name: str, layers: Sequence[Layer], x: str) -> str:
        """Layers on rows of any number of dimensions."""
        for layer in layers:
            match layer:
                case Linear():
                    x = self.add("MatMul", x, f"{name}.{layer.weight}")
                    x = self.add("Add", x, f"{name}.{layer.bias}")
                case Norm():
                    scale = (f"{name}.{layer.gain}", f"{name}.{layer.offset}")
                    x = self.add("LayerNormalization", x, *scale, axis=-1, epsilon=LAYER_NORM_EPS)
                    x = self.add("Relu", x) if layer.relu else x
                case Relu():
                    x = self.add("Relu", x)
                case Residual():
                    x = self.add("Add", x, self.network(name, layer.inner, x))
                case _:
                    raise TypeError(f"layer {type(layer).__name__}: found no nodes for it")
        return x

    def critic(self, name: str, seen: str, action: str) -> str:
        """Values ``[B, K, 1]``; the observation's part of the first layer once for all K."""
        kind = self.kind
        late = kind.policy_sizes[-1] // 2
        form = Form(kind.critic_sizes, network=kind.network, layer_norm=kind.layer_norm, late=late)
        seen = self.network(name, form.trunk, seen)
        part = self.add("Gemm", seen, f"{name}.obs", f"{name}.{form.first.bias}")
        x = self.add("MatMul", action, f"{name}.action")
        x = self.add("Add", x, self.add("Unsqueeze", part, "axis_1"))
        atoms = self.network(name, form.layers[1:], x)
        if kind.critic_sizes[-1] == 1:
            return atoms
        return self.add("ReduceMean", atoms, "axis_2", keepdims=1)

    def score(self, seen: str, action: str) -> str:
        """Scores ``[B, K]``, in returns."""
        found = [self.critic(f"q{m}", seen, action) for m in range(self.kind.critics)]
        every = self.add("Mul", self.add("Concat", *found, axis=2), "return_size")
        mean = self.add("ReduceMean", every, "axis_2", keepdims=1)
        return self.add("Squeeze", mean, "axis_2")

    def suggest(self) -> None:
        """All outputs from a policy."""
        kind = self.kind
        seen = self.nodes.observation(normalises=kind.normalises)
        form = Form(kind.policy_sizes, network=kind.network, layer_norm=kind.layer_norm)
        output = self.network("policy", form.layers, seen)
        mean, raw = self.nodes.halves(output)
        log_std = self.add("Clip", raw, "log_std_least", "log_std_most")
        mean, log_std = (self.add("Unsqueeze", x, "axis_1") for x in (mean, log_std))
        u = self.add("Add", self.add("Mul", "normal", self.add("Exp", log_std)), mean)
        density = self.density(u, log_std)
        if kind.mode == "first":
            u = self.add("Squeeze", u, "axis_1")
            self.add("Squeeze", density, "axis_1", to="log_prob")
            self.zero_spread(u)
        else:
            score = self.score(seen, self.add("Tanh", u))
            self.nodes.spread(score)
            if kind.mode == "soft":
                score, density = self.soften(score, density)
            index = self.add("ArgMax", score, axis=1, keepdims=1)
            u = self.add("GatherND", u, index, batch_dims=1)
            self.add("GatherND", density, index, batch_dims=1, to="log_prob")
        # The runtime's tanh goes beyond 1 by one unit of the last place.
        self.add("Clip", self.add("Tanh", u), "minus_one", "plus_one", to="suggestion")

    def soften(self, score: str, density: str) -> tuple[str, str]:
        """What is largest at the suggestion drawn, and densities as executed, ``[B, K]``."""
        square = self.add("ReduceSumSquare", "gumbel", "axis_1", keepdims=1)
        correction = self.add("Mul", density, self.add("Sign", square))
        logit = self.add("Sub", self.add("Div", score, "temperature"), correction)
        whole = self.add("ReduceLogSumExp", logit, "axis_1", keepdims=1)
        preference = self.add("Add", self.add("Sub", logit, whole), "log_k")
        return self.add("Add", logit, "gumbel"), self.add("Add", density, preference)

    def density(self, u: str, log_std: str) -> str:
        """Log densities ``[B, K]``: the Gaussian's less the logarithm of the slope of tanh."""
        softplus = self.add("Softplus", self.add("Mul", u, "minus_two"))
        slope = self.add("Mul", self.add("Add", u, softplus), "two")
        exponent = self.add("Mul", self.add("Mul", "normal", "normal"), "minus_half")
        each = self.add("Add", self.add("Sub", exponent, log_std), slope)
        total = self.add("ReduceSum", each, "axis_2", keepdims=0)
        return self.add("Sub", total, "log_norm")

    def uniform(self) -> None:
        """All outputs without a policy: the error function makes normal noise uniform."""
        noise = self.add("Squeeze", "normal", "axis_1")
        self.add("Erf", self.add("Mul", noise, "root_half"), to="suggestion")
        nothing = self.zero_spread(noise)
        self.add("Add", nothing, "uniform_density", to="log_prob")

    def zero_spread(self, noise: str) -> str:
        """Write a ``q_spread`` of 0."""
        total = self.add("ReduceSum", noise, "axis_1", keepdims=0)
        return self.add("Mul", total, "zero", to="q_spread")


@functools.lru_cache(maxsize=32)
def _template(kind: _Kind) -> Any:
    """The model without its numbers."""
    graph = _Suggester(kind)
    if kind.mode == "uniform":
        graph.uniform()
    else:
        graph.suggest()
    graph.nodes.to_env()
    action_size = kind.policy_sizes[-1] // 2
    return graph.nodes.template(
        kind.policy_sizes[0], kind.suggestions, action_size, gumbel=kind.mode == "soft"
    )
