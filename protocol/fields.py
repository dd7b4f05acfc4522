"""What messages are made of: arrays and spaces, with their checks."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from a2s.protocol.checks import require

Array = npt.NDArray[np.float32]

MAX_OBS = 1 << 21  # one step of a segment has two observations


def require_finite(subject: str, **arrays: Array) -> None:
    """Raise MalformedMessageError for the first array with NaN or infinity."""
    for name, array in arrays.items():
        bad = int(array.size - np.isfinite(array).sum())
        require(bad == 0, f"{subject}: {name}", f"{bad} non-finite values", "finite numbers")


def is_within(x: Array, most: float) -> bool:
    """Whether no number is larger in size than ``most``, or none at all."""
    flat = x.reshape(-1)
    squares = float(np.vdot(flat, flat))  # unlike dot, it does not warn of what it is to find
    return squares <= most * most or bool((np.abs(flat) <= most).all())


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
