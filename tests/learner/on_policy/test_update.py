"""Whole updates."""

import dataclasses
import json
import math
from typing import Any

import pytest
import torch

from a2s.learner.on_policy.batch import Batch
from a2s.learner.on_policy.stats import UpdateStats
from a2s.learner.on_policy.update import OnPolicy
from a2s.learner.run.config import on_policy
from a2s.protocol.errors import A2SError, RunDirectoryError

D, A = 4, 2
SMALL = {
    "policy_sizes": "16",
    "value_sizes": "16",
    "q_sizes": "16",
    "critic_epochs": 2,
    "critic_minibatch": 32,
    "fit_steps": 5,
    "q_fit_extra_steps": 3,
    "value_fit_extra_steps": 3,
}


def make(preset: str = "modern", algo: str = "a2s", seed: int = 7, **options: Any) -> OnPolicy:
    """Build a small learner."""
    return OnPolicy(D, A, on_policy(preset, algo, {**SMALL, **options}), seed)


def play(
    algorithm: OnPolicy, seed: int, score: float = 10.0, version: int = 0, unit: float | None = None
) -> Batch:
    """A batch of four segments whose reward is the larger the nearer the action is to .5.

    With a ``unit`` of observations: to half the sign of the first of them.
    """
    generator = torch.Generator().manual_seed(seed)
    size = 1.0 if unit is None else unit
    obs = size * torch.randn(80, D, generator=generator)
    suggester = algorithm.suggester(-torch.ones(A), torch.ones(A))
    normal = torch.randn(80, suggester.suggestions, A, generator=generator)
    gumbel = torch.randn(80, suggester.suggestions, generator=generator)
    with torch.no_grad():
        choice = suggester(obs, normal, gumbel)
    wanted = 0.5 if unit is None else 0.5 * obs[:, :1].sign()
    return Batch(
        obs=obs,
        suggestion=choice.suggestion,
        log_prob=choice.log_prob,
        reward=-(choice.action - wanted).square().sum(1),
        lengths=torch.tensor([30, 10, 20, 20]),
        weights_version=torch.full((4,), version),
        final_obs=size * torch.randn(4, D, generator=generator),
        terminated=torch.tensor([True, False, False, True]),
        truncated=torch.tensor([False, True, False, False]),
        episode_returns=torch.full((3,), score),
    )


def fingerprint(algorithm: OnPolicy, *, without: str = "-") -> dict[str, list[float]]:
    """Write out every tensor of the state, but those of a prefix."""
    tensors, _ = algorithm.state()
    return {
        name: tensor.flatten().tolist()
        for name, tensor in tensors.items()
        if not name.startswith(without)
    }


@pytest.mark.parametrize("preset", ["modern", "authors", "paper"])
def test_a2c_is_a2s_with_one_suggestion_to_the_bit(preset: str) -> None:
    """There is one path through the code."""
    a2c = make(preset, "a2c")
    options: dict[str, Any] = {"suggestions": 1, "distil": "off", "recovery": "off"}
    a2s = make(preset, "a2s", advantage=a2c.hyper.advantage, **options)
    for number in range(3):
        batch = play(a2c, number)
        assert a2c.update(batch) == a2s.update(batch)
    assert fingerprint(a2c) == fingerprint(a2s)


@pytest.mark.parametrize("fit_rule", ["epochs", "threshold"])
def test_fitting_q_touches_neither_policy_nor_value(fit_rule: str) -> None:
    """On the same batches A2S without eq. 5 and 6 has the policy and value of A2C, to the bit."""
    a2c = make("modern", "a2c", fit_rule=fit_rule)
    a2s = make("modern", "a2s", fit_rule=fit_rule, distil="off", recovery="off")
    for number in range(3):
        batch = play(a2c, number)
        a2c.update(batch)
        assert a2s.update(batch).q_fit_steps > 0
    a2c_state, a2s_state = fingerprint(a2c), fingerprint(a2s)
    for name in ("policy", "value", "normaliser.mean", "adam.policy.second", "generator.order"):
        assert a2c_state[name] == a2s_state[name]
    assert a2c_state["q"] != a2s_state["q"]


VARIANTS: list[tuple[str, dict[str, Any]]] = [
    ("modern", {}),
    ("modern", {"distil": "separate"}),
    ("modern", {"lr_rule": "kl", "recovery_bias": 0.0, "recovery_episodes": 3}),
    ("authors", {}),
    ("paper", {"recovery_bias": 0.0}),
]


