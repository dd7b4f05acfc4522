"""Whole updates, of every preset."""

import dataclasses
import json
import math
from typing import Any

import pytest
import torch
from on_policy_learners import (
    BOUNDS,
    D,
    crash,
    fingerprint,
    make,
    make_a2c,
    make_preset,
    mean_action,
    play,
)

from a2s.learner.on_policy.presets import PRESETS
from a2s.learner.on_policy.update import OnPolicy
from a2s.protocol.errors import A2SError


@pytest.mark.parametrize("preset", PRESETS)
def test_a2c_is_a2s_with_one_suggestion_to_the_bit(preset: str) -> None:
    """There is one path through the code."""
    options: dict[str, Any] = {"suggestions": 1, "recovery": "off"}
    options |= {} if preset == "modern" else {"advantage": "return-v", "distil": "off"}
    a2c, a2s = make_a2c(preset), make_preset(preset, **options)
    for number in range(3):
        batch = play(a2c, number)
        assert a2c.update(batch) == a2s.update(batch)
    assert fingerprint(a2c) == fingerprint(a2s)


@pytest.mark.parametrize(
    ("preset", "options"), [("modern", {"pull": 0.0}), ("authors", {"distil": "off"})]
)
def test_fitting_q_touches_neither_policy_nor_value(preset: str, options: dict[str, Any]) -> None:
    """On the same batches A2S without eq. 5 and 6 has the policy and value of A2C, to the bit."""
    a2c = make_a2c(preset)
    a2s = make_preset(preset, recovery="off", **options)
    for number in range(3):
        batch = play(a2c, number)
        of_a2c, of_a2s = a2c.update(batch), a2s.update(batch)
        assert (of_a2c.q_fit_steps, of_a2c.q_loss) == (0, 0.0)
        assert of_a2s.q_fit_steps > 0
        assert of_a2s.value_fit_steps == of_a2c.value_fit_steps > 0
    a2c_state, a2s_state = fingerprint(a2c), fingerprint(a2s)
    for name in ("policy", "value", "normaliser.mean", "adam.policy.second", "generator.order"):
        assert a2c_state[name] == a2s_state[name]
    assert a2c_state.get("q") != a2s_state["q"]


def test_a_q_that_is_not_known_to_be_worth_anything_changes_nothing() -> None:
    """A first update is A2C's to the bit: nothing was seen of Q's opinion."""
    a2c, a2s = make_a2c(), make(recovery="off")
    batch = play(a2c, 0)
    a2c.update(batch)
    assert a2s.update(batch).pull_strength == 0.0
    assert fingerprint(a2c)["policy"] == fingerprint(a2s)["policy"]


@pytest.mark.parametrize(
    ("preset", "options"),
    [
        ("modern", {}),
        ("modern", {"window_steps": 100}),
        ("modern", {"lr_rule": "kl", "recovery_bias": 0.0, "recovery_episodes": 3}),
        ("authors", {}),
        ("paper", {"recovery_bias": 0.0}),
    ],
)
def test_stopping_and_going_on_changes_nothing(preset: str, options: dict[str, Any]) -> None:
    """The state goes through JSON; the scores crash so that recovery is part of it.

    Every number of an update is finite: they all become columns and metrics.
    """
    scores = [10.0, 20.0, -90.0, -50.0, 5.0, -90.0]
    through = make_preset(preset, **options)
    for number, score in enumerate(scores[:3]):
        through.update(play(through, number, score, number))
    tensors, scalars = through.state()
    resumed = make_preset(preset, seed=99, **options)
    resumed.load(
        {name: tensor.clone() for name, tensor in tensors.items()}, json.loads(json.dumps(scalars))
    )
    for number, score in enumerate(scores[3:], 3):
        batch = play(through, number, score, number)
        stats = through.update(batch)
        assert stats == resumed.update(batch)
        numbers = dataclasses.asdict(stats)
        del numbers["recovery"]
        assert all(math.isfinite(number) for number in numbers.values())
    assert fingerprint(through) == fingerprint(resumed)
    assert through.state()[1] == resumed.state()[1]
    assert through.updates == 6


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
    with pytest.raises(A2SError, match="policy: found shape"):
        make(policy_sizes=(8,)).load(tensors, scalars)
    del tensors["generator.q"]
    with pytest.raises(A2SError, match=r"found no tensor 'generator\.q'.*begin a new run"):
        make().load(tensors, scalars)


