"""The off-policy update."""

import itertools
from typing import Any

import pytest
import torch
from plain_sac import PlainSac, modules

from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.off_policy.config import PRESETS
from a2s.learner.off_policy.noise import Noise, draw_noise
from a2s.learner.off_policy.stats import RoundMeans
from a2s.learner.off_policy.transitions import Transitions
from a2s.learner.off_policy.update import OffPolicy
from a2s.learner.run.config import off_policy
from a2s.protocol.errors import A2SError

OBS, ACTION, ROWS = 5, 3, 32
SMALL: dict[str, Any] = {"critic_sizes": "24,16", "policy_sizes": "16,16", "precision": "f32"}


def make(preset: str = "sac", seed: int = 4, **options: Any) -> OffPolicy:
    """An algorithm with small networks that has seen some observations."""
    algorithm = OffPolicy(OBS, ACTION, off_policy(preset, {**SMALL, **options}), seed)
    algorithm.observe(3.0 * torch.randn(200, OBS, generator=generator(9)) + 1.0)
    return algorithm


def generator(seed: int) -> torch.Generator:
    """A generator of its own."""
    return torch.Generator().manual_seed(seed)


def batch(seed: int, rows: int = ROWS) -> Transitions:
    """Rows some of which are terminal."""
    draw = generator(seed)
    return Transitions(
        obs=3.0 * torch.randn(rows, OBS, generator=draw),
        action=2.0 * torch.rand(rows, ACTION, generator=draw) - 1.0,
        reward=torch.randn(rows, generator=draw),
        next_obs=3.0 * torch.randn(rows, OBS, generator=draw),
        discount=0.99 * (torch.rand(rows, generator=draw) > 0.2).float(),
        weight=torch.ones(rows),
    )


def noise_of(algorithm: OffPolicy, seed: int) -> Noise:
    """The noise of an update."""
    return draw_noise(ROWS, ACTION, algorithm.hyper, generator(seed))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"layer_norm": False, "norm_obs": False},
        {"network": "residual"},
        {"network": "residual", "critic_sizes": "24,16,8", "layer_norm": False},
        {"num_critics": 5},
        {"network": "trunk"},
    ],
    ids=str,
)
def test_one_suggestion_makes_it_sac(options: dict[str, Any]) -> None:
    """Losses, temperature and every weight, over 20 updates.

    In double precision: Adam makes a whole step of what rounding leaves of a gradient of 0.
    """
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        compare_to_plain_sac(make("sac", **options), updates=20, near=1e-9)
    finally:
        torch.set_default_dtype(before)


def compare_to_plain_sac(algorithm: OffPolicy, updates: int, near: float) -> None:
    """Let both learn from the same rows with the same noise."""
    plain = PlainSac(algorithm)
    for number in range(updates):
        noise = noise_of(algorithm, number)
        ours = algorithm.update(batch(number), noise)
        theirs = plain.update(batch(number), noise.suggestion, noise.target[0, :, 0])
        assert ours.policy_loss is not None
        found = [float(each) for each in (ours.q_loss, ours.policy_loss, ours.temperature)]
        assert found == pytest.approx(list(theirs), rel=near, abs=near)
    learned = algorithm.train_state
    pairs = [(learned.policy, [plain.policy]), (learned.critics, plain.critics)]
    for ensemble, nets in [*pairs, (learned.targets, plain.targets)]:
        for mine, yours in zip(modules(ensemble), nets, strict=True):
            for one, other in zip(mine.parameters(), yours.parameters(), strict=True):
                torch.testing.assert_close(one, other, rtol=near, atol=near)


def test_an_update_without_the_policy_is_one_of_the_critics_alone() -> None:
    """Policy and temperature stay, to the bit; the critics learn as beside them."""
    one, other = make("modern"), make("modern")
    before = one.state()
    with_policy, without = one.update(batch(0)), other.update(batch(0), learns_policy=False)
    changed = {name for name, each in other.state().items() if not torch.equal(each, before[name])}
    critics = {name for name in before if "critics" in name or name == "targets"}
    assert changed == critics | {"generator.noise"}
    assert all(torch.equal(one.state()[name], other.state()[name]) for name in changed)
    assert torch.equal(with_policy.error, without.error)
    assert without.policy_loss is without.entropy is None


