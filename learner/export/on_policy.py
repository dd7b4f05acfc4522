"""An on-policy suggester as an ONNX graph, written node by node; contract in ``graph.py``."""

import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch

from a2s.learner.export.graph import Nodes, common_numbers, fill, own_metadata
from a2s.learner.export.network import add_critic, add_network, critic_numbers, network_numbers
from a2s.learner.networks.form import Form
from a2s.learner.networks.gaussian import HALF_LOG_2PI
from a2s.learner.on_policy import categorical
from a2s.learner.on_policy.acting import Suggester


class _Kind(NamedTuple):
    """Everything that determines the nodes."""

    policy: Form
    critic: Form | None
    critics: int
    suggestions: int
    mode: str
    clips: bool
    normalises: bool


def export(suggester: Suggester, weights_version: int, metadata: Mapping[str, str]) -> bytes:
    """Write a suggester with its present weights as one self-contained ONNX file.

    ``metadata`` are further entries, such as ``env``; those of `own_metadata` take precedence.
    """
    policy, q_net = suggester.policy, suggester.q_net
    kind = _Kind(
        policy=policy.network.form,
        critic=q_net.form if q_net else None,
        critics=q_net.members if q_net else 0,
        suggestions=suggester.suggestions,
        mode=suggester.mode,
        clips=suggester.action_mode == "clip",
        normalises=suggester.normaliser.enabled,
    )
    log_norm = float(policy.log_std.sum()) + HALF_LOG_2PI * len(policy.log_std)
    numbers = common_numbers(suggester.bounds, suggester.normaliser)
    numbers |= network_numbers("policy", policy.network)
    numbers |= {"std": policy.std().numpy(), "log_norm": np.array([log_norm], np.float32)}
    if q_net:
        for member in range(q_net.members):
            numbers |= critic_numbers(f"q{member}", q_net, len(policy.log_std), member)
        numbers["q_scale"] = np.array(suggester.q_scale, np.float32)
        numbers["inverse_temperature"] = np.array(suggester.inverse_temperature, np.float32)
    own = own_metadata(suggester, kind.policy.sizes[0], weights_version)
    return fill(_template(kind), numbers, {**metadata, **own})


@functools.lru_cache(maxsize=32)
def _template(kind: _Kind) -> Any:
    """The model without its numbers."""
    nodes = Nodes()
    seen = nodes.observation(normalises=kind.normalises)
    mean = add_network(nodes, "policy", kind.policy.layers, seen, rows=True)
    preference = ""
    if kind.critic is None:
        noise = nodes.add("Squeeze", "normal", nodes.axis(1))
        nodes.zero_spread(noise)
    else:
        spread = nodes.add("Mul", "normal", "std")
        action = nodes.add("Add", spread, nodes.add("Unsqueeze", mean, nodes.axis(1)))
        if kind.clips:
            action = nodes.add("Clip", action, nodes.constant(-1.0), nodes.constant(1.0))
        score = _score(nodes, kind.critic, kind.critics, seen, action)
        index, preference = _select(nodes, score, kind)
        noise = nodes.add("GatherND", "normal", index, batch_dims=1)
    nodes.add("Add", mean, nodes.add("Mul", noise, "std"), to="suggestion")
    square = nodes.add("ReduceSum", nodes.add("Mul", noise, noise), nodes.axis(1), keepdims=0)
    log_prob = nodes.add("Mul", square, nodes.constant(-0.5))
    if preference:
        log_prob = nodes.add("Add", log_prob, preference)
    nodes.add("Sub", log_prob, "log_norm", to="log_prob")
    nodes.to_env()
    gumbel = kind.mode == "soft"
    sizes = kind.policy.sizes
    return nodes.template(sizes[0], kind.suggestions, sizes[-1], gumbel=gumbel)


def _score(nodes: Nodes, critic: Form, critics: int, seen: str, action: str) -> str:
    """The score of each suggestion, ``[B, K]``, as `a2s.learner.on_policy.acting.q_scores`."""
    outputs = [add_critic(nodes, f"q{m}", critic, seen, action) for m in range(critics)]
    if critic.sizes[-1] > 1:
        values = nodes.column(categorical.centres(torch.zeros(())).tolist())
        outputs = [nodes.add("MatMul", nodes.add("Softmax", x, axis=-1), values) for x in outputs]
    total = nodes.add("Mean", *outputs) if critics > 1 else outputs[0]
    return nodes.add("Squeeze", total, nodes.axis(2))


def _select(nodes: Nodes, score: str, kind: _Kind) -> tuple[str, str]:
    """Write ``q_spread``; returns the index of the chosen suggestion, ``[B, 1]``.

    And, if the selection is soft, how much likelier it made the choice, in logs, ``[B]``.
    """
    add, axis = nodes.add, nodes.axis(1)
    centred, largest = nodes.centre(score)
    add("Mul", largest, "q_scale", to="q_spread")
    if kind.mode == "hard":
        return add("ArgMax", score, axis=1, keepdims=1), ""
    logit = add("Mul", centred, "inverse_temperature")
    index = add("ArgMax", add("Add", logit, "gumbel"), axis=1, keepdims=1)
    chosen = add("Squeeze", add("GatherElements", logit, index, axis=1), axis)
    chance = add("Sub", chosen, add("ReduceLogSumExp", logit, axis, keepdims=0))
    return index, add("Add", chance, nodes.constant(math.log(kind.suggestions)))
