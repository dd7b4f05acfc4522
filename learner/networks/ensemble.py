"""Networks of equal form, evaluated and differentiated together, or a single one.

The gradient is written out. Autograd would do the same, but the bookkeeping of its graph costs more
than the arithmetic of networks as small as these, and an update makes hundreds of small steps.
``tests/learner/networks`` compares it to autograd.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from a2s.learner.networks.form import Form
from a2s.learner.networks.layers import product, run, run_back
from a2s.learner.networks.weights import Weights


class Tape(NamedTuple):
    """What the layers of the trunk, and those above it, keep of one pass."""

    below: list[Any]
    above: list[Any]


class Ensemble:
    """E networks of one form with their parameters and gradients as one vector each.

    ``flat``, the first parameters, is kept, not copied. ``bf16`` makes matrix products in bfloat16.
    ``single``: E is 1, and no tensor has that dimension: products of matrices are faster so.

    Attributes:
        value: Parameters, float32 ``[E length]``; after a change call `refresh`.
        grad: Gradients of the same shape, written by `differentiate`.
        exact: Views of the parameters.
        weights: The same in the precision of matrix products.
    """

    def __init__(
        self,
        form: Form,
        flat: Tensor,
        grad: Tensor | None = None,
        *,
        bf16: bool = False,
        single: bool = False,
    ) -> None:
        self.form = form
        self.members = len(flat) // form.length
        self.single = single
        self.value = flat
        self.grad = torch.zeros_like(flat) if grad is None else grad
        self._product = flat.to(torch.bfloat16) if bf16 else flat
        self.exact = form.weights(flat, single=single)
        self._grads = form.weights(self.grad, single=single)
        self.weights = self.exact
        if bf16:
            self.weights = form.weights(self._product)._replace(norms=self.exact.norms)

    def copy(self) -> "Ensemble":
        """The same networks with parameters of their own."""
        bf16 = self._product is not self.value
        return Ensemble(self.form, self.value.clone(), bf16=bf16, single=self.single)

    def refresh(self) -> None:
        """Take changed parameters into account."""
        if self._product is not self.value:
            self._product.copy_(self.value)

    def __call__(self, x: Tensor) -> Tensor:
        """Map inputs ``[N, in]`` or ``[E, N, in]`` to ``[E, N, out]``, or ``[N, out]``."""
        return self._run(x, None, None)

    def trace(self, x: Tensor) -> tuple[Tensor, Tape]:
        """Map inputs as a call does, and keep what `differentiate` needs."""
        tape = Tape([], [])
        return self._run(x, *tape), tape

    def differentiate(self, tape: Tape, grad: Tensor) -> None:
        """Overwrite the gradients of all parameters, with a tape from `trace`.

        ``grad`` is the gradient by the outputs, ``[E, N, out]``; if single ``[N, out]``.
        """
        form, weights, grads = self.form, self.weights, self._grads
        grad = run_back(form.layers[1:], weights, grads, tape.above[1:], grad)
        if not form.trunk:
            form.first.collect(grads, tape.above[0], grad.to(self._product.dtype))
            return
        joined = form.first.backward(weights, grads, tape.above[0], grad)
        inner = joined[..., : -form.late]
        grad = run_back(form.trunk[1:], weights, grads, tape.below[1:], inner)
        form.enter.collect(grads, tape.below[0], grad.to(self._product.dtype))

    def by_input(self, tape: Tape, grad: Tensor, start: int) -> Tensor:
        """Gradient by the inputs from ``start`` on, ``[E, N, in - start]``; no others are made.

        Of a ``trunk`` they must be among the late ones.
        """
        form = self.form
        grad = run_back(form.layers[1:], self.weights, None, tape.above[1:], grad)
        count = form.sizes[0] - start
        if form.trunk and count > form.late:
            raise ValueError(f"found {count} inputs, a trunk gives the gradient of {form.late}")
        weight = self.weights.weight[form.first.index]
        weight = weight[..., weight.shape[-2] - count :, :]
        if count == 1 and weight.dtype != torch.bfloat16:
            return (grad * weight).sum(-1, keepdim=True)  # the same for each number of members
        return product(grad.to(weight.dtype), weight.mT).to(self.value.dtype)

    def score(self, obs: Tensor, action: Tensor) -> Tensor:
        """Evaluate several actions for every observation, see `score_many`."""
        return score_many(self.form, self.weights, obs, action)

    def _run(self, x: Tensor, below: list[Any] | None, above: list[Any] | None) -> Tensor:
        form = self.form
        if not self.single:
            x = x.expand(self.members, *x.shape[-2:])
        if form.trunk:
            inner = run(form.trunk, self.weights, x[..., : -form.late], below)
            x = torch.cat([inner, x[..., -form.late :].to(inner.dtype)], dim=-1)
        return run(form.layers, self.weights, x, above).to(self.value.dtype)


def score_many(form: Form, weights: Weights, obs: Tensor, action: Tensor) -> Tensor:
    """Evaluate several actions for every observation; the observation's part is computed once.

    The input of ``form`` is observation and action joined. Observations are ``[B, D]``, actions
    each member's own, ``[E, B, K, A]``. ``weights`` of a single network have no dimension E, and
    neither has anything else then.

    Returns:
        Means of the outputs, ``[E, B, K]``.
    """
    *members, rows, count, _ = action.shape
    weight = weights.weight[form.first.index]
    x = obs.to(weight.dtype).expand(*members, *obs.shape)
    if form.trunk:
        x = run(form.trunk, weights, x).to(weight.dtype)
    split = x.shape[-1]
    shared = form.first.multiply(weights, x, weight[..., :split, :])
    acted = product(action.to(weight.dtype).flatten(-3, -2), weight[..., split:, :])
    both = acted.view(*members, rows, count, -1)
    both += shared.unsqueeze(-2)
    out = run(form.layers[1:], weights, both.flatten(-3, -2))
    out = out.view(*members, rows, count, -1).to(obs.dtype)
    return out.squeeze(-1) if out.shape[-1] == 1 else out.mean(-1)