def test_means_of_a_round_are_over_the_updates_that_had_a_number() -> None:
    """Of three updates two had the policy learn; a round of none has no mean."""
    algorithm, means = make("modern"), RoundMeans()
    assert set(means.means().values()) == {None}
    all_of = [algorithm.update(batch(n), learns_policy=n != 1) for n in range(3)]
    for each in all_of:
        means.add(each)
    entropy = [float(each.entropy) for each in all_of if each.entropy is not None]
    assert (means.updates, means.counts["entropy"], len(entropy)) == (3, 2, 2)
    found = means.means()
    assert found["entropy"] == pytest.approx(sum(entropy) / 2)
    assert found["q_loss"] == pytest.approx(sum(float(each.q_loss) for each in all_of) / 3)


@pytest.mark.parametrize("quantiles", [1, 5])
def test_the_unit_of_rewards_does_not_matter(quantiles: int) -> None:
    """Eight times the rewards: the same weights to the bit, and eight times what is reported."""
    options = {"norm_return": True, "num_quantiles": quantiles, "quantiles_to_drop": 0}
    one, other = (make("modern", **options) for _ in range(2))
    one.observe_returns(torch.tensor([3.0, -4.0]))
    other.observe_returns(torch.tensor([24.0, -32.0]))
    for number in range(5):
        rows = batch(number)
        small = one.update(rows)
        large = other.update(rows._replace(reward=8.0 * rows.reward))
    for name in ("policy", "critics", "targets"):
        assert torch.equal(
            getattr(one.train_state, name).value, getattr(other.train_state, name).value
        )
    for name in ("q_mean", "target_mean", "temperature", "error"):
        assert torch.equal(8.0 * getattr(small, name), getattr(large, name))
    assert (small.q_loss, small.policy_loss) == (large.q_loss, large.policy_loss)


def test_the_unit_of_observations_does_not_matter() -> None:
    """A millionth, about: the same weights to the bit."""
    unit = 2.0**-20
    one, other = (OffPolicy(OBS, ACTION, off_policy("modern", SMALL), 4) for _ in range(2))
    for number in range(5):
        rows = batch(number)
        for algorithm, size in ((one, 1.0), (other, unit)):
            algorithm.observe(size * rows.obs)
            algorithm.update(
                rows._replace(obs=size * rows.obs, next_obs=size * rows.next_obs),
            )
    for name in ("policy", "critics", "targets"):
        assert torch.equal(
            getattr(one.train_state, name).value, getattr(other.train_state, name).value
        )


def test_returns_are_learned_in_units_of_their_size() -> None:
    """With rewards divided by 5 before, and nothing to normalise, it is the same to the bit."""
    plain = make("modern", norm_return=False)
    ours = make("modern")
    ours.observe_returns(torch.tensor([5.0, -5.0]))
    for number in range(3):
        rows = batch(number)
        plain.update(rows._replace(reward=rows.reward / 5.0))
        ours.update(rows)
    assert torch.equal(plain.train_state.critics.value, ours.train_state.critics.value)


@pytest.mark.parametrize("name", ["act_suggestions", "send_every_steps"])
def test_acting_has_no_part_in_the_update(name: str) -> None:
    """So the presets ``sac`` and ``modern`` differ in what they learn from, too."""
    one, other = make(), make("sac", 4, **{name: 7})
    for number in range(3):
        one.update(batch(number))
        other.update(batch(number))
    assert torch.equal(one.train_state.policy.value, other.train_state.policy.value)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"target_groups": 3},
        {"num_quantiles": 5, "quantiles_to_drop": 1},
        {"precision": "bf16"},
    ],
    ids=str,
)
@pytest.mark.parametrize("preset", PRESETS)
def test_goes_on_to_the_bit_from_a_state(preset: str, options: dict[str, Any]) -> None:
    """Five updates, and two, stored, restored elsewhere, and three."""
    straight, first, second = (make(preset, seed, **options) for seed in (4, 4, 5))
    for number in range(5):
        straight.update(batch(number))
    for number in range(2):
        first.update(batch(number))
    second.load(first.state())
    for number in range(2, 5):
        second.update(batch(number))
    wanted, found = straight.state(), second.state()
    assert wanted.keys() == found.keys()
    for name, tensor in wanted.items():
        assert torch.equal(tensor, found[name]), name
    assert straight.is_finite()


def test_state_of_other_sizes_is_refused() -> None:
    """By name."""
    with pytest.raises(A2SError, match="learner state: critics: found shape"):
        make(num_critics=3).load(make().state())


