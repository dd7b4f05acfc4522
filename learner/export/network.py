"""Networks as ONNX nodes, and their weights as the numbers that the nodes read."""

from collections.abc import Sequence

from a2s.learner.export.graph import Nodes, Numbers, as_array
from a2s.learner.networks import options
from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.networks.form import Form
from a2s.learner.networks.layer_norm import LAYER_NORM_EPS, Norm
from a2s.learner.networks.layers import Activation, Layer, Linear, Residual


def network_numbers(name: str, ensemble: Ensemble, member: int = 0) -> Numbers:
    """The parameters of a member, in float32."""
    weights = ensemble.exact
    parts = {
        "weight": weights.weight,
        "bias": weights.bias,
        "gain": [norm.gain for norm in weights.norms],
        "offset": [norm.offset for norm in weights.norms],
    }
    numbers: Numbers = {}
    for part, tensors in parts.items():
        for index, tensor in enumerate(tensors):
            array = as_array(tensor if ensemble.single else tensor[member])
            numbers[f"{name}.{part}.{index}"] = array if part == "weight" else array.reshape(-1)
    return numbers


def critic_numbers(name: str, ensemble: Ensemble, action_size: int, member: int = 0) -> Numbers:
    """The parameters of a member, the first layer in parts: for the observation, for the action."""
    numbers = network_numbers(name, ensemble, member)
    first = numbers.pop(f"{name}.weight.{ensemble.form.first.index}")
    return numbers | {f"{name}.obs": first[:-action_size], f"{name}.action": first[-action_size:]}


def add_network(nodes: Nodes, name: str, layers: Sequence[Layer], x: str, *, rows: bool) -> str:
    """Append layers; returns the name of the output.

    The input x has any number of dimensions; where it is ``rows``, two, a Linear is one node.
    """
    for layer in layers:
        match layer:
            case Linear() if rows:
                x = nodes.add(
                    "Gemm", x, f"{name}.weight.{layer.index}", f"{name}.bias.{layer.index}"
                )
            case Linear():
                x = nodes.add("MatMul", x, f"{name}.weight.{layer.index}")
                x = nodes.add("Add", x, f"{name}.bias.{layer.index}")
            case Norm():
                scale = (f"{name}.gain.{layer.index}", f"{name}.offset.{layer.index}")
                x = nodes.add("LayerNormalization", x, *scale, axis=-1, epsilon=LAYER_NORM_EPS)
                x = nodes.add("Relu", x) if layer.relu else x
            case Activation():
                x = _activate(nodes, layer.kind, x)
            case Residual():
                x = nodes.add("Add", x, add_network(nodes, name, layer.inner, x, rows=rows))
            case _:
                raise TypeError(f"layer {type(layer).__name__}: found no nodes for it")
    return x


def _activate(nodes: Nodes, kind: options.Activation, x: str) -> str:
    if kind == "silu":
        return nodes.add("Mul", x, nodes.add("Sigmoid", x))
    return nodes.add(kind.capitalize(), x)


def add_critic(nodes: Nodes, name: str, form: Form, obs: str, action: str) -> str:
    """Append a critic of ``[B, D]`` and ``[B, K, A]``; returns its outputs, ``[B, K, out]``.

    The observation's part of the first layer is computed once for all K.
    """
    shared = add_network(nodes, name, form.trunk, obs, rows=True)
    shared = nodes.add("Gemm", shared, f"{name}.obs", f"{name}.bias.{form.first.index}")
    x = nodes.add("MatMul", action, f"{name}.action")
    x = nodes.add("Add", x, nodes.add("Unsqueeze", shared, nodes.axis(1)))
    return add_network(nodes, name, form.layers[1:], x, rows=False)
