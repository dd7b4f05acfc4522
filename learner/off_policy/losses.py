"""Regression of the critics to their targets, with the gradient written out."""

import functools
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor


class CriticLoss(NamedTuple):
    """The result of a regression.

    Attributes:
        loss: Summed over the critics, ``[]``.
        grad: Its gradient by their outputs, ``[E, B, M]``.
        error: Mean absolute error of the critics' means, for priorities, ``[B]``.
    """

    loss: Tensor
    grad: Tensor
    error: Tensor


def squared_loss(q_value: Tensor, target: Tensor, weight: Tensor) -> CriticLoss:
    """Half the squared error, a weighted mean over the batch.

    Values are ``[E, B, 1]``, targets ``[B, 1]``, weights ``[B]``.
    """
    error = q_value - target
    grad = error * (weight / len(weight)).unsqueeze(-1)
    return CriticLoss(0.5 * (error * grad).sum(), grad, error.abs().mean((0, 2)))


def quantile_loss(q_value: Tensor, target: Tensor, weight: Tensor, width: float) -> CriticLoss:
    """Huber loss of quantile regression, a mean over pairs of atoms and the weighted batch.

    Atoms are ``[E, B, M]``, those of the target ``[B, M']``, weights ``[B]``. Errors beyond
    ``width``, kappa, above 0, count by their size alone.

    Source: Dabney et al. 2018, equation 10; Kuznetsov et al. 2020 (TQC).
    """
    share = (weight / (len(weight) * q_value.shape[-1])).unsqueeze(-1)
    if q_value.is_cpu and q_value.dtype == torch.float32:
        q_value, target = q_value.contiguous(), target.contiguous()
        cost, grad = torch.empty_like(q_value), torch.empty_like(q_value)
        arrays = (each.numpy() for each in (q_value, target, cost, grad))
        _kernel().fill(*arrays, np.float32(width))
    else:
        cost, grad = _all_pairs(q_value, target, width)
    error = (q_value.mean(-1) - target.mean(-1)).abs().mean(0)
    return CriticLoss((cost * share).sum(), grad * share, error)


def _all_pairs(q_value: Tensor, target: Tensor, width: float) -> tuple[Tensor, Tensor]:
    """The same as the kernel, for where it does not run."""
    atoms = q_value.shape[-1]
    middle = (torch.arange(atoms, device=q_value.device) + 0.5) / atoms
    delta = target.unsqueeze(-2) - q_value.unsqueeze(-1)
    blame = (middle.unsqueeze(-1) - (delta < 0).to(delta.dtype)).abs()
    limited = (delta / width).clamp(-1.0, 1.0)
    huber = limited * (delta - 0.5 * width * limited)
    return (blame * huber).mean(-1), -(blame * limited).mean(-1)


@functools.cache
def _kernel() -> Any:
    from a2s.learner.off_policy import quantile_kernel  # half a second: only who needs it

    return quantile_kernel
