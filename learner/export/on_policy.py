"""An on-policy suggester as an ONNX graph, written node by node.

Contract of the graph, float32 throughout, ``B`` free, ``K`` and ``A`` fixed::

    obs     [B, D]        ->  action      [B, A]   in the environment's units, within its bounds
    normal  [B, K, A]         suggestion  [B, A]   canonical, before clipping
    gumbel  [B, K]            log_prob    [B]      of the suggestion as executed
    (soft selection only)     q_spread    [B]      largest score less the mean, in returns
"""

import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from a2s.learner.export.graph import Nodes, Numbers, common_numbers, constant, fill, own_metadata
from a2s.learner.networks.body import Body
from a2s.learner.networks.layer_norm import LAYER_NORM_EPS
from a2s.learner.on_policy.acting import SPREAD_EPS, Suggester


class _Form(NamedTuple):
    """All that decides which nodes there are."""

    obs_size: int
    action_size: int
    suggestions: int
    mode: str
    clips: bool
    normalises: bool
    layer_norm: bool
    policy_layers: int
    q_layers: int


def export(suggester: Suggester, weights_version: int, metadata: Mapping[str, str]) -> bytes:
    """Write a suggester with its present weights as one self-contained ONNX file.

    Args:
        suggester: What to write; any of its modes.
        weights_version: Goes into the file's metadata.
        metadata: Further entries, such as ``env``. The file's own entries (``contract``,
            ``weights_version``, ``K``, ``mode``, ``obs_size``, ``action_size``, ``action_low``,
            ``action_high``) take precedence.

    Returns:
        The serialised model.
    """
    form = _form(suggester)
    own = own_metadata(suggester, form.obs_size, weights_version)
    return fill(_template(form), _numbers(suggester, form), {**metadata, **own})


def _form(suggester: Suggester) -> _Form:
    q_net, body = suggester.q_net, suggester.policy.body
    return _Form(
        obs_size=body.weight[0].shape[0],
        action_size=len(suggester.action_low),
        suggestions=suggester.suggestions,
        mode=suggester.mode,
        clips=suggester.action_mode == "clip",
        normalises=suggester.normaliser.enabled,
        layer_norm=body.layer_norm,
        policy_layers=len(body.weight),
        q_layers=len(q_net.body.weight) if q_net else 0,
    )


def _numbers(suggester: Suggester, form: _Form) -> Numbers:
    """The initialisers: everything that differs from one version to the next, and constants."""
    low, high = suggester.action_low.numpy(), suggester.action_high.numpy()
    log_std = suggester.policy.log_std.detach()
    log_norm = float(log_std.sum()) + 0.5 * math.log(2 * math.pi) * form.action_size
    numbers: Numbers = {
        **common_numbers(low, high, suggester.normaliser),
        "std": log_std.exp().numpy(),
        "log_norm": constant([log_norm]),
        "minus_half": constant([-0.5]),
        **_body_numbers("policy", suggester.policy.body),
    }
    if suggester.q_net is None:
        return numbers | {"zero": constant([0.0])}
    numbers["axis_2"] = np.array([2], np.int64)
    numbers |= _body_numbers("q0", suggester.q_net.body)
    first = numbers.pop("q0.weight.0")
    numbers["q0.weight.obs"] = first[: form.obs_size]
    numbers["q0.weight.action"] = first[form.obs_size :]
    one = constant(1.0)
    numbers |= {"q_scale": constant([suggester.q_scale])}
    numbers |= {"minus_one": -one, "plus_one": one} if form.clips else {}
    if form.mode == "soft":
        numbers["temperature"] = constant([suggester.temperature])
        numbers["spread_eps"] = constant([SPREAD_EPS])
        numbers["log_k"] = constant([math.log(form.suggestions)])
    return numbers


def _body_numbers(name: str, body: Body) -> Numbers:
    parts = {"weight": body.weight, "bias": body.bias, "gain": body.gain, "offset": body.offset}
    return {
        f"{name}.{part}.{index}": tensor.detach().numpy()
        for part, tensors in parts.items()
        for index, tensor in enumerate(tensors)
    }