@pytest.mark.parametrize(("preset", "options"), VARIANTS)
def test_stopping_and_going_on_changes_nothing(preset: str, options: dict[str, Any]) -> None:
    """The state goes through JSON; the scores crash so that recovery is part of it."""
    scores = [10.0, 20.0, -90.0, -50.0, 5.0, -90.0]
    through = make(preset, **options)
    for number, score in enumerate(scores[:3]):
        through.update(play(through, number, score, number))
    tensors, scalars = through.state()
    resumed = make(preset, seed=99, **options)
    resumed.load(
        {name: tensor.clone() for name, tensor in tensors.items()}, json.loads(json.dumps(scalars))
    )
    for number, score in enumerate(scores[3:], 3):
        batch = play(through, number, score, number)
        assert through.update(batch) == resumed.update(batch)
    assert fingerprint(through) == fingerprint(resumed)
    assert through.state()[1] == resumed.state()[1]


def test_state_is_a_copy() -> None:
    """A checkpoint is written while learning goes on."""
    algorithm = make()
    tensors, _ = algorithm.state()
    before = tensors["policy"].tolist()
    algorithm.update(play(algorithm, 0))
    assert tensors["policy"].tolist() == before
    assert algorithm.state()[0]["policy"].tolist() != before


def test_state_of_other_sizes_is_refused() -> None:
    """By name, before anything is changed."""
    tensors, scalars = make().state()
    with pytest.raises(RunDirectoryError, match="policy: found shape"):
        make(policy_sizes="8").load(tensors, scalars)
    del tensors["generator.q"]
    with pytest.raises(RunDirectoryError, match=r"found no tensor 'generator\.q'.*begin a new run"):
        make().load(tensors, scalars)


@pytest.mark.parametrize(("preset", "options"), VARIANTS)
def test_every_number_of_an_update_is_finite(preset: str, options: dict[str, Any]) -> None:
    """They all become columns and metrics."""
    algorithm = make(preset, **options)
    for number in range(3):
        stats = algorithm.update(play(algorithm, number))
    numbers = dataclasses.asdict(stats)
    del numbers["recovery"]
    assert all(math.isfinite(number) for number in numbers.values())
    assert algorithm.updates == 3


def crash(algorithm: OnPolicy) -> tuple[dict[str, list[float]], UpdateStats]:
    """A good batch made by version 4, some learning, then a crash that must recover."""
    best = fingerprint(algorithm)
    algorithm.update(play(algorithm, 0, 100.0, version=4))
    algorithm.update(play(algorithm, 1, 99.0, version=5))
    for number in range(2, 40):
        stats = algorithm.update(play(algorithm, number, -1000.0, version=number + 4))
        if stats.recovered:
            return best, stats
    raise AssertionError("never recovered")


def test_recovery_restores_everything_and_learns_nothing() -> None:
    """Momentum and statistics led to the crash too."""
    algorithm = make(recovery_bias=0.0, recovery_episodes=1)
    best, stats = crash(algorithm)
    after = fingerprint(algorithm, without="generator")
    assert {name: after[name] for name in best if name in after} == {
        name: value for name, value in best.items() if name in after
    }
    assert (stats.restored_version, stats.policy_epochs, stats.q_fit_steps) == (4, 0, 0)
    assert stats.learning_rate == pytest.approx(algorithm.hyper.learning_rate / 2)
    assert stats.recovery is not None
    assert stats.recovery.recover
    assert stats.recovery.r_best == 100.0


def test_recovery_restores_the_networks_that_made_the_best_batch() -> None:
    """Not those that were there when it came, one update later."""
    algorithm = make(recovery_bias=0.0, recovery_episodes=1)
    first = play(algorithm, 0, score=1.0, version=1)
    made_it = fingerprint(algorithm, without="generator")
    second = play(algorithm, 1, score=100.0, version=2)
    algorithm.update(first)
    algorithm.update(second, is_behind=True)
    stats = algorithm.update(play(algorithm, 2, score=-1e6, version=3), is_behind=True)
    assert stats.restored_version == 2
    after = fingerprint(algorithm, without="generator")
    assert {n: after[n] for n in made_it if n in after} == {
        n: v for n, v in made_it.items() if n in after
    }


