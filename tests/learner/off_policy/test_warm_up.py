"""What is compiled before an off-policy run begins."""

from dataclasses import replace

import pytest
import torch

from a2s.learner.networks import kernels
from a2s.learner.off_policy import quantile_kernel
from a2s.learner.off_policy.config import OffPolicyConfig, Precision
from a2s.learner.off_policy.transitions import Transitions
from a2s.learner.off_policy.update import OffPolicy
from a2s.learner.off_policy.warm_up import is_compiled, warm_up

ROWS, OBS, ACTIONS = 32, 5, 2


def compiled() -> dict[str, int]:
    """For how many kinds of arguments each loop is compiled in this process."""
    found = {**vars(kernels), **vars(quantile_kernel)}
    return {name: len(f.signatures) for name, f in found.items() if hasattr(f, "signatures")}


@pytest.mark.parametrize("precision", ["f32", "bf16"])
def test_nothing_is_left_to_compile_for_a_run(precision: Precision) -> None:
    """Of other sizes; and no random number of the caller is used."""
    torch.manual_seed(0)
    expected = torch.rand(1)
    torch.manual_seed(0)
    warm_up(precision)
    assert torch.equal(torch.rand(1), expected)
    assert is_compiled()
    before = compiled()
    assert min(before[name] for name in ("forward", "backward", "fill")) > 0
    learner = OffPolicy(OBS, ACTIONS, replace(OffPolicyConfig(), precision=precision), 1)
    learner.update(
        Transitions(
            obs=torch.randn(ROWS, OBS),
            action=torch.rand(ROWS, ACTIONS),
            reward=torch.randn(ROWS),
            next_obs=torch.randn(ROWS, OBS),
            discount=torch.ones(ROWS),
            weight=torch.ones(ROWS),
        )
    )
    assert compiled() == before