def test_broken_weights_are_noticed() -> None:
    """A reward that is no number spoils critics first."""
    algorithm = make()
    spoiled = batch(0)._replace(reward=torch.full((ROWS,), float("nan")))
    assert algorithm.is_finite()
    algorithm.update(spoiled)
    assert not algorithm.is_finite()


def test_nothing_is_expected_after_a_terminal_state() -> None:
    """The next observation has no influence where the discount is 0."""
    one, other = make("modern"), make("modern")
    rows = batch(1)
    ended = rows._replace(discount=torch.zeros(ROWS))
    noise = noise_of(one, 0)
    first = one.update(ended, noise)
    second = other.update(ended._replace(next_obs=rows.obs), noise)
    assert float(first.target_mean) == pytest.approx(float(rows.reward.mean()))
    assert torch.equal(first.error, second.error)


def test_next_observation_counts_where_the_discount_is_not_zero() -> None:
    """As after a time limit."""
    one, other = make("modern"), make("modern")
    rows, noise = batch(1), noise_of(one, 0)
    first = one.update(rows, noise)
    second = other.update(rows._replace(next_obs=rows.obs), noise)
    cut = rows.discount > 0
    # An error is the same for all targets between the values of the two critics.
    assert float((first.error[cut] != second.error[cut]).float().mean()) > 0.9
    assert torch.equal(first.error[~cut], second.error[~cut])


def test_targets_by_hand() -> None:
    """Constant critics: y = r + gamma^n (Q - temperature (log pi + c_K)), to the number."""
    algorithm = make(target_suggestions=4, target_groups=2, norm_obs=False)
    learned = algorithm.train_state
    learned.targets.value.zero_()
    learned.critics.value.zero_()
    for member, constant in enumerate((7.0, 5.0)):
        learned.targets.weights.bias[-1][member] = constant
    learned.policy.value.zero_()  # u is standard normal
    learned.log_temperature.fill_(-1.2039728)  # temperature 0.3
    rows, noise = batch(2), noise_of(algorithm, 0)
    stats = algorithm.update(rows, noise)
    # All scores are 0: the first suggestion of each group counts.
    u = noise.target[:, :, 0]
    log_prob = -0.5 * u.square() - 0.9189385 - (1.0 - u.tanh().square()).log()
    soft = 5.0 - 0.3 * (log_prob.sum(2).mean(0) + 0.6362944)  # ln 4 - 3/4
    wanted = rows.reward + rows.discount * soft
    torch.testing.assert_close(stats.error, wanted.abs(), rtol=1e-4, atol=1e-5)


def test_importance_weights_scale_a_row() -> None:
    """Weight 0 removes a row, 2 counts it twice."""
    rows = batch(3, 2)
    weights = [torch.tensor([0.0, 2.0]), torch.ones(2)]
    alone = Transitions(*(torch.stack([each[1], each[1]]) for each in rows))
    noise = draw_noise(2, ACTION, make().hyper, generator(0))
    same = Noise(noise.suggestion, noise.target[:, 1:].repeat(1, 2, 1, 1), *noise[2:])
    one, other = make(), make()
    first = one.update(rows._replace(weight=weights[0]), same)
    second = other.update(alone._replace(weight=weights[1]), same)
    torch.testing.assert_close(first.q_loss, second.q_loss)
    torch.testing.assert_close(one.train_state.critics.value, other.train_state.critics.value)


def test_bf16_products_stay_near_f32() -> None:
    """Targets within a per cent of the spread after some updates."""
    exact, rough = make("modern"), make("modern", precision="bf16")
    for number in range(20):
        noise = noise_of(exact, number)
        first, second = exact.update(batch(number), noise), rough.update(batch(number), noise)
    torch.testing.assert_close(first.error, second.error, rtol=0.05, atol=0.05)
    assert not torch.equal(first.error, second.error)


def test_temperature_rises_while_the_entropy_is_too_low() -> None:
    """And falls above; a rate of 0 leaves it alone."""
    for wanted, sign in ((5.0, 1), (-50.0, -1)):
        algorithm = make(entropy_per_action=wanted)
        before = float(algorithm.train_state.log_temperature)
        algorithm.update(batch(0))
        assert (float(algorithm.train_state.log_temperature) - before) * sign > 0
    fixed = make(temperature_learning_rate=0.0, initial_temperature=0.2)
    assert float(fixed.update(batch(0)).temperature) == pytest.approx(0.2)


