"""Acting as one module."""

import pytest
import torch

from a2s.learner.networks.normaliser import Normaliser
from a2s.learner.on_policy.acting import Suggester, SuggesterMode
from a2s.learner.on_policy.state import make_critic, make_policy
from a2s.learner.run.config import on_policy

LOW, HIGH = torch.tensor([-0.4, 1.0]), torch.tensor([0.4, 5.0])


def make(mode: SuggesterMode, action_mode: str = "clip") -> Suggester:
    """Build a suggester with asymmetric bounds."""
    hyper = on_policy("modern", "a2s", {"action_mode": action_mode})
    generator = torch.Generator().manual_seed(0)
    policy = make_policy(3, 2, hyper, generator)
    q_net = make_critic(5, hyper.q_sizes, hyper, generator)
    return Suggester(
        normaliser=Normaliser(3, enabled=True),
        policy=policy,
        q_net=None if mode == "first" else q_net,
        action_low=LOW,
        action_high=HIGH,
        mode=mode,
        suggestions=1 if mode == "first" else 6,
        action_mode=hyper.action_mode,
        q_scale=2.0,
    )


@pytest.mark.parametrize("action_mode", ["clip", "raw"])
def test_hard_choice_is_the_candidate_of_largest_q(action_mode: str) -> None:
    """The loop over K of algorithm 1, written out."""
    suggester = make("hard", action_mode)
    obs, normal = torch.randn(12, 3), 3.0 * torch.randn(12, 6, 2)
    choice = suggester(obs, normal)
    seen = suggester.normaliser(obs)
    candidates = suggester.policy(seen).unsqueeze(1) + suggester.policy.std() * normal
    assert suggester.q_net is not None
    shown = candidates.clamp(-1, 1) if action_mode == "clip" else candidates
    q_value = suggester.q_net.score(seen, shown)
    best = q_value.argmax(1)
    assert torch.equal(choice.suggestion, candidates[torch.arange(12), best])
    spread = 2.0 * (q_value.amax(1) - q_value.mean(1))
    torch.testing.assert_close(choice.q_spread, spread)


def test_without_q_there_is_one_suggestion() -> None:
    """Several of them could only be picked by chance."""
    choice = make("first")(torch.randn(4, 3), torch.zeros(4, 1, 2))
    assert choice.q_spread.tolist() == [0.0] * 4
    with pytest.raises(ValueError, match="only mode 'first' has no Q"):
        Suggester(
            normaliser=Normaliser(3, enabled=False),
            policy=make("first").policy,
            q_net=None,
            action_low=LOW,
            action_high=HIGH,
            mode="hard",
            suggestions=3,
        )
