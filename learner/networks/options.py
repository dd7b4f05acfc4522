"""Choices of a network, as plain words; they need no torch."""

from typing import Literal

Activation = Literal["relu", "tanh"]
Init = Literal["fan-in", "uniform", "orthogonal"]
Network = Literal["mlp", "residual", "trunk"]
