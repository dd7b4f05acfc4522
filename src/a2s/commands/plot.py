"""``a2s plot``: learning curves as the paper draws them (its figure 4)."""

import csv
import gzip
import textwrap
from pathlib import Path
from typing import Literal, get_args

import matplotlib as mpl
import numpy as np
import numpy.typing as npt

from a2s.commands.statistics import band, iqm
from a2s.learner.run import config as configuration
from a2s.learner.run.directory import CONFIG, EPISODE_COLUMNS, evaluations
from a2s.learner.run.growing_table import whole_lines
from a2s.protocol.errors import RunDirectoryError, UsageError, nearest

mpl.use("agg")

from matplotlib import pyplot as plt

_POINTS = 100
_WINDOW = 3
_LETTERS = 64  # in the legend of a panel

Axis = Literal["steps", "time"]
_COLUMN: dict[Axis, str] = {"steps": "env_steps", "time": "wall_s"}
_NAMES: dict[Axis, str] = {"steps": "environment steps", "time": "seconds"}
# Options of a run besides its hyperparameters: without them runs are not alike.
_OF_ENVIRONMENT = ("action_repeat", "frame_stack", "max_episode_steps")
_OF_LEARNING = ("clock", "prior", "prior_share")
_LEAST_SEEDS = 3  # for an interval
Curve = npt.NDArray[np.float64]
# By environment, which has no ": ", or "environment: metric", then by way of learning: steps and
# values of each seed.
Panels = dict[str, dict[str, list[tuple[Curve, Curve]]]]


def read_curve(
    episodes: Path, what: str = "return", axis: str = "env_steps"
) -> tuple[Curve, Curve]:
    """Read a column of an ``episodes.csv``, or of an ``episodes.csv.gz``.

    Returns:
        Environment steps, or what else ``axis`` names, and value of every finished episode that has
        one, each ``[E]``.

    Raises:
        UsageError: The file cannot be read, or no episode has ended yet.
    """
    opened = gzip.open if episodes.suffix == ".gz" else open
    try:
        with opened(episodes, "rt", newline="") as file:
            table = csv.DictReader(whole_lines(file))
            rows = [(float(r[axis]), float(r[what])) for r in table if r[what]]
    except (OSError, KeyError, ValueError, TypeError, csv.Error) as error:
        raise UsageError(f"{episodes}: cannot be read as the episodes of a run: {error}") from None
    if not rows:
        raise UsageError(f"{episodes}: no episode has ended yet")
    steps, returns = zip(*rows, strict=True)
    return np.array(steps, dtype=np.float64), np.array(returns)


def axis_of(name: str) -> Axis:
    """Read what curves are drawn over.

    Raises:
        UsageError: It is neither.
    """
    for axis in get_args(Axis):
        if axis == name:
            return axis  # type: ignore[no-any-return]
    raise UsageError(f"--by: found {name!r}{nearest(name, get_args(Axis))}")


def smooth(values: Curve, window: int = _WINDOW) -> Curve:
    """Average every value with its neighbours: a centred moving average, shorter at the ends."""
    reach = window // 2
    return np.array([values[max(0, i - reach) : i + reach + 1].mean() for i in range(len(values))])


def on_a_grid(curves: list[tuple[Curve, Curve]]) -> tuple[Curve, Curve]:
    """Average the episodes of each seed between the points of a common grid.

    Returns:
        Steps ``[100]``, and returns ``[S, 100]``; where a seed has no episode between two points
        of the grid, its value is interpolated. The grid ends where the first seed does, but not
        before each has an episode.
    """
    last = max(min(steps[-1] for steps, _ in curves), max(steps[0] for steps, _ in curves))
    edges = np.linspace(0.0, last, _POINTS + 1)
    centres = (edges[:-1] + edges[1:]) / 2
    binned = []
    for steps, returns in curves:
        place = np.clip(np.digitize(steps, edges) - 1, 0, _POINTS - 1)
        within = steps <= last
        total = np.bincount(place[within], weights=returns[within], minlength=_POINTS)
        count = np.bincount(place[within], minlength=_POINTS)
        filled = count > 0
        binned.append(np.interp(centres, centres[filled], total[filled] / count[filled]))
    return centres, np.array(binned)


def from_the_first(
    curves: list[tuple[Curve, Curve]], steps: Curve, values: Curve
) -> tuple[Curve, Curve]:
    """Leave out what `on_a_grid` has before any curve begins: there is nothing to draw."""
    half = (steps[1] - steps[0]) / 2
    begun = steps + half >= min(points[0] for points, _ in curves)
    return steps[begun], values[:, begun]


