"""What no learner writes is refused before ONNX Runtime sees it, in one line."""

import re
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import onnx
import pytest
from doc_pages import ROOT
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from a2s.actors.graph_check import MAX_NODES, OPERATORS, check_graph
from a2s.actors.suggester import Suggester
from a2s.protocol.errors import MalformedMessageError

MakeGraph = Callable[..., bytes]
ONES = numpy_helper.from_array(np.ones((2, 2), np.float32), "ones")
OUTPUTS = ("action", "suggestion", "log_prob", "q_spread")


def _graph(*nodes: Any, numbers: tuple[Any, ...] = (ONES,), normal: int = 1) -> Any:
    """A model that looks like a policy, with some nodes more, the last of which is ``last``."""
    float32 = TensorProto.FLOAT
    inputs = {"obs": ["B", 2], "normal": ["B", normal, 1]}
    copies = [helper.make_node("Identity", ["last"], [name]) for name in OUTPUTS]
    return helper.make_model(
        helper.make_graph(
            [*nodes, *copies],
            "g",
            [helper.make_tensor_value_info(n, float32, s) for n, s in inputs.items()],
            [helper.make_tensor_value_info(n, float32, None) for n in OUTPUTS],
            list(numbers),
        ),
        opset_imports=[helper.make_opsetid("", 18)],
        ir_version=9,
    )


def _node(kind: str, *reads: str, **more: Any) -> Any:
    return helper.make_node(kind, list(reads), ["last"], **more)


def _elsewhere() -> Any:
    tensor = TensorProto(name="ones", dims=[2, 2], data_type=TensorProto.FLOAT, data_location=1)
    tensor.external_data.add(key="location", value="/etc/passwd")
    return tensor


def _claims(*dims: int) -> Any:
    return TensorProto(name="ones", dims=dims, data_type=TensorProto.FLOAT, raw_data=bytes(16))


def _with_function() -> Any:
    model = _graph(_node("Identity", "obs"))
    body = [helper.make_node("Identity", ["x"], ["y"])]
    model.functions.append(helper.make_function("", "Add", ["x"], ["y"], body, []))
    return model


INNER = helper.make_graph([_node("Identity", "obs")], "inner", [], [])
PLAIN = _node("Identity", "obs")
BOMBS: dict[str, tuple[Any, str]] = {
    "loop": (_graph(_node("Loop", "obs", "obs", body=INNER)), "field 6 of an attribute"),
    "if": (
        _graph(_node("If", "obs", then_branch=INNER, else_branch=INNER)),
        "field 6 of an attrib",
    ),
    "scan": (
        _graph(_node("Scan", "obs", body=INNER, num_scan_inputs=1)),
        "field 6 of an attribute",
    ),
    "loop by name": (_graph(_node("Loop", "obs", "obs")), "the operator 'Loop'"),
    "tensor in an attribute": (_graph(_node("Constant", value=ONES)), "field 5 of an attribute"),
    "another domain": (
        _graph(_node("Add", "obs", "ones", domain="evil")),
        "of [b'evil']",
    ),
    "file": (_graph(PLAIN, numbers=(_elsewhere(),)), "field 13 of a tensor"),
    "too few numbers": (_graph(PLAIN, numbers=(_claims(2**31, 2**31),)), "a tensor of type 1"),
    "function": (_with_function(), "field 25 of the model"),
    "computed when loaded": (_graph(_node("MatMul", "ones", "ones")), "a MatMul of constants"),
    "many nodes": (_graph(*[PLAIN] * MAX_NODES), f"found {MAX_NODES + 4} nodes"),
    "much noise": (_graph(PLAIN, normal=1 << 40), "found input normal of [1099511627776, 1]"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused_in_one_line(name: str) -> None:
    model, reason = BOMBS[name]
    with pytest.raises(MalformedMessageError, match=re.escape(reason)) as caught:
        Suggester(model.SerializeToString())
    assert len(str(caught.value)) < 250
    assert str(caught.value).isprintable()


def test_what_would_take_all_memory_fails(rng: np.random.Generator) -> None:
    """A matrix of 40,000 rows and columns, from two vectors."""
    column, rows = np.ones((40_000, 1), np.float32), np.ones((2, 40_000), np.float32)
    numbers = numpy_helper.from_array(column, "column"), numpy_helper.from_array(rows, "rows")
    tall = helper.make_node("Add", ["obs", "column"], ["tall"])
    graph = _graph(tall, _node("MatMul", "tall", "rows"), numbers=numbers)
    suggester = Suggester(graph.SerializeToString())
    with pytest.raises(MalformedMessageError, match=r"cannot be run .*memory") as caught:
        suggester(np.ones((1, 2), np.float32), rng)
    assert len(str(caught.value)) < 600


@settings(deadline=None, max_examples=300)
@given(places=st.lists(st.tuples(st.floats(0, 0.999), st.integers(0, 255)), max_size=5))
def test_damage_is_malformed_and_nothing_else(places: list[tuple[float, int]]) -> None:
    graph = bytearray(_graph(PLAIN).SerializeToString())
    for place, byte in places:
        graph[int(place * len(graph))] = byte
    with suppress(MalformedMessageError):
        check_graph(bytes(graph))


def test_the_page_lists_the_operators() -> None:
    """Every other actor reads them there; all are of ONNX, and hold no graphs."""
    page = (ROOT / "docs/protocol.md").read_text().split("## The graph")[1]
    listed = page.split("only Add")[1].split(", of opset 18")[0]
    assert set(re.findall(r"\w+", f"Add{listed}")) - {"and"} == OPERATORS
    for name in OPERATORS:
        attributes = onnx.defs.get_schema(name, 18).attributes.values()
        assert all("GRAPH" not in str(a.type) for a in attributes)
