"""The only use of ONNX Runtime: the published graph turns observations into actions.

The graph draws nothing itself: its caller passes the noise, and thereby chooses the mode
(docs/protocol.md, "The graph").
"""

import math
from functools import cache
from typing import Literal, NamedTuple

import numpy as np
import onnxruntime

from a2s.actors.graph_check import check_graph
from a2s.protocol.errors import MalformedMessageError, UsageError, one_line
from a2s.protocol.fields import Array, Spaces

Mode = Literal["behaviour", "mean", "best-of-k"]
_TINY = np.float32(1e-20)
_MAX_BYTES = 2 << 30  # of weights and all that is computed from them
_MAX_NOISE = 1 << 18  # numbers for an observation


class Choice(NamedTuple):
    """The graph's choice for B observations.

    Attributes:
        action: In the environment's units and bounds, float32 ``[B, A]``.
        suggestion: The chosen suggestion in canonical units before clipping, ``[B, A]``.
        log_prob: Its log density as executed, ``[B]``: see docs/protocol.md, "The graph".
        q_spread: Highest minus mean Q over the suggestions, ``[B]``.
    """

    action: Array
    suggestion: Array
    log_prob: Array
    q_spread: Array


class Suggester:
    """One version of the weights, ready to act.

    ``behaviour`` acts as in training; ``mean`` executes the policy's mean; ``best-of-k`` lets Q
    choose among the mean and K - 1 suggestions.

    Raises:
        MalformedMessageError: No learner writes such a graph, or it cannot be loaded, or lacks an
            input or output.
    """

    def __init__(self, graph: bytes, mode: Mode = "behaviour") -> None:
        check_graph(graph)
        _bound_memory()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # its errors are raised
        options.add_session_config_entry("session.use_env_allocators", "1")
        try:
            self._session = onnxruntime.InferenceSession(
                graph, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # ONNX Runtime's errors have no common root but this
            raise _failed("loaded", error) from error
        shapes = {i.name: i.shape for i in self._session.get_inputs()}
        outputs = {o.name: o.shape for o in self._session.get_outputs()}
        if "obs" not in shapes or not outputs.keys() >= set(Choice._fields):
            raise MalformedMessageError(
                f"policy graph: found inputs {sorted(shapes)} and outputs {sorted(outputs)}, "
                f"expected obs and {list(Choice._fields)}"
            )
        for name in shapes.keys() - {"obs"}:
            drawn = shapes[name][1:]
            if not all(type(n) is int and n >= 1 for n in drawn) or math.prod(drawn) > _MAX_NOISE:
                raise MalformedMessageError(
                    f"policy graph: found input {name:.40} of {drawn!s:.80}, expected at most "
                    f"{_MAX_NOISE} numbers"
                )
        self._mode = mode
        self._sizes = shapes["obs"][-1], outputs["action"][-1]
        self._normal = tuple(shapes["normal"][1:]) if "normal" in shapes else None
        self._gumbel = tuple(shapes["gumbel"][1:]) if "gumbel" in shapes else None
        self.metadata: dict[str, str] = dict(self._session.get_modelmeta().custom_metadata_map)

    def check(self, spaces: Spaces, env_id: str) -> None:
        """Raise a UsageError if the graph was made for other sizes than those of an environment."""
        found, expected = self._sizes, (spaces.obs_size, spaces.action_size)
        if found != expected:
            raise UsageError(
                f"policy: found obs_size and action_size {found}, expected {expected} for "
                f"{env_id}; give the options of the environment that it was trained on"
            )

    def __call__(self, obs: Array, rng: np.random.Generator) -> Choice:
        """Choose an action for every raw observation, float32 ``[B, D]``.

        Raises:
            MalformedMessageError: The graph cannot be run, for example for lack of memory.
        """
        feed = {"obs": obs}
        if self._normal is not None:
            feed["normal"] = self._draw_normal((len(obs), *self._normal), rng)
        if self._gumbel is not None:
            feed["gumbel"] = self._draw_gumbel((len(obs), *self._gumbel), rng)
        try:
            return Choice._make(self._session.run(Choice._fields, feed))
        except Exception as error:
            raise _failed("run", error) from error

    def _draw_normal(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        if self._mode == "mean":
            return np.zeros(shape, dtype=np.float32)
        normal = rng.standard_normal(shape, dtype=np.float32)
        if self._mode == "best-of-k":
            normal[:, 0] = 0.0
        return normal

    def _draw_gumbel(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        if self._mode != "behaviour":
            return np.zeros(shape, dtype=np.float32)
        gumbel: Array = -np.log(rng.standard_exponential(shape, dtype=np.float32) + _TINY)
        return gumbel


@cache
def _bound_memory() -> None:
    """Let all graphs of this process share a bounded memory."""
    place = onnxruntime.OrtMemoryInfo(
        "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
    )
    usual = -1
    arena = onnxruntime.OrtArenaCfg(_MAX_BYTES, usual, usual, usual)
    onnxruntime.create_and_register_allocator(place, arena)


def _failed(what: str, error: Exception) -> MalformedMessageError:
    return MalformedMessageError(f"policy graph: cannot be {what} ({one_line(str(error))})")
