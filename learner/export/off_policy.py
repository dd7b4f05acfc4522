"""An off-policy suggester as an ONNX graph, written node by node; contract in ``graph.py``.

``suggestion`` is the canonical action itself, within -1..1, and ``log_prob`` its density there.
"""

import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from a2s.learner.export.graph import Nodes, as_array, common_numbers, fill, own_metadata
from a2s.learner.export.network import add_critic, add_network, critic_numbers, network_numbers
from a2s.learner.networks.form import Form
from a2s.learner.networks.gaussian import HALF_LOG_2PI
from a2s.learner.off_policy.acting import OffPolicySuggester
from a2s.learner.off_policy.squashed import LOG_STD_LEAST, LOG_STD_MOST


class _Kind(NamedTuple):
    """Everything that determines the nodes."""

    policy: Form
    critic: Form
    critics: int
    suggestions: int
    mode: str
    normalises: bool


def export(
    suggester: OffPolicySuggester, weights_version: int, metadata: Mapping[str, str]
) -> bytes:
    """Write a suggester with its present weights as one self-contained ONNX file, as on-policy."""
    policy, critics = suggester.policy, suggester.critics
    kind = _Kind(
        policy=policy.form,
        critic=critics.form,
        critics=critics.members,
        suggestions=suggester.suggestions,
        mode=suggester.mode,
        normalises=suggester.normaliser.enabled,
    )
    numbers = common_numbers(suggester.bounds, suggester.normaliser)
    if kind.mode != "uniform":
        numbers |= network_numbers("policy", policy)
    if kind.mode in ("hard", "soft"):
        for member in range(critics.members):
            size = len(suggester.bounds.low)
            numbers |= critic_numbers(f"q{member}", critics, size, member)
        numbers["return_size"] = as_array(suggester.return_size)
        numbers["temperature"] = as_array(suggester.temperature)
    own = own_metadata(suggester, kind.policy.sizes[0], weights_version)
    return fill(_template(kind), numbers, {**metadata, **own})


@functools.lru_cache(maxsize=32)
def _template(kind: _Kind) -> Any:
    """The model without its numbers."""
    nodes = Nodes()
    obs_size, action_size = kind.policy.sizes[0], kind.policy.sizes[-1] // 2
    if kind.mode == "uniform":
        _add_uniform(nodes, action_size)
    else:
        _add_policy(nodes, kind, action_size)
    nodes.to_env()
    return nodes.template(obs_size, kind.suggestions, action_size, gumbel=kind.mode == "soft")


def _add_uniform(nodes: Nodes, action_size: int) -> None:
    """Write all outputs without a policy: the error function makes normal noise uniform."""
    noise = nodes.add("Squeeze", "normal", nodes.axis(1))
    nodes.add("Erf", nodes.add("Mul", noise, nodes.constant(math.sqrt(0.5))), to="suggestion")
    density = nodes.constant(-math.log(2.0) * action_size)
    nodes.add("Add", nodes.zero_spread(noise), density, to="log_prob")


def _add_policy(nodes: Nodes, kind: _Kind, action_size: int) -> None:
    """Write all outputs from a policy."""
    add, axis = nodes.add, nodes.axis(1)
    seen = nodes.observation(normalises=kind.normalises)
    output = add_network(nodes, "policy", kind.policy.layers, seen, rows=True)
    mean, raw = (add("Unsqueeze", half, axis) for half in nodes.halves(output))
    log_std = add("Clip", raw, nodes.constant(LOG_STD_LEAST), nodes.constant(LOG_STD_MOST))
    u = add("Add", add("Mul", "normal", add("Exp", log_std)), mean)
    density = _log_density(nodes, u, log_std, action_size)
    if kind.mode == "first":
        u = add("Squeeze", u, axis)
        add("Squeeze", density, axis, to="log_prob")
        nodes.zero_spread(u)
    else:
        score = _score(nodes, kind, seen, add("Tanh", u))
        add("Identity", nodes.centre(score)[1], to="q_spread")
        if kind.mode == "soft":
            score, density = _soften(nodes, score, density, kind.suggestions)
        index = add("ArgMax", score, axis=1, keepdims=1)
        u = add("GatherND", u, index, batch_dims=1)
        add("GatherND", density, index, batch_dims=1, to="log_prob")
    # The runtime's tanh goes beyond 1 by one unit of the last place.
    limits = nodes.constant(-1.0), nodes.constant(1.0)
    add("Clip", add("Tanh", u), *limits, to="suggestion")


def _log_density(nodes: Nodes, u: str, log_std: str, action_size: int) -> str:
    """`log_density` of ``tanh(u)``, ``[B, K]``."""
    add, constant = nodes.add, nodes.constant
    softplus = add("Softplus", add("Mul", u, constant(-2.0)))
    slope = add("Mul", add("Add", u, softplus), constant(2.0))
    exponent = add("Mul", add("Mul", "normal", "normal"), constant(-0.5))
    each = add("Add", add("Sub", exponent, log_std), slope)
    total = add("ReduceSum", each, nodes.axis(2), keepdims=0)
    return add("Sub", total, constant(action_size * (HALF_LOG_2PI + 2.0 * math.log(2.0))))


def _score(nodes: Nodes, kind: _Kind, seen: str, action: str) -> str:
    """Means of the critics ``[B, K]``, in returns."""
    found = [add_critic(nodes, f"q{m}", kind.critic, seen, action) for m in range(kind.critics)]
    if kind.critic.sizes[-1] > 1:
        found = [nodes.add("ReduceMean", x, nodes.axis(2), keepdims=1) for x in found]
    every = nodes.add("Mul", nodes.add("Concat", *found, axis=2), "return_size")
    return nodes.add("ReduceMean", every, nodes.axis(2), keepdims=0)


def _soften(nodes: Nodes, score: str, density: str, suggestions: int) -> tuple[str, str]:
    """What is largest at the drawn suggestion, and the densities as executed, ``[B, K]`` each."""
    add, axis = nodes.add, nodes.axis(1)
    is_drawn = add("Sign", add("ReduceSumSquare", "gumbel", axis, keepdims=1))
    correction = add("Mul", density, is_drawn)
    logit = add("Sub", add("Div", score, "temperature"), correction)
    whole = add("ReduceLogSumExp", logit, axis, keepdims=1)
    preference = add("Add", add("Sub", logit, whole), nodes.constant(math.log(suggestions)))
    return add("Add", logit, "gumbel"), add("Add", density, preference)
