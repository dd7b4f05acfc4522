"""The size of returns, the unit in which critics learn them."""

import torch
from torch import Tensor

_SAMPLES = 50
_MIN = torch.finfo(torch.float32).tiny


class ReturnSize:
    """Root mean square of returns: the mean of all samples so far, of about the last 50 later.

    It is not their deviation: that is 0 where every return is alike. When not ``enabled`` it stays
    1.

    Attributes:
        mean_square: Float64 ``[]``; 1 before the first sample.
        samples: Taken into account, float64 ``[]``.

    Source: docs/adr/0012; after SimbaV2 (Lee et al. 2025), which has the deviation.
    """

    def __init__(self, *, enabled: bool, device: torch.device) -> None:
        self.enabled = enabled
        self.mean_square = torch.ones((), dtype=torch.float64, device=device)
        self.samples = torch.zeros((), dtype=torch.float64, device=device)

    def observe(self, returns: Tensor) -> None:
        """Take a sample of returns, ``[N]``, into account."""
        if self.enabled:
            self.samples += 1.0
            share = 1.0 / self.samples.clamp(max=_SAMPLES)
            self.mean_square.lerp_(returns.double().square().mean(), share)

    def __call__(self) -> Tensor:
        """The size, ``[]``, above 0: 1 if all returns so far are 0."""
        size = torch.where(self.mean_square > 0, self.mean_square.sqrt(), 1.0)
        return size.clamp(min=_MIN).to(torch.get_default_dtype())

    def tensors(self) -> dict[str, Tensor]:
        """All that changes, not copied."""
        return {"mean_square": self.mean_square, "samples": self.samples}
