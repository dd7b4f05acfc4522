"""Building ONNX graphs node by node: what the suggesters of both variants share.

Contract of a graph, float32 throughout, ``B`` free, ``K`` and ``A`` fixed::

    obs     [B, D]        ->  action      [B, A]   in the environment's units, within its bounds
    normal  [B, K, A]         suggestion  [B, A]   canonical, before clipping
    gumbel  [B, K]            log_prob    [B]      of the suggestion as executed
    (soft selection only)     q_spread    [B]      largest score less the mean, in returns

The nodes of a graph depend only on options and are made once (a template); each weights version
fills in the numbers. That takes about a millisecond, where tracing takes seconds.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor

from a2s.learner.networks.acting import ActionBounds
from a2s.learner.networks.normaliser import OBS_LIMIT, Normaliser
from a2s.learner.off_policy.acting import OffPolicySuggester
from a2s.learner.on_policy.acting import Suggester
from a2s.protocol.fields import Array

CONTRACT = "a2s-suggester-1"
OPSET = 18
IR_VERSION = 9

Numbers = dict[str, Array]


class Nodes:
    """A list of nodes that gives every result a name, and the constants that they read."""

    def __init__(self) -> None:
        self.made: list[Any] = []
        self._constants: Numbers = {}

    def add(self, kind: str, *inputs: str, to: str = "", **attributes: object) -> str:
        """Append a node; returns the name of its result."""
        output = to or f"n{len(self.made)}"
        self.made.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def constant(self, value: float) -> str:
        """Name of a number."""
        self._constants[f"{value}"] = np.array(value, np.float32)
        return f"{value}"

    def column(self, values: Sequence[float]) -> str:
        """Name of a column of numbers, ``[n, 1]``."""
        self._constants["column"] = np.array(values, np.float32).reshape(-1, 1)
        return "column"

    def axis(self, number: int) -> str:
        """Name of the number of a dimension."""
        self._constants[f"axis_{number}"] = np.array([number], np.int64)
        return f"axis_{number}"

    def halves(self, x: str) -> list[str]:
        """The first and the second half of the last dimension."""
        outputs = [f"n{len(self.made)}.{half}" for half in (0, 1)]
        self.made.append(helper.make_node("Split", [x], outputs, axis=-1, num_outputs=2))
        return outputs

    def observation(self, *, normalises: bool) -> str:
        """The normalised observation."""
        if not normalises:
            return "obs"
        scaled = self.add("Mul", self.add("Sub", "obs", "obs_mean"), "obs_factor")
        return self.add("Clip", scaled, self.constant(-OBS_LIMIT), self.constant(OBS_LIMIT))

    def centre(self, score: str) -> tuple[str, str]:
        """Scores ``[B, K]`` less their mean, and the largest of these, ``[B]``."""
        mean = self.add("ReduceMean", score, self.axis(1), keepdims=1)
        centred = self.add("Sub", score, mean)
        return centred, self.add("ReduceMax", centred, self.axis(1), keepdims=0)

    def zero_spread(self, noise: str) -> str:
        """Write a ``q_spread`` of 0, given anything ``[B, A]``."""
        total = self.add("ReduceSum", noise, self.axis(1), keepdims=0)
        return self.add("Mul", total, self.constant(0.0), to="q_spread")

    def to_env(self) -> None:
        """Write ``action`` from ``suggestion``, as `ActionBounds.to_env` does."""
        wide = self.add("Add", self.add("Mul", "suggestion", "half_range"), "centre")
        self.add("Min", self.add("Max", wide, "low"), "high", to="action")

    def template(self, obs_size: int, suggestions: int, action_size: int, *, gumbel: bool) -> Any:
        """The model of the contract, without the numbers that change."""
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
            [numpy_helper.from_array(array, name) for name, array in self._constants.items()],
        )
        return helper.make_model(
            graph,
            producer_name="a2s",
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
        )


def common_numbers(bounds: ActionBounds, normaliser: Normaliser) -> Numbers:
    """The numbers that `Nodes.observation` and `Nodes.to_env` read."""
    numbers = {
        "half_range": as_array(bounds.half_range),
        "centre": as_array(bounds.centre),
        "low": as_array(bounds.low),
        "high": as_array(bounds.high),
    }
    if normaliser.enabled:
        mean, factor = normaliser.constants()
        numbers |= {"obs_mean": as_array(mean), "obs_factor": as_array(factor)}
    return numbers


def own_metadata(
    suggester: Suggester | OffPolicySuggester, obs_size: int, weights_version: int
) -> dict[str, str]:
    """The file's own entries, as docs/protocol.md lists them."""
    bounds = suggester.bounds
    return {
        "contract": CONTRACT,
        "weights_version": str(weights_version),
        "K": str(suggester.suggestions),
        "mode": suggester.mode,
        "obs_size": str(obs_size),
        "action_size": str(len(bounds.low)),
        "action_low": str(bounds.low.tolist()),
        "action_high": str(bounds.high.tolist()),
    }


def fill(template: Any, numbers: Numbers, metadata: Mapping[str, str]) -> bytes:
    """Put the numbers that are read, and metadata, into a template, and serialise it."""
    model = onnx.ModelProto()
    model.CopyFrom(template)
    read = {name for node in template.graph.node for name in node.input}
    for name, array in numbers.items():
        if name in read:
            model.graph.initializer.append(
                TensorProto(
                    name=name,
                    dims=array.shape,
                    data_type=TensorProto.FLOAT,
                    raw_data=array.tobytes(),
                )
            )
    for key, value in metadata.items():
        model.metadata_props.add(key=key, value=value)
    data: bytes = model.SerializeToString()
    return data


def as_array(tensor: Tensor) -> Array:
    """A tensor's numbers, from any device."""
    array: Array = tensor.cpu().numpy()
    return array
