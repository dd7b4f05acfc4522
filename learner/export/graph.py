"""Building ONNX graphs node by node: what the suggesters of all variants share.

The nodes of a graph depend only on options and are made once (a template); each weights version
fills in the numbers. That takes about a millisecond, where tracing takes seconds.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper
from torch import Tensor

from a2s.learner.networks.networks import OBS_LIMIT, Normaliser
from a2s.learner.off_policy.acting import OffPolicySuggester
from a2s.learner.on_policy.acting import Suggester

CONTRACT = "a2s-suggester-1"
OPSET = 18
IR_VERSION = 9

Array = npt.NDArray[Any]
Numbers = dict[str, Array]


class Nodes:
    """A list of nodes that gives every result a name."""

    def __init__(self) -> None:
        self.made: list[Any] = []

    def add(self, kind: str, *inputs: str, to: str = "", **attributes: object) -> str:
        """Append a node; returns the name of its result."""
        output = to or f"n{len(self.made)}"
        self.made.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def halves(self, x: str) -> list[str]:
        """The first and the second half of the last dimension."""
        outputs = [f"n{len(self.made)}.{half}" for half in (0, 1)]
        self.made.append(helper.make_node("Split", [x], outputs, axis=-1, num_outputs=2))
        return outputs

    def observation(self, *, normalises: bool) -> str:
        """The observation as networks see it."""
        if not normalises:
            return "obs"
        scaled = self.add("Mul", self.add("Sub", "obs", "obs_mean"), "obs_factor")
        return self.add("Clip", scaled, "obs_least", "obs_most")

    def spread(self, score: str, scale: str = "") -> str:
        """Write ``q_spread``; returns scores ``[B, K]`` less their mean."""
        centred = self.add("Sub", score, self.add("ReduceMean", score, "axis_1", keepdims=1))
        to = "" if scale else "q_spread"
        widest = self.add("ReduceMax", centred, "axis_1", keepdims=0, to=to)
        if scale:
            self.add("Mul", widest, scale, to="q_spread")
        return centred

    def to_env(self) -> None:
        """Write ``action`` from ``suggestion``."""
        wide = self.add("Add", self.add("Mul", "suggestion", "half_range"), "centre")
        self.add("Min", self.add("Max", wide, "low"), "high", to="action")

    def template(self, obs_size: int, suggestions: int, action_size: int, *, gumbel: bool) -> Any:
        """The model of the contract in docs/protocol.md, without numbers."""
        inputs = {"obs": ["B", obs_size], "normal": ["B", suggestions, action_size]}
        inputs |= {"gumbel": ["B", suggestions]} if gumbel else {}
        outputs: dict[str, list[str | int]] = {
            "action": ["B", action_size],
            "suggestion": ["B", action_size],
            "log_prob": ["B"],
            "q_spread": ["B"],
        }
        graph = helper.make_graph(
            self.made,
            "suggester",
            [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in inputs.items()],
            [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in outputs.items()],
        )
        return helper.make_model(
            graph,
            producer_name="a2s",
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
        )


def common_numbers(low: Array, high: Array, normaliser: Normaliser) -> Numbers:
    """What `Nodes.observation`, `Nodes.spread` and `Nodes.to_env` need."""
    numbers: Numbers = {
        "half_range": (high - low) / 2,
        "centre": (high + low) / 2,
        "low": low,
        "high": high,
        "axis_1": np.array([1], np.int64),
    }
    if normaliser.enabled:
        mean, factor = normaliser.constants()
        limit = constant(OBS_LIMIT)
        numbers |= {"obs_mean": as_array(mean), "obs_factor": as_array(factor)}
        numbers |= {"obs_least": -limit, "obs_most": limit}
    return numbers


def own_metadata(
    suggester: Suggester | OffPolicySuggester, obs_size: int, weights_version: int
) -> dict[str, str]:
    """The file's own entries, as docs/protocol.md lists them."""
    return {
        "contract": CONTRACT,
        "weights_version": str(weights_version),
        "K": str(suggester.suggestions),
        "mode": suggester.mode,
        "obs_size": str(obs_size),
        "action_size": str(len(suggester.action_low)),
        "action_low": str(suggester.action_low.tolist()),
        "action_high": str(suggester.action_high.tolist()),
    }


def fill(template: Any, numbers: Numbers, metadata: Mapping[str, str]) -> bytes:
    """Put the numbers that are read, and metadata, into a template, and serialise it."""
    model = onnx.ModelProto()
    model.CopyFrom(template)
    read = {name for node in template.graph.node for name in node.input}
    for name, array in numbers.items():
        if name not in read:
            continue
        model.graph.initializer.append(
            TensorProto(
                name=name,
                dims=array.shape,
                data_type=TensorProto.INT64 if array.dtype == np.int64 else TensorProto.FLOAT,
                raw_data=np.ascontiguousarray(array).tobytes(),
            )
        )
    for key, value in metadata.items():
        model.metadata_props.add(key=key, value=value)
    data: bytes = model.SerializeToString()
    return data


def constant(value: float | list[float]) -> Array:
    """A number of the graph."""
    return np.array(value, np.float32)


def as_array(tensor: Tensor) -> Array:
    """A tensor's numbers, wherever it is."""
    array: Array = tensor.detach().cpu().numpy()
    return array