def plot(runs: list[Path], output: Path, axis: Axis = "steps") -> list[str]:
    """Draw the runs: one panel per environment and metric, one colour for each way of learning.

    The suffix of ``output`` decides what kind of picture it is.

    Returns:
        One line for each run that was left out, and why; the others were drawn.

    Raises:
        UsageError: No run can be drawn, or the picture cannot be written.
    """
    panels: Panels = {}
    left_out = []
    for run in runs:
        try:
            env, label = identity(run)
            episodes = run / "episodes.csv"
            curves = {env: read_curve(episodes, axis=_COLUMN[axis])}
            with episodes.open(newline="") as file:  # metrics have the columns after ours
                metrics = next(csv.reader(file), [])[len(EPISODE_COLUMNS) :]
            for metric in metrics:
                curves[f"{env}: {metric}"] = read_curve(episodes, metric, _COLUMN[axis])
            if evaluated := evaluations(run, "mean"):
                found = np.array([(getattr(e, _COLUMN[axis]), e.mean) for e in evaluated])
                curves[f"{env}: evaluation return"] = found[:, 0], found[:, 1]
        except (UsageError, RunDirectoryError) as error:
            left_out.append(str(error))
        else:
            for title, curve in curves.items():
                panels.setdefault(title, {}).setdefault(label, []).append(curve)
    if not panels:
        raise UsageError(left_out[0])
    draw(panels, output, axis)
    return left_out


def draw(panels: Panels, output: Path, axis: Axis = "steps") -> None:
    """Draw curves: every seed, their interquartile mean, and its 95 % interval.

    A label has one colour in all panels; of one or two seeds there is no interval.

    Raises:
        UsageError: The picture cannot be written.
    """
    legends = {
        title: {label: _legend(label, len(curves)) for label, curves in groups.items()}
        for title, groups in panels.items()
    }
    rows = max("\n".join(legend.values()).count("\n") + 1 for legend in legends.values())
    labels = sorted({label for groups in panels.values() for label in groups})
    size = (6 * len(panels), 4.2 + 0.25 * rows)
    figure, axes = plt.subplots(1, len(panels), figsize=size, squeeze=False, layout="constrained")
    for place, (title, groups) in zip(axes[0], sorted(panels.items()), strict=True):
        for label, curves in sorted(groups.items()):
            colour = f"C{labels.index(label)}"  # of matplotlib's cycle
            steps, returns = from_the_first(curves, *on_a_grid(curves))
            place.plot(steps, returns.T, color=colour, alpha=0.3, linewidth=0.8)
            middle = smooth(iqm(returns.T))
            dot = "o" if np.isfinite(middle).sum() == 1 else None
            place.plot(
                steps, middle, color=colour, linewidth=2.0, label=legends[title][label], marker=dot
            )
            if len(returns) >= _LEAST_SEEDS:
                low, high = map(smooth, band(returns.T))
                place.fill_between(steps, low, high, color=colour, alpha=0.15, linewidth=0.0)
        place.set_title(title)
        place.set_xlabel(_NAMES[axis])
        place.set_ylabel(f"{title.partition(': ')[2] or 'training return'} of an episode")
        place.grid(alpha=0.3)
        place.legend(loc="upper center", bbox_to_anchor=(0.5, -0.15), frameon=False)
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(output, dpi=120)
    except (OSError, ValueError) as error:
        raise UsageError(f"{output}: {error}") from None
    finally:
        plt.close(figure)


def _legend(label: str, num_seeds: int) -> str:
    """Wrap a label to the width of a panel: wider lines fall off the picture."""
    seeds = "1 seed" if num_seeds == 1 else f"{num_seeds} seeds"
    return textwrap.fill(f"{label} ({seeds})", _LETTERS, break_on_hyphens=False)


def identity(run: Path) -> tuple[str, str]:
    """Environment with how it was made, and algorithm and preset with what differs from it.

    Of a run of an earlier version, whose hyperparameters have other names, these are left out.
    """
    try:
        options, hyper = configuration.read(run / CONFIG)
    except UsageError as error:
        raise UsageError(f"{run}: is not a run directory, no usable {CONFIG}: {error}") from None
    try:
        found = configuration.assemble(options, hyper)
    except UsageError:
        found = configuration.assemble(options, {})
    of, usual = found.run, configuration.assemble({"variant": found.run.variant}, {}).run

    def unusual(names: tuple[str, ...]) -> list[str]:
        told = ((name, getattr(of, name)) for name in names)
        return [f"{name}={value}" for name, value in told if value != getattr(usual, name)]

    name = f"{of.algo if of.variant == 'on-policy' else of.variant} {of.preset}"
    env = Path(of.env).name if ".py:" in of.env else of.env
    changed = [f"{k}={v}" for k, v in found.changed().items()]
    made = " ".join([env, *of.env_kwargs, *of.wrappers, *unusual(_OF_ENVIRONMENT)])
    begun = ["init_from"] if of.init_from else []  # each seed may have its own
    learned = [name, *begun, *unusual(_OF_LEARNING), *changed]
    return made.replace(": ", ":"), ", ".join(learned)
