"""Curves: the mean over seeds with a moving average of three, from runs as they are written."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from a2s.commands.plot import (
    axis_of,
    from_the_first,
    identity,
    on_a_grid,
    plot,
    read_curve,
    smooth,
)
from a2s.protocol.errors import UsageError


def _run(
    path: Path, rows: list[tuple[int, float]], env: str = "Hopper-v5", hyper: str = ""
) -> Path:
    path.mkdir()
    config = f'[run]\nenv = "{env}"\nalgo = "a2s"\npreset = "modern"\n[hyper]\n{hyper}\n'
    (path / "config.toml").write_text(config)
    lines = [f"0,{steps},0,1,{value},5,1" for steps, value in rows]
    header = "wall_s,env_steps,actor,weights_version,return,length,terminated"
    (path / "episodes.csv").write_text("\n".join([header, *lines]) + "\n")
    return path


def test_the_moving_average_is_centred_and_shorter_at_the_ends() -> None:
    assert smooth(np.array([0.0, 3.0, 6.0, 0.0])).tolist() == [1.5, 3.0, 3.0, 3.0]


def test_the_curves_of_seeds_share_a_grid() -> None:
    """A seed with many short episodes weighs no more than one with few long ones."""
    many = np.arange(1.0, 1001.0), np.full(1000, 10.0)
    few = np.linspace(10.0, 1000.0, 100), np.full(100, 20.0)
    steps, returns = on_a_grid([many, few])
    assert np.allclose(returns, [[10.0], [20.0]])
    assert np.allclose(returns.mean(0), 15.0)
    assert (steps[0], steps[-1]) == (5.0, 995.0)


def test_a_picture_is_drawn_with_a_panel_for_each_environment(tmp_path: Path) -> None:
    rows = [(10 * i, float(i)) for i in range(1, 50)]
    runs = [_run(tmp_path / name, rows) for name in ("a", "b")]
    runs.append(_run(tmp_path / "c", rows, env="Walker2d-v5"))
    plot(runs, tmp_path / "sub" / "curves.png")
    assert (tmp_path / "sub" / "curves.png").read_bytes().startswith(b"\x89PNG")


def test_what_the_environment_told_has_a_panel_of_its_own(tmp_path: Path) -> None:
    """From the first episode that told it."""
    run = _run(tmp_path / "a", [(10 * i, float(i)) for i in range(1, 50)])
    header, first, *lines = (run / "episodes.csv").read_text().splitlines()
    told = [f"{header},is_success", f"{first},", *(f"{line},0.5" for line in lines)]
    (run / "episodes.csv").write_text("\n".join(told) + "\n")
    plot([run], tmp_path / "curves.svg")
    drawn = (tmp_path / "curves.svg").read_text()
    assert "<!-- Hopper-v5: is_success -->" in drawn
    assert "<!-- is_success of an episode -->" in drawn


def test_three_seeds_have_an_interval_and_two_have_none(tmp_path: Path) -> None:
    rows = [(10 * i, float(i)) for i in range(1, 50)]
    runs = [_run(tmp_path / name, rows) for name in "abc"]
    for count, is_there in ((2, False), (3, True)):
        plot(runs[:count], tmp_path / "curves.svg")
        drawn = (tmp_path / "curves.svg").read_text()
        assert ("FillBetweenPolyCollection" in drawn) == is_there


def test_curves_can_be_drawn_over_the_time_that_they_took(tmp_path: Path) -> None:
    run = _run(tmp_path / "a", [(10, 1.0), (20, 2.0)])
    plot([run], tmp_path / "curves.svg", axis_of("time"))
    assert "<!-- seconds -->" in (tmp_path / "curves.svg").read_text()
    with pytest.raises(UsageError, match=r"--by: found 'tim' .did you mean 'time'"):
        axis_of("tim")


def test_evaluations_while_training_have_a_panel_beside_the_returns(tmp_path: Path) -> None:
    run = _run(tmp_path / "a", [(10 * i, float(i)) for i in range(1, 50)])
    header = "wall_s,env_steps,weights_version,mode,episodes,return_mean,return_std"
    rows = [f"1,{steps},1,mean,10,{steps / 10},0" for steps in (100, 200, 300)]
    (run / "evaluations.csv").write_text("\n".join([header, *rows]) + "\n")
    plot([run], tmp_path / "curves.svg")
    drawn = (tmp_path / "curves.svg").read_text()
    assert "<!-- Hopper-v5: evaluation return -->" in drawn
    assert "<!-- evaluation return of an episode -->" in drawn


def test_nothing_is_drawn_before_the_first_evaluation() -> None:
    """One at 300 of 1,000 steps, in a grid of 100 points."""
    curves = [(np.array([300.0, 1000.0]), np.array([1.0, 2.0]))]
    steps, values = from_the_first(curves, *on_a_grid(curves))
    assert steps[0] == 295.0
    assert values.shape == (1, len(steps)) == (1, 71)
    alone = [(np.array([300.0]), np.array([1.0]))]
    assert len(from_the_first(alone, *on_a_grid(alone))[0]) == 1


def test_a_damaged_table_of_evaluations_leaves_a_run_out(tmp_path: Path) -> None:
    runs = [_run(tmp_path / name, [(10, 1.0), (20, 2.0)]) for name in ("a", "b")]
    (runs[0] / "evaluations.csv").write_text("nothing\n1\n")
    (said,) = plot(runs, tmp_path / "curves.png")
    assert "evaluations.csv line 2: expected wall_s" in said


def test_another_way_of_learning_has_another_colour_in_any_panel(tmp_path: Path) -> None:
    """Of matplotlib's cycle the first and the second, though each panel has one line only."""
    rows = [(10 * i, float(i)) for i in range(1, 50)]
    runs = [
        _run(tmp_path / "a", rows),
        _run(tmp_path / "b", rows, env="Walker2d-v5", hyper="suggestions = 4"),
    ]
    plot(runs, tmp_path / "curves.svg")
    drawn = (tmp_path / "curves.svg").read_text()
    assert "stroke: #1f77b4" in drawn
    assert "stroke: #ff7f0e" in drawn


