"""Who else computes the members of an ensemble: nobody, unless several processes share them."""

from torch import Tensor

from a2s.learner.networks.form import Form


class Peers:
    """The processes that share the members of an ensemble, each an equal part; this one is alone.

    All call the same methods in the same order, with tensors of the same shapes.
    """

    def own(self, members: int) -> slice:
        """Which of so many members this process has."""
        return slice(0, members)

    def gather(self, own: Tensor) -> Tensor:
        """From this process's part, ``[E', ...]``, and the others': all of it, ``[E, ...]``."""
        return own

    def pick(self, own: Tensor, owner: Tensor) -> Tensor:
        """Take each row of ``own``, ``[N, ...]``, from the process ``owner [N]`` (numbers)."""
        return own


ALONE = Peers()


def part_of(form: Form, whole: Tensor, members: slice) -> Tensor:
    """Copy the parameters of some members, ``[E' length]``, from those of all, ``[E length]``."""
    number = len(range(*members.indices(len(whole) // form.length)))
    part = whole.new_zeros(number * form.length)
    for to, of in zip(form.weights(part).all(), form.weights(whole).all(), strict=True):
        to.copy_(of[members])
    return part


def whole_of(form: Form, part: Tensor, peers: Peers) -> Tensor:
    """Join the parameters of all processes' members, ``[E length]``; the contrary of `part_of`."""
    parts = peers.gather(part.unsqueeze(0)).unbind(0)
    whole = part.new_zeros(len(parts) * len(part))
    number = len(part) // form.length
    for index, each in enumerate(parts):
        members = slice(index * number, (index + 1) * number)
        for to, of in zip(form.weights(whole).all(), form.weights(each).all(), strict=True):
            to[members].copy_(of)
    return whole
