"""What messages are made of: arrays, names, spaces, and their checks."""

import re
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from a2s.protocol.errors import MalformedMessageError

Array = npt.NDArray[np.float32]

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,95}")
NAME = "at most 96 of letters, digits, _ . -, beginning with no . or -"
METRIC_NAME = "1 to 96 printable characters"
MAX_METRICS = 32
MAX_OBS = 1 << 21  # one step of a segment has two observations


def is_name(text: str) -> bool:
    """Tell whether a run or an actor can have this name: it is `NAME`, so it fits in a key."""
    return _NAME.fullmatch(text) is not None


def is_metric_name(text: str) -> bool:
    """Tell whether a metric can have this name: it is `METRIC_NAME`, so it breaks no line."""
    return 0 < len(text) <= 96 and text.isprintable()


def require(condition: bool, subject: str, found: object, expected: str) -> None:
    """Raise MalformedMessageError unless the condition holds."""
    if not condition:
        raise MalformedMessageError(f"{subject}: found {found!s:.100}, expected {expected}")


def require_counts(subject: str, message: object, *names: str) -> None:
    """Raise MalformedMessageError for the first of these fields of a message that is negative."""
    for name in names:
        found = getattr(message, name)
        require(found >= 0, f"{subject}: {name}", found, ">= 0")


def require_finite(subject: str, **arrays: Array) -> None:
    """Raise MalformedMessageError for the first array with NaN or infinity."""
    for name, array in arrays.items():
        bad = int(array.size - np.isfinite(array).sum())
        require(bad == 0, f"{subject}: {name}", f"{bad} non-finite values", "finite numbers")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Spaces:
    """The flat Box spaces of an environment, in its own units; arrays are float32."""

    obs_size: int  # D
    action_low: Array  # [A]
    action_high: Array  # [A]
    obs_offset: Array | None = None  # [D], subtracted from every observation (docs/adr/0019)

    def __post_init__(self) -> None:
        """Check the sizes and the order of the bounds."""
        low, high = self.action_low, self.action_high
        require(0 < self.obs_size <= MAX_OBS, "spaces: obs_size", self.obs_size, f"1..{MAX_OBS}")
        require(low.ndim == 1 and low.size > 0, "spaces: action_low", low.shape, "shape [A]")
        require(low.shape == high.shape, "spaces: action_high", high.shape, f"{low.shape}")
        require_finite("spaces", action_low=low, action_high=high)
        require(bool((low < high).all()), "spaces", "low >= high", "low below high everywhere")
        if self.obs_offset is not None:
            found = self.obs_offset.shape
            require(found == (self.obs_size,), "spaces: obs_offset", found, f"({self.obs_size},)")
            require_finite("spaces", obs_offset=self.obs_offset)

    @property
    def action_size(self) -> int:
        """A."""
        return int(self.action_low.size)

    def differs_from(self, other: "Spaces") -> str:
        """Describe the first difference to other spaces, or return ``""``; ignore the offset."""
        if self.obs_size != other.obs_size:
            return f"obs_size {other.obs_size}, expected {self.obs_size}"
        if self.action_size != other.action_size:
            return f"action_size {other.action_size}, expected {self.action_size}"
        for name in ("action_low", "action_high"):
            mine, theirs = getattr(self, name), getattr(other, name)
            if not np.array_equal(mine, theirs):
                return f"{name} {theirs.tolist()}, expected {mine.tolist()}"
        return ""
