"""A video has a picture of every step, as the environment drew it."""

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import numpy.typing as npt
import pytest

from a2s.commands.record import line, record_run
from a2s.protocol.errors import FaultyEnvironmentError, UsageError

MakeGraph = Callable[..., bytes]
DRAWN = """
import gymnasium
import numpy as np

class Drawn(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(self, render_mode=None, steps=5):
        self.mode, self.steps = render_mode, steps

    def reset(self, seed=None, options=None):
        self.count = 0
        return np.zeros(2), {}

    def step(self, action):
        self.count += 1
        return np.zeros(2), 1.0, self.count == self.steps, False, {}

    def render(self):
        return np.full((64, 97, 3), 40 * self.count, np.uint8) if self.mode == "rgb_array" else None
"""
BLIND = (
    DRAWN.replace('["rgb_array"]', "[]")
    .replace("def render(", "def paint(")
    .replace("self.mode, self.steps = render_mode, steps", "self.steps = steps")
)
BLANK = DRAWN.replace('if self.mode == "rgb_array"', "if self.count == 9")


@pytest.fixture
def policy(tmp_path: Path, make_graph: MakeGraph) -> Path:
    """A policy file for an environment of one number."""
    path = tmp_path / "policy.onnx"
    path.write_bytes(make_graph())
    return path


@pytest.fixture(autouse=True)
def _no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing here is drawn by MuJoCo."""
    monkeypatch.setenv("MUJOCO_GL", "egl")


def _record(policy: Path, program: str = DRAWN, **changed: Any) -> dict[str, Any]:
    file = policy.with_name("drawn.py")
    file.write_text(program)
    options = {"env": f"{file}:Drawn", "env_kwargs": changed.pop("env_kwargs", None)}
    how: dict[str, Any] = {
        "output": policy.with_name("new") / "video.mp4", "episodes": 2, "mode": "mean",
        "weights": "latest", "seed": 0, "overlay": False,
    }  # fmt: skip
    return record_run(policy, {k: v for k, v in options.items() if v}, **{**how, **changed})


def _pictures(video: Path) -> list[npt.NDArray[np.uint8]]:
    raw = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-")
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", str(video), *raw]
    decoded = subprocess.run(command, capture_output=True, check=True).stdout
    return list(np.frombuffer(decoded, np.uint8).reshape(-1, 64, 96, 3))


def test_every_step_of_every_episode_has_its_picture(policy: Path, tmp_path: Path) -> None:
    """After a last step the next episode has begun. Sides are even, which the format wants."""
    found = _record(policy)
    assert (found["frames"], found["fps"], found["returns"]) == (10, 20, [5.0, 5.0])
    pictures = _pictures(tmp_path / "new" / "video.mp4")
    brightness = [picture.mean() for picture in pictures]
    assert np.allclose(brightness, [40, 80, 120, 160, 0, 40, 80, 120, 160, 200], atol=6)
    assert line(found).endswith("video.mp4: 0 s of " + found["env"] + " (mean), return 5.0, 5.0")


def test_an_environment_that_tells_no_speed_has_the_usual_one(policy: Path) -> None:
    found = _record(policy, DRAWN.replace('"render_fps": 20', '"render_fps": None'))
    assert found["fps"] == 30


def test_what_is_known_of_the_step_stands_above_unless_it_is_not_wanted(policy: Path) -> None:
    """White letters; in another mode than the mean action there are more of them."""
    bright = {}
    for mode in ("mean", "best-of-k"):
        video = policy.with_name("new") / f"{mode}.mp4"
        _record(policy, output=video, mode=mode, overlay=True, env_kwargs=("steps=2",))
        (first, *_) = _pictures(video)
        bright[mode] = int((first[:12] > 200).sum())
        assert not (first[16:] > 200).any()
    assert bright["mean"] > 0


@pytest.mark.parametrize(
    ("changed", "error", "words"),
    [
        ({"output": Path("video.avi")}, UsageError, "expected a name that ends in .mp4"),
        ({"output": Path("/dev/null/video.mp4")}, UsageError, "--output: /dev/null: "),
        ({"program": BLIND}, UsageError, r"it draws no pictures: found render_modes \[\]"),
        ({"program": BLIND.replace("render_mode=None, ", "")}, UsageError, "it draws no pictures"),
        ({"program": BLANK}, FaultyEnvironmentError, r"a picture of shape \(\) and object, exp"),
        ({"weights": "worst"}, UsageError, "--weights: found 'worst'"),
    ],
)
def test_what_cannot_be_recorded_is_one_line(
    policy: Path, changed: dict[str, Any], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words) as caught:
        _record(policy, **changed)
    assert len(str(caught.value).splitlines()) == 1
