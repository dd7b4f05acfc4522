"""Equation 5: when to go back to the best networks so far.

``alpha + 1 - gap < U``, hence P(recover) = clip(gap - alpha, 0, 1) for a uniform U: a larger alpha
recovers more rarely. A new rule is a new gap: a function here, a name in `RecoveryRule`, and a line
in `Recovery._probability`. `state.py` keeps and restores the networks.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from a2s.learner.on_policy.config import RecoveryRule, ReturnStatistic


@dataclass(frozen=True, slots=True)
class RecoveryDecision:
    """One test of equation 5."""

    recover: bool  # go back to the best networks
    improved: bool  # the networks that made this batch are the best so far
    draw: float  # the uniform number of the test, 0..1
    probability: float  # chance of recovery at these returns
    r: float | None  # return statistic now; None while there are too few episodes
    r_best: float | None  # the best one before, r*; None before the first


def gap_as_printed(r: float, r_best: float) -> float:
    """``|r - r*| / (|r| + |r*|)``, 0..1: 1 as soon as the signs differ.

    Source: equation 5 of the paper.
    """
    size = abs(r) + abs(r_best)
    return abs(r - r_best) / size if size > 0 else 0.0


def gap_invariant(r: float, r_best: float, r_first: float) -> float:
    """``clip((r* - r) / scale, 0, 1)``, ``scale = max(|r*|, r* - r_first)``.

    The same for returns of any scale and sign: 0.3 is the loss of 30 % of the best return, or of
    the gain since the start where that is more.

    Source: differs from equation 5, which needs positive returns; section 6 of the paper asks for
    this.
    """
    scale = max(abs(r_best), r_best - r_first)
    gap = (r_best - r) / scale if scale > 0 else float(r < r_best)
    return min(max(gap, 0.0), 1.0)


@dataclass(slots=True, kw_only=True)
class Recovery:
    """Keeps r*, the first r and the last returns; takes the draw as an argument."""

    rule: RecoveryRule
    bias: float  # alpha
    statistic: ReturnStatistic
    episodes: int  # how many of the last ones; undecided while there are fewer. 0: of the batch
    offset: float = 0.0  # added to every return in the test
    cool_down: int = 0  # updates after a recovery in which there is no other
    _returns: list[float] = field(default_factory=list, init=False)
    _best: float | None = field(default=None, init=False)
    _first: float | None = field(default=None, init=False)
    _waiting: int = field(default=0, init=False)

    def judge(self, episode_returns: Sequence[float], draw: float) -> RecoveryDecision:
        """Take the undiscounted returns of a batch into account and test equation 5.

        The draw is uniform, 0 to below 1. After a recovery the returns of the failed networks are
        forgotten.
        """
        r, best = self._observe(episode_returns), self._best
        improved = r is not None and (best is None or r > best)
        probability = self._probability(r, best)
        recover = probability > 0 and 1.0 - probability < draw
        self._remember(r, improved=improved, recover=recover)
        return RecoveryDecision(recover, improved, draw, probability, r, best)

    def _observe(self, episode_returns: Sequence[float]) -> float | None:
        shifted = [value + self.offset for value in episode_returns]
        if self.episodes:
            self._returns = (self._returns + shifted)[-self.episodes :]
            if len(self._returns) < self.episodes:
                return None
            shifted = self._returns
        if not shifted:
            return None
        return max(shifted) if self.statistic == "max" else sum(shifted) / len(shifted)

    def _probability(self, r: float | None, best: float | None) -> float:
        if self.rule == "off" or self._waiting or r is None or best is None or r >= best:
            return 0.0
        if self.rule == "authors":
            gap = gap_as_printed(r, best)
        else:
            gap = gap_invariant(r, best, best if self._first is None else self._first)
        return min(max(gap - self.bias, 0.0), 1.0)

    def _remember(self, r: float | None, *, improved: bool, recover: bool) -> None:
        self._waiting = max(self._waiting - 1, 0)
        if r is None:
            return
        self._first = r if self._first is None else self._first
        if improved:
            self._best = r
        if recover:
            self._returns, self._waiting = [], self.cool_down

    def state(self) -> dict[str, Any]:
        """All that changes, fit for JSON."""
        return {
            "returns": list(self._returns),
            "best": self._best,
            "first": self._first,
            "waiting": self._waiting,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Go back to a state."""
        self._returns = list(state["returns"])
        self._best, self._first = state["best"], state["first"]
        self._waiting = state["waiting"]