def test_a_run_is_called_by_what_differs_from_its_preset(tmp_path: Path) -> None:
    hyper = 'suggestions = 4\npull_temperature = 0.1\nrecovery = "off"'
    run = _run(tmp_path / "a", [(10, 1.0)], hyper=hyper)
    assert identity(run) == ("Hopper-v5", "a2s modern, suggestions=4, recovery=off")


def test_a_run_is_called_by_its_options_too(tmp_path: Path) -> None:
    """With another environment, or other data, it is no seed of the same."""
    run = _run(tmp_path / "a", [(10, 1.0)], hyper="tau = 0.01")
    made = """wrappers = ['my:Wrapper={"by": 2}']\n"""
    made += "action_repeat = 2\nmax_episode_steps = 9\n"
    learned = 'variant = "off-policy"\nclock = "async"\ninit_from = "/a-0"\n'
    learned += 'prior = "/data/p"\nprior_share = 0.25\n'
    text = (run / "config.toml").read_text()
    (run / "config.toml").write_text(text.replace("[hyper]", f"{made}{learned}[hyper]"))
    assert identity(run) == (
        'Hopper-v5 my:Wrapper={"by":2} action_repeat=2 max_episode_steps=9',
        "off-policy modern, init_from, prior=/data/p, prior_share=0.25, tau=0.01",
    )
    (run / "config.toml").write_text(text.replace("[hyper]", 'clock = "async"\n[hyper]', 1))
    assert identity(run)[1].startswith("a2s modern, clock=async")


