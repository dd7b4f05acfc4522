"""`a2s` with one thing of the learner changed: python benchmarks/arms.py ARM train --env Hopper-v5.

What the default has no option for, and needs none: it is only to be seen what each part is worth.
"""

import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from a2s import cli
from a2s.commands import train
from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.on_policy import categorical, suggestions, update
from a2s.learner.on_policy.acting import as_q_sees
from a2s.learner.on_policy.suggestions import Pull, pull_of_suggestions

UPDATE: Any = update  # it is written into
SUGGESTIONS: Any = suggestions
FAR = 100.0  # see `centred`
STEP = 0.1  # of a finite difference, in deviations of the policy


def placebo() -> None:
    """The scores of a state's K suggestions are dealt out at random among them."""
    generator = torch.Generator().manual_seed(0)

    def dealt(q_net: Ensemble, norm_obs: Tensor, action: Tensor) -> Tensor:
        score = categorical.score(q_net, norm_obs, action)
        return score.gather(1, torch.rand(score.shape, generator=generator).argsort(1))

    SUGGESTIONS.categorical = SimpleNamespace(score=dealt)


def pathwise() -> None:
    """Q's gradient at the mean pulls, not the K: of a linear Q the softmax makes the same."""

    def along_gradient(
        q_net: Ensemble, norm_obs: Tensor, mean: Tensor, std: Tensor, **how: Any
    ) -> Pull:
        found = pull_of_suggestions(q_net, norm_obs, mean, std, **how)
        steps = STEP * torch.diag(std)
        either = torch.cat([mean.unsqueeze(1) + steps, mean.unsqueeze(1) - steps], 1)
        score = categorical.score(q_net, norm_obs, as_q_sees(either, "clip"))
        up, down = score.chunk(2, 1)
        slope = (up - down) / (2.0 * STEP * std)
        return found._replace(mean=mean + found.inverse_temperature * std.square() * slope)

    UPDATE.pull_of_suggestions = along_gradient


def without_ppo() -> None:
    """Nothing but the suggestions moves the policy."""
    UPDATE.normalised = lambda advantage, _: torch.zeros_like(advantage)


def centred() -> None:
    """The weights less 1/K pull, without end: nothing holds the policy where it was.

    It is asked to go much farther, and pulled as much weaker: what holds it is gone in the limit.
    """

    def farther(q_net: Ensemble, norm_obs: Tensor, mean: Tensor, std: Tensor, **how: Any) -> Pull:
        found = pull_of_suggestions(q_net, norm_obs, mean, std, **how)
        return found._replace(mean=mean + FAR * (found.mean - mean))

    UPDATE.pull_of_suggestions = farther


ARMS: dict[str, tuple[Callable[[], None], tuple[str, ...]]] = {
    "placebo": (placebo, ()),
    "pathwise": (pathwise, ()),
    "no-ppo": (without_ppo, ()),
    "centred": (centred, ("--set", f"pull={1.0 / FAR}")),
}


def main() -> None:
    """Change it here, and in the learner that `a2s train` starts."""
    arm, *options = sys.argv[1:]
    change, settings = ARMS[arm]
    if options[0] == "train":
        options += settings
    if options[0] == "learner":
        change()
    train.PROGRAM = (sys.executable, __file__, arm)
    sys.argv = ["a2s", *options]
    cli.main()


if __name__ == "__main__":
    main()
