"""The names of a network's options; this needs no torch."""

from typing import Literal

Activation = Literal["relu", "silu", "tanh"]
Init = Literal["fan-in", "uniform", "orthogonal"]
Network = Literal["mlp", "residual", "trunk"]