def test_a_run_with_many_settings_fits_into_its_picture(tmp_path: Path) -> None:
    """Matplotlib warns, which is an error here, where a legend leaves no room for the curves."""
    settings = {
        "suggestions": 4, "pull_temperature": 2.5, "gamma": 0.97,
        "learning_rate": 0.000123,
        "critic_learning_rate": 0.000456, "policy_sizes": [100, 100, 100], "recovery_bias": 0.4,
        "q_sizes": [100, 100, 100], "recovery_episodes": 7, "recovery_cool_down": 9,
        "window_steps": 1100,
    }  # fmt: skip
    hyper = "\n".join(f"{name} = {value}" for name, value in settings.items())
    rows = [(10 * i, float(i)) for i in range(1, 50)]
    runs = [_run(tmp_path / "a", rows, hyper=hyper), _run(tmp_path / "b", rows, env="Walker2d-v5")]
    plot(runs, tmp_path / "curves.svg")
    drawn = (tmp_path / "curves.svg").read_text()
    assert all(f"{name}=" in drawn for name in settings)


def test_a_run_of_an_earlier_version_is_drawn_without_its_settings(tmp_path: Path) -> None:
    """Its hyperparameters had other names."""
    run = _run(tmp_path / "a", [(10, 1.0)], hyper="temperature = 2.0\nnormalise_obs = true")
    assert identity(run) == ("Hopper-v5", "a2s modern")


def test_an_off_policy_run_is_called_by_its_own_preset(tmp_path: Path) -> None:
    run = _run(tmp_path / "a", [(10, 1.0)], hyper="tau = 0.01")
    file = run / "config.toml"
    file.write_text(file.read_text().replace("[hyper]", 'variant = "off-policy"\n[hyper]'))
    assert identity(run) == ("Hopper-v5", "off-policy modern, tau=0.01")
    plot([run], tmp_path / "curves.png")


def test_runs_that_cannot_be_drawn_are_left_out_and_named(
    tmp_path: Path, a2s: Callable[..., tuple[int, str, str]]
) -> None:
    """The others are in the picture; it is no failure."""
    good = _run(tmp_path / "a", [(10, 1.0), (20, 2.0)])
    empty, none, damaged = _run(tmp_path / "b", []), tmp_path / "c", _run(tmp_path / "d", [])
    with (damaged / "episodes.csv").open("a") as file:
        file.write("0,ten,0,1,2.0,5,1\n")
    code, out, err = a2s("plot", empty, good, none, damaged, "-o", "curves.png")
    assert (code, out) == (0, "curves.png\n")
    first, second, third = err.splitlines()
    assert first == f"a2s: left out: {empty}/episodes.csv: no episode has ended yet"
    assert second.startswith(f"a2s: left out: {none}: is not a run directory, no usable config")
    assert third.startswith(f"a2s: left out: {damaged}/episodes.csv: cannot be read as the episod")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    code, _, err = a2s("plot", empty, "-o", "none.png")
    assert (code, err) == (2, f"a2s: {empty}/episodes.csv: no episode has ended yet\n")
    assert not (tmp_path / "none.png").exists()


def test_a_picture_without_a_suffix_is_told_by_its_whole_name(
    tmp_path: Path, a2s: Callable[..., tuple[int, str, str]]
) -> None:
    run = _run(tmp_path / "a", [(10, 1.0), (20, 2.0)])
    assert a2s("plot", run, "-o", "curves") == (0, "curves.png\n", "")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")


def test_a_seed_that_begins_where_another_ends_is_drawn_too() -> None:
    """The grid reaches to the first episode of each; the shorter one stays where it ended."""
    short = np.array([10.0]), np.array([1.0])
    late = np.array([500.0, 900.0]), np.array([5.0, 9.0])
    steps, returns = on_a_grid([short, late])
    assert steps[-1] == 497.5
    assert np.allclose(returns, [[1.0], [5.0]])


def test_a_torn_row_is_no_episode(tmp_path: Path) -> None:
    """What a full disk has left of a return is another return."""
    run = _run(tmp_path / "a", [(10, -1.0)])
    with (run / "episodes.csv").open("a") as file:
        file.write("0,20,0,1,-12")
    steps, returns = read_curve(run / "episodes.csv")
    assert (steps.tolist(), returns.tolist()) == ([10.0], [-1.0])


def test_a_picture_of_an_unknown_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"curves.nope"):
        plot([_run(tmp_path / "b", [(1, 1.0)])], tmp_path / "curves.nope")