def test_target_is_that_of_a_loop_over_groups_and_suggestions() -> None:
    """Equations 7 and 8, one suggestion at a time."""
    algorithm = make(target_suggestions=4, target_groups=3, num_critics=2, tau=0.5)
    for number in range(3):  # until critics and targets differ
        algorithm.update(batch(number))
    learned, rows, noise = algorithm.train_state, batch(7), noise_of(algorithm, 7)
    policy, critics = modules(learned.policy)[0], modules(learned.critics)
    targets = modules(learned.targets)
    temperature = float(learned.log_temperature.exp())
    seen, next_seen = learned.normaliser(rows.obs), learned.normaliser(rows.next_obs)
    wanted = torch.zeros(ROWS)
    with torch.no_grad():
        for row, group in itertools.product(range(ROWS), range(3)):
            mean, log_std = policy(next_seen[row]).chunk(2)
            best, soft = -float("inf"), 0.0
            for normal in noise.target[group, row]:
                u = mean + log_std.exp() * normal
                joined = torch.cat([next_seen[row], u.tanh()])
                scores = [float(critic(joined)) for critic in critics]
                chosen = scores[int(noise.critic[group])]
                if chosen > best:
                    density = -0.5 * normal.square() - log_std - 0.9189385
                    log_prob = float((density - (1.0 - u.double().tanh().square()).log()).sum())
                    least = min(float(target(joined)) for target in targets)
                    best, soft = chosen, least - temperature * (log_prob + 0.6362944)
            wanted[row] += rows.reward[row] + rows.discount[row] * soft
        joined = torch.cat([seen, rows.action], 1)
        errors = [(critic(joined).squeeze(1) - wanted / 3).abs() for critic in critics]
    found = algorithm.update(rows, noise)
    torch.testing.assert_close(found.error, torch.stack(errors).mean(0), rtol=1e-4, atol=1e-4)


def parameters(ensemble: Ensemble) -> list[torch.Tensor]:
    """Views, the first dimension of which numbers the members."""
    weights = ensemble.exact
    norms = [each for norm in weights.norms for each in (norm.gain, norm.offset)]
    return [*weights.weight, *weights.bias, *norms]


def test_numbering_of_the_critics_does_not_matter() -> None:
    """Two that change places, and their numbers in the noise with them."""
    one, other = make("modern", target_groups=2), make("modern", target_groups=2)
    for ensemble in (other.train_state.critics, other.train_state.targets):
        for view in parameters(ensemble):
            view.copy_(view.flip(0))
    for number in range(3):
        noise = noise_of(one, number)
        one.update(batch(number), noise)
        other.update(batch(number), noise._replace(critic=1 - noise.critic))
    torch.testing.assert_close(one.train_state.policy.value, other.train_state.policy.value)
    for mine, yours in zip(
        parameters(one.train_state.targets), parameters(other.train_state.targets), strict=True
    ):
        torch.testing.assert_close(mine, yours.flip(0))


@pytest.mark.parametrize("longest", [1, 2, 1000])
def test_what_is_kept_is_the_policy_averaged_over_a_tenth_of_all_updates(longest: int) -> None:
    """Or over fewer; actors get the latest one."""
    algorithm = make("modern", average_updates=longest)
    average = algorithm.train_state.policy.value.double()
    bounds = -torch.ones(ACTION), torch.ones(ACTION)
    for number in range(1, 41):
        algorithm.update(batch(number))
        share = 1.0 / min(max(number / 10, 1.0), longest)
        average += share * (algorithm.train_state.policy.value - average)
        kept = algorithm.suggester(*bounds, averaged=True).policy.value
        assert torch.allclose(kept.double(), average, atol=1e-6)
    assert torch.equal(
        algorithm.suggester(*bounds).policy.value, algorithm.train_state.policy.value
    )
    assert torch.equal(kept, algorithm.train_state.policy.value) is (longest == 1)


def test_nothing_is_averaged_unless_wanted() -> None:
    algorithm = make("sac")
    algorithm.update(batch(0))
    kept = algorithm.suggester(-torch.ones(ACTION), torch.ones(ACTION), averaged=True).policy
    assert kept is algorithm.train_state.policy
    assert "average" not in algorithm.state()
