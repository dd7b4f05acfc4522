"""What is compiled before a run begins."""

import torch
from on_policy_learners import make_a2c, make_preset, play

from a2s.learner.networks import step_kernels
from a2s.learner.on_policy import fit_kernels
from a2s.learner.on_policy.warm_up import is_compiled, warm_up


def compiled() -> dict[str, int]:
    """For how many kinds of arguments each loop is compiled in this process."""
    found = {**vars(step_kernels), **vars(fit_kernels)}
    return {name: len(f.signatures) for name, f in found.items() if hasattr(f, "signatures")}


def test_nothing_is_left_to_compile_for_a_run() -> None:
    """With suggestions or without, of other sizes; and no random number of the caller is used."""
    torch.manual_seed(0)
    expected = torch.rand(1)
    torch.manual_seed(0)
    warm_up()
    assert torch.equal(torch.rand(1), expected)
    assert is_compiled()
    before = compiled()
    assert min(before["policy_pass"], before["value_pass"], before["q_pass"]) > 0
    for learner in (make_preset("modern"), make_a2c("modern")):
        for number in range(3):
            learner.update(play(learner, number))
    assert compiled() == before
