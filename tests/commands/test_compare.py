"""Comparing runs: groups as a reader would make them, figures as by hand."""

from pathlib import Path

import pytest

from a2s.commands.compare import compare_runs, page, worth_of
from a2s.protocol.errors import UsageError


def _run(
    path: Path,
    height: float,
    hyper: str = "",
    *,
    evaluated: bool = False,
    env: str = "Hopper-v5",
    seed: int = 0,
) -> Path:
    """A run whose training returns rise to a height in 1,000 steps, evaluated at twice that."""
    path.mkdir()
    (path / "config.toml").write_text(f'[run]\nenv = "{env}"\nseed = {seed}\n[hyper]\n{hyper}\n')
    lines = [f"0,{s},0,1,{height * s / 1000},5,1" for s in (100, 500, 950, 1000)]
    header = "wall_s,env_steps,actor,weights_version,return,length,terminated"
    (path / "episodes.csv").write_text("\n".join([header, *lines]) + "\n")
    if evaluated:
        header = "wall_s,env_steps,weights_version,mode,episodes,return_mean,return_std"
        rows = [f"1,{s},1,mean,10,{2 * height},0" for s in (200, 400, 600, 800, 1000)]
        rows += ["1,1000,1,best-of-k,10,9999,0"]
        (path / "evaluations.csv").write_text("\n".join([header, *rows]) + "\n")
    return path


def test_a_run_is_worth_its_mean_height_and_its_end(tmp_path: Path) -> None:
    """A straight line from 100 at 100 steps to 1,000 at 1,000; its last tenth begins after 900."""
    run = _run(tmp_path / "a", 1000.0, evaluated=True)
    assert worth_of(run, evaluated=False) == (550.0, 975.0)
    assert worth_of(run, evaluated=True) == (2000.0, 2000.0)


def test_runs_are_grouped_by_how_they_learned_and_compared_with_the_first(tmp_path: Path) -> None:
    ours = [_run(tmp_path / f"a{i}", height, evaluated=True) for i, height in enumerate((20, 30))]
    theirs = [
        _run(tmp_path / f"b{i}", height, "suggestions = 4", evaluated=True)
        for i, height in enumerate((10.0, 10.0))
    ]
    first, second = compare_runs([theirs[0], *ours, theirs[1]])
    assert (first["label"], first["seeds"]) == ("a2s modern, suggestions=4", 2)
    assert first["of"] == "evaluations"
    assert first["final"] == {"iqm": 20.0, "low": 20.0, "high": 20.0}
    assert (second["label"], second["final"]["iqm"]) == ("a2s modern", 50.0)
    found = second["final"]
    assert (found["difference"], found["ratio"]) == (30.0, 2.5)
    assert (found["difference_low"], found["difference_high"]) == (20.0, 40.0)
    assert found["probability_of_improvement"] == 1.0
    said = page([first, second])
    assert said.startswith(
        "Hopper-v5, by evaluations\n  a2s modern, suggestions=4 (2 seeds, 1,000 steps)\n"
    )
    assert "50.0 [40.0, 60.0]   +30 [+20, +40] from the first" in said
    assert "so few seeds says little" in said


def test_where_one_was_not_evaluated_the_returns_of_training_count(tmp_path: Path) -> None:
    """Each environment by itself."""
    runs = [
        _run(tmp_path / "a", 10.0, evaluated=True),
        _run(tmp_path / "b", 0.0, "suggestions = 4"),
        _run(tmp_path / "c", 10.0, evaluated=True, env="Walker2d-v5"),
    ]
    first, second, other = compare_runs(runs)
    assert (first["of"], other["of"]) == ("training", "evaluations")
    assert second["final"]["ratio"] == 0.0
    assert compare_runs(runs[1::-1])[1]["final"]["ratio"] is None  # of nothing


def test_runs_that_are_no_sample_are_named(tmp_path: Path) -> None:
    """Of the same seed, or shorter than others."""
    runs = [_run(tmp_path / f"a{seed}", 10.0, seed=seed) for seed in (1, 2)]
    found = compare_runs(runs)
    assert found[0]["seed"] == [1, 2]
    assert "same seed" not in page(found)
    assert "other lengths" not in page(found)
    runs.append(_run(tmp_path / "again", 10.0, seed=2))
    with (runs[0] / "episodes.csv").open("a") as file:
        file.write("0,1200,0,1,10,5,1\n")
    found = compare_runs(runs)
    assert "some runs have the same seed" in page(found)
    assert "runs of other lengths are not alike" in page(found)


def test_a_run_is_as_long_as_it_has_learned(tmp_path: Path) -> None:
    """After the last whole episode it may have made short ones."""
    runs = [_run(tmp_path / name, 10.0, f"gamma = 0.{name}") for name in ("8", "9")]
    for run, steps in zip(runs, (1000, 1150), strict=True):
        rows = f"update,wall_s,env_steps\n1,0,500\n2,1,{steps}\n"
        (run / "updates.csv").write_text(rows)
    with (runs[0] / "episodes.csv").open("a") as file:
        file.write("0,1150,0,1,10,5,1\n")
    found = compare_runs(runs)
    assert [each["env_steps"] for each in found] == [[1150], [1150]]
    assert "other lengths" not in page(found)


def test_a_run_counts_once(tmp_path: Path) -> None:
    run = _run(tmp_path / "a", 1.0)
    with pytest.raises(UsageError, match="found a run twice"):
        compare_runs([run, tmp_path / "." / "a"])


def test_what_is_not_finite_is_no_number(tmp_path: Path) -> None:
    (found,) = compare_runs([_run(tmp_path / "a", float("nan"))])
    assert found["final"] == {"iqm": None, "low": None, "high": None}
    assert "no finite number" in page([found])


def test_what_is_no_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="is not a run directory"):
        compare_runs([tmp_path])