def test_selection_fades_to_indifference() -> None:
    """Halfway the temperature is twice that of the beginning."""
    algorithm = make()
    algorithm.update(play(algorithm, 0))
    bounds = -torch.ones(A), torch.ones(A)
    temperatures = [algorithm.suggester(*bounds, p).temperature for p in (0.0, 0.5, 1.0)]
    first = algorithm.hyper.selection_temperature
    assert temperatures == [first, 2 * first, 1000 * first]
    stays = make(anneal_selection=False)
    stays.update(play(stays, 0))
    assert stays.suggester(*bounds, 1.0).temperature == first


def test_authors_recovery_restores_the_networks_and_still_learns() -> None:
    """Their eq. 6 and gradient follow."""
    algorithm = make("authors", recovery_bias=0.0)
    best, stats = crash(algorithm)
    after = fingerprint(algorithm)
    assert after["q"] == best["q"]
    assert after["value"] == best["value"]
    assert after["adam.q.first"] != best["adam.q.first"]
    assert after["policy"] != best["policy"]
    assert (stats.q_fit_steps, stats.distil_steps, stats.policy_epochs) == (0, 50, 1)


def test_suggester_has_q_only_when_q_may_choose() -> None:
    """An untrained Q would prefer an arbitrary direction."""
    low, high = -torch.ones(A), torch.ones(A)
    untrained = make().suggester(low, high)
    assert (untrained.mode, untrained.suggestions, untrained.q_net) == ("first", 1, None)
    algorithm = make()
    algorithm.update(play(algorithm, 0))
    trained = algorithm.suggester(low, high)
    assert (trained.mode, trained.suggestions) == ("soft", 10)
    assert make("authors").suggester(low, high).mode == "hard"
    a2c = make("modern", "a2c")
    a2c.update(play(a2c, 0))
    assert a2c.suggester(low, high).mode == "first"


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"advantage": "q-v"},
        {"advantage": "return-v", "policy_loss": "score"},
        {"distil": "separate"},
        {"selection": "hard"},
    ],
    ids=str,
)
@pytest.mark.slow
def test_the_mean_action_moves_to_where_the_reward_is(options: dict[str, Any]) -> None:
    """A one-step task: reward is highest at .5 in both dimensions."""
    algorithm = make(
        **{
            "gamma": 0.01,
            "learning_rate": 3e-3,
            "critic_learning_rate": 3e-3,
            "critic_epochs": 10,
            **options,
        }
    )
    for number in range(60):
        algorithm.update(play(algorithm, number))
    obs = torch.randn(200, D, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        mean = algorithm.learned.policy(algorithm.learned.normaliser(obs))
    assert float((mean - 0.5).abs().mean()) < 0.25


def test_the_unit_of_observations_does_not_matter() -> None:
    """A millionth, about: the same weights to the bit."""
    one, other, unit = make(), make(), 2.0**-20
    seen = torch.randn(50, D)
    one.learned.normaliser.update(seen)  # before the first observation there is no unit
    other.learned.normaliser.update(unit * seen)
    for number in range(3):
        batch = play(one, number)
        one.update(batch)
        other.update(
            dataclasses.replace(batch, obs=unit * batch.obs, final_obs=unit * batch.final_obs)
        )
    assert fingerprint(one, without="normaliser") == fingerprint(other, without="normaliser")


def test_observations_of_a_billionth_are_learned_from() -> None:
    """A one-step task that needs them: who does not see is wrong by half."""
    algorithm, unit = make(gamma=0.01, learning_rate=3e-3, critic_learning_rate=3e-3), 1e-9
    for number in range(40):
        algorithm.update(play(algorithm, number, unit=unit))
    obs = unit * torch.randn(200, D, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        mean = algorithm.learned.policy(algorithm.learned.normaliser(obs))
    assert float((mean - 0.5 * obs[:, :1].sign()).abs().mean()) < 0.25


def test_weights_that_are_not_finite_are_refused() -> None:
    """They must never be published."""
    algorithm = make()
    batch = play(algorithm, 0)
    bad = dataclasses.replace(batch, reward=torch.full((80,), math.nan))
    with pytest.raises(A2SError, match="update 1: found non-finite weights, expected finite"):
        algorithm.update(bad)


def test_same_seed_same_update() -> None:
    """Every random choice comes from the seed."""
    one, two, other = make(seed=1), make(seed=1), make(seed=2)
    batch = play(one, 0)
    assert one.update(batch) == two.update(batch)
    assert fingerprint(one) == fingerprint(two)
    assert fingerprint(one)["policy"] != fingerprint(other)["policy"]
