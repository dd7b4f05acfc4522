"""Progress: plain lines say all there is; the picture says why it waits."""

import io
from dataclasses import replace

from rich.console import Console

from a2s.learner.run.progress import LiveView, PlainView, Progress, sparkline, thin

NOW = Progress(
    env_steps=2048, total_steps=10_000, episodes=12, return_mean=103.25, return_best=211.0,
    updates=1, weights_version=2, recoveries=0, actors=2, num_envs=16, waiting_for="", wall_s=2.0,
    kl=0.0123,
)  # fmt: skip


def test_a_plain_line_has_every_number() -> None:
    out = io.StringIO()
    PlainView(out).show(replace(NOW, waiting_for="segments of version 2 from actors [1]"))
    assert out.getvalue() == (
        "steps=2048 steps_per_s=0 return=103.2 best=211.0 episodes=12 version=2 recoveries=0 "
        "actors=2 waiting_for='segments of version 2 from actors [1]'\n"
    )


def test_tiny_returns_are_not_0() -> None:
    out = io.StringIO()
    PlainView(out).show(replace(NOW, return_mean=-3.21e-6, return_best=None))
    assert " return=-3.21e-06 best=- " in out.getvalue()


def test_lines_come_every_few_seconds_not_at_every_call() -> None:
    out = io.StringIO()
    view = PlainView(out)
    for step in range(100):
        view.show(replace(NOW, env_steps=step))
    assert out.getvalue().count("\n") == 1


def test_the_picture_shows_the_numbers_and_the_curve() -> None:
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=100)
    view = LiveView(console, "hopper")
    view.show(NOW)
    view.close()
    text = out.getvalue()
    for expected in ("hopper", "2,048 of 10,000", "103.2", "2 with 16 environments", "0.0123"):
        assert expected in text


def test_a_curve_keeps_its_shape_in_bounded_space() -> None:
    points: list[float] = []
    for value in range(10_000):
        points = thin([*points, float(value)])
    assert len(points) <= 120
    assert points[-1] == 9999.0
    assert points == sorted(points)
    assert sparkline([0.0, 1.0, 2.0]) == " ▄█"
    assert len(sparkline(points)) <= 60