def assert_restored(algorithm: OnPolicy, before: dict[str, list[float]]) -> None:
    """Everything but the random generators, and what is kept as the best, is as it was."""
    after = fingerprint(algorithm, without="generator")
    assert {n: after[n] for n in before if n in after} == {
        n: values for n, values in before.items() if n in after
    }


def test_recovery_restores_everything_and_learns_nothing() -> None:
    """Momentum and statistics led to the crash too."""
    algorithm = make(recovery_bias=0.0, recovery_episodes=1)
    best, stats = crash(algorithm)
    assert_restored(algorithm, best)
    assert (stats.restored_version, stats.policy_epochs, stats.q_fit_steps) == (4, 0, 0)
    assert stats.learning_rate == pytest.approx(algorithm.config.learning_rate / 2)
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
    assert_restored(algorithm, made_it)


def test_suggester_has_q_only_when_q_may_choose() -> None:
    """An untrained Q would prefer an arbitrary direction; the authors do not mind."""
    untrained = make().suggester(*BOUNDS)
    assert (untrained.mode, untrained.suggestions, untrained.q_net) == ("first", 1, None)
    algorithm, a2c = make(), make_a2c()
    for each in (algorithm, a2c):
        each.update(play(each, 0))
    trained = algorithm.suggester(*BOUNDS)
    assert (trained.mode, trained.suggestions) == ("soft", 10)
    assert a2c.suggester(*BOUNDS).mode == "first"
    assert make_preset("authors").suggester(*BOUNDS).mode == "hard"


def test_batches_are_steps_or_whole_episodes() -> None:
    """The first is small, and at least 3 episodes and 500 steps for the authors."""
    assert make().next_batch == (256, 0)
    assert make_preset("authors").next_batch == (500, 3)


LEARNS: dict[str, Any] = {"gamma": 0.01, "learning_rate": 3e-3}


@pytest.mark.parametrize(
    ("preset", "options"),
    [
        ("modern", {}),
        ("modern", {"pull": 2.0}),
        ("modern", {"policy_epochs": 1, "policy_minibatch": 0, "learning_rate": 3e-2}),
        ("paper", {"suggestions": 1, "distil": "off", "recovery": "off"}),
    ],
    ids=str,
)
def test_the_mean_action_moves_to_where_the_reward_is(preset: str, options: dict[str, Any]) -> None:
    """A one-step task: reward is highest at .5 in both dimensions."""
    critics = {"critic_learning_rate": 3e-3, "critic_epochs": 10} if preset == "modern" else {}
    algorithm = make_preset(preset, **(LEARNS | critics | options))
    for number in range(40):
        algorithm.update(play(algorithm, number))
    obs = torch.randn(200, D, generator=torch.Generator().manual_seed(0))
    assert float((mean_action(algorithm, obs) - 0.5).abs().mean()) < 0.3  # .5 at first


def test_the_unit_of_observations_does_not_matter() -> None:
    """A millionth, about: the same weights to the bit."""
    one, other, unit = make(), make(), 2.0**-20
    seen = torch.randn(50, D)
    one.normaliser.update(seen)  # before the first observation there is no unit
    other.normaliser.update(unit * seen)
    for number in range(3):
        batch = play(one, number)
        one.update(batch)
        other.update(
            dataclasses.replace(batch, obs=unit * batch.obs, final_obs=unit * batch.final_obs)
        )
    units = ("normaliser", "window", "best.normaliser")
    assert fingerprint(one, without=units) == fingerprint(other, without=units)


def test_observations_of_a_billionth_are_learned_from() -> None:
    """A one-step task that needs them: without them the mean is wrong by half."""
    algorithm, unit = make(**LEARNS, critic_learning_rate=3e-3), 1e-9
    for number in range(40):
        algorithm.update(play(algorithm, number, unit=unit))
    obs = unit * torch.randn(200, D, generator=torch.Generator().manual_seed(0))
    wrong = mean_action(algorithm, obs) - 0.5 * obs[:, :1].sign()
    assert float(wrong.abs().mean()) < 0.25


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
