"""Adam on one vector in one kernel, without a number ever coming back from the device."""

import torch
from torch import Tensor

from a2s.protocol.fields import Array

BETA_1, BETA_2, EPS = 0.9, 0.999, 1e-8


class Adam:
    """Adam on the parameters ``value``, float32; ``steps``, float32 ``[]``, counts its steps.

    Two may share the parameters: the on-policy policy has one for its gradient and one for
    equation 6.

    Source: Kingma and Ba 2015, algorithm 1.
    """

    def __init__(self, value: Tensor) -> None:
        self._value = value
        self._first = torch.zeros_like(value)
        self._second = torch.zeros_like(value)
        self.steps = torch.zeros((), device=value.device)

    def step(self, grad: Tensor, learning_rate: float, max_grad_norm: float = 0.0) -> None:
        """Make one step down a gradient, which is first shortened to a norm unless that is 0."""
        if max_grad_norm > 0:
            grad.mul_((max_grad_norm / (torch.linalg.vector_norm(grad) + 1e-6)).clamp_(max=1.0))
        self.steps.add_(1.0)
        torch._fused_adam_(  # by way of torch.optim it takes a quarter longer
            [self._value], [grad], [self._first], [self._second], [], [self.steps],
            lr=learning_rate, beta1=BETA_1, beta2=BETA_2, weight_decay=0.0, eps=EPS,
            amsgrad=False, maximize=False,
        )  # fmt: skip

    def arrays(self) -> tuple[Array, Array, Array]:
        """Parameters and both moments in the same memory, ``[P]`` each."""
        return self._value.numpy(), self._first.numpy(), self._second.numpy()

    def tensors(self) -> dict[str, Tensor]:
        """Moments and number of steps, not copied."""
        return {"first": self._first, "second": self._second, "steps": self.steps}
