"""What Q's opinion of actions is worth, measured on steps that Q has not seen."""

from dataclasses import asdict, dataclass

from torch import Tensor

from a2s.learner.on_policy.returns import RESOLUTION

FULL_BATCH = 2048  # steps after which `memory` is what remains


@dataclass(slots=True)
class Calibration:
    """Moving moments of what Q said and what was seen, and their regression.

    Q says by how much the executed action is better than the mean action; what was seen is its
    advantage by GAE. Both are in returns. The slope of the second on the first is 1 for a Q that is
    right, below 1 for one that exaggerates, and 0 for noise.

    Source: ours, docs/adr/0021; the shrinkage of a regression, Copas 1983.
    """

    memory: float = 0.9
    product: float = 0.0  # of both
    said: float = 0.0  # square of what Q said
    seen: float = 0.0  # square of the advantage

    def update(self, said: Tensor, seen: Tensor, weight: Tensor) -> None:
        """Take a batch into account, ``[N]`` each; ``weight`` is of every step, with mean 1."""
        said, seen, weight = said.double(), seen.double(), weight.double()
        said = said - (weight * said).mean()
        seen = seen - (weight * seen).mean()
        kept = self.memory ** (len(said) / FULL_BATCH)
        self.product = kept * self.product + (1 - kept) * float((weight * said * seen).mean())
        self.said = kept * self.said + (1 - kept) * float((weight * said.square()).mean())
        self.seen = kept * self.seen + (1 - kept) * float((weight * seen.square()).mean())

    @property
    def slope(self) -> float:
        """How much of Q's difference between two actions to believe, 0..1."""
        if self.said <= RESOLUTION**2 * self.seen or self.product <= 0:
            return 0.0
        return min(self.product / self.said, 1.0)

    @property
    def correlation(self) -> float:
        """Of what Q said and what was seen, -1..1."""
        both = (self.said * self.seen) ** 0.5
        return self.product / both if both > 0 else 0.0

    @property
    def factor(self) -> float:
        """Turns what Q says, in returns, to deviations of the advantage, as far as it is true."""
        return self.slope / self.seen**0.5 if self.slope > 0 else 0.0

    def state(self) -> dict[str, float]:
        """All that changes, and the memory."""
        return asdict(self)