class _Suggester:
    """The nodes of one form."""

    def __init__(self, form: _Form) -> None:
        self.form = form
        self.nodes = Nodes()
        self.add = self.nodes.add

    def hidden(self, name: str, layer: int, x: str) -> str:
        """Layer normalisation and tanh on the sums of a layer."""
        if self.form.layer_norm:
            scale = (f"{name}.gain.{layer}", f"{name}.offset.{layer}")
            x = self.add("LayerNormalization", x, *scale, axis=-1, epsilon=LAYER_NORM_EPS)
        return self.add("Tanh", x)

    def policy(self, seen: str) -> str:
        x = self.add("Gemm", seen, "policy.weight.0", "policy.bias.0")
        for layer in range(1, self.form.policy_layers):
            x = self.hidden("policy", layer - 1, x)
            x = self.add("Gemm", x, f"policy.weight.{layer}", f"policy.bias.{layer}")
        return x

    def scores(self, seen: str, action: str) -> str:
        """Q, ``[B, K]``; the observation's part of the first layer once for all K."""
        if self.form.clips:
            action = self.add("Clip", action, "minus_one", "plus_one")
        part = self.add("Gemm", seen, "q0.weight.obs", "q0.bias.0")
        x = self.add("MatMul", action, "q0.weight.action")
        x = self.add("Add", x, self.add("Unsqueeze", part, "axis_1"))
        for layer in range(1, self.form.q_layers):
            x = self.add("MatMul", self.hidden("q0", layer - 1, x), f"q0.weight.{layer}")
            x = self.add("Add", x, f"q0.bias.{layer}")
        return self.add("Squeeze", x, "axis_2")

    def select(self, score: str) -> str:
        """Index of the chosen suggestion, ``[B, 1]``; writes ``q_spread`` and ``preference``."""
        centred = self.nodes.spread(score, "q_scale")
        if self.form.mode == "hard":
            return self.add("ArgMax", score, axis=1, keepdims=1)
        variance = self.add("ReduceMean", self.add("Mul", centred, centred), "axis_1", keepdims=1)
        spread = self.add("Mul", self.add("Sqrt", variance), "temperature")
        logit = self.add("Div", centred, self.add("Add", spread, "spread_eps"))
        index = self.add("ArgMax", self.add("Add", logit, "gumbel"), axis=1, keepdims=1)
        chosen = self.add("Squeeze", self.add("GatherElements", logit, index, axis=1), "axis_1")
        chance = self.add("Sub", chosen, self.add("ReduceLogSumExp", logit, "axis_1", keepdims=0))
        self.add("Add", chance, "log_k", to="preference")
        return index

    def answer(self, mean: str, noise: str) -> None:
        """The outputs that follow from the noise of the chosen suggestion, ``[B, A]``."""
        self.add("Add", mean, self.add("Mul", noise, "std"), to="suggestion")
        square = self.add("ReduceSum", self.add("Mul", noise, noise), "axis_1", keepdims=0)
        exponent = self.add("Mul", square, "minus_half")
        if self.form.mode == "soft":
            exponent = self.add("Add", exponent, "preference")
        self.add("Sub", exponent, "log_norm", to="log_prob")
        self.nodes.to_env()


@functools.lru_cache(maxsize=32)
def _template(form: _Form) -> Any:
    """The model without its numbers."""
    graph = _Suggester(form)
    seen = graph.nodes.observation(normalises=form.normalises)
    mean = graph.policy(seen)
    if form.mode == "first":
        noise = graph.add("Squeeze", "normal", "axis_1")
        graph.add("Mul", graph.add("ReduceSum", noise, "axis_1", keepdims=0), "zero", to="q_spread")
    else:
        spread = graph.add("Mul", "normal", "std")
        candidates = graph.add("Add", spread, graph.add("Unsqueeze", mean, "axis_1"))
        index = graph.select(graph.scores(seen, candidates))
        noise = graph.add("GatherND", "normal", index, batch_dims=1)
    graph.answer(mean, noise)
    return graph.nodes.template(
        form.obs_size, form.suggestions, form.action_size, gumbel=form.mode == "soft"
    )
