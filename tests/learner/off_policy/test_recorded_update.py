"""What a GPU needs of an update, as far as it can be seen without one."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.fx.experimental.proxy_tensor import make_fx

from a2s.learner.off_policy.noise import Noise
from a2s.learner.off_policy.recorded_update import RecordedUpdate
from a2s.learner.off_policy.state import TrainState
from a2s.learner.off_policy.stats import OffPolicyStats
from a2s.learner.off_policy.transitions import Transitions
from a2s.learner.off_policy.update import OffPolicy
from a2s.learner.run.config import off_policy

pytestmark = pytest.mark.slow

OPTIONS: list[dict[str, object]] = [
    {},
    {"target_groups": 2},
    {"num_quantiles": 5, "quantiles_to_drop": 1},
    {"policy_loss": "score", "network": "residual"},
    {"network": "trunk", "norm_obs": False},
]
ROWS, OBS, ACTION = 16, 5, 2


def make(**options: object) -> OffPolicy:
    """Small networks that both start from."""
    small = {"critic_sizes": (16, 16), "policy_sizes": (16, 16), "batch_rows": ROWS}
    return OffPolicy(OBS, ACTION, off_policy("modern", {**small, "precision": "f32", **options}), 3)


def batch(number: int) -> Transitions:
    """Rows that nothing is special about."""
    generator = torch.Generator().manual_seed(number)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator)

    return Transitions(
        obs=normal(ROWS, OBS),
        action=normal(ROWS, ACTION).tanh(),
        reward=normal(ROWS),
        next_obs=normal(ROWS, OBS),
        discount=torch.full((ROWS,), 0.99),
        weight=torch.ones(ROWS),
    )


@pytest.fixture
def double() -> Iterator[None]:
    """In float64 all kernels are torch's own, as on a GPU."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)


def as_kernels(update: Callable[[], OffPolicyStats]) -> Callable[[], OffPolicyStats]:
    """Record an update as what a CUDA graph is: kernels in a row, on memory that stays."""
    graph = make_fx(update)()
    update()  # warms up, and leaves what must be taken back

    def repeat() -> OffPolicyStats:
        return OffPolicyStats(*graph())

    return repeat


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@pytest.mark.usefixtures("double")
def test_repeating_the_kernels_is_updating(options: dict[str, Any]) -> None:
    """Whatever Python kept to itself, as a count of steps, would stay what it was at first."""
    plain, other = make(**options), make(**options)
    recorded = RecordedUpdate(other, as_kernels)
    for algorithm in (plain, other):
        algorithm.observe(batch(99).obs)
    for number in range(6):
        learns = number % 3 != 1
        wanted = plain.update(batch(number), learns_policy=learns)
        found = recorded(batch(number), learns_policy=learns)
        for one, two in zip(wanted, found, strict=True):
            assert (one is two is None) if one is None or two is None else torch.equal(one, two)
        assert (found.entropy is None) != learns
    for name, tensor in plain.state().items():
        assert torch.equal(tensor, other.state()[name]), name


@pytest.mark.parametrize("options", [*OPTIONS, {"precision": "bf16"}], ids=str)
def test_an_update_stays_on_the_device_and_never_waits_for_it(options: dict[str, Any]) -> None:
    """With tensors that know their device and shape alone: what reads a number of them fails."""
    algorithm = make(**options)
    noise = algorithm.draw_noise(ROWS)
    algorithm.device = torch.device("cuda")
    with FakeTensorMode(allow_non_fake_inputs=True) as fake:
        algorithm.train_state = TrainState(
            OBS, ACTION, algorithm.hyper, torch.Generator(), algorithm.device
        )
        there = Transitions(*(fake.from_tensor(each).cuda() for each in batch(0)))
        stats = algorithm.update(there, Noise(*(fake.from_tensor(each).cuda() for each in noise)))
    assert {each.device.type for each in stats if each is not None} == {"cuda"}
    assert None not in stats
    assert stats.error.shape == (ROWS,)
