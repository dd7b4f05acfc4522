"""A video of episodes with a fixed policy, made in a process of its own."""

import contextlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from a2s.actors.children import Report, ask_child
from a2s.actors.environments.environment import Environment
from a2s.actors.evaluation import Episodes, Played, make_environments, read_policy
from a2s.actors.parent import Parent, answer
from a2s.actors.suggester import Mode, Suggester
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import FaultyEnvironmentError, UsageError

Picture = npt.NDArray[np.uint8]
_MODE = "rgb_array"
_FRAMES_PER_S = 30  # where an environment does not say
_SHADOW_PIXELS = 1024  # a side; MuJoCo's 4096 take most of the time without a graphics card
_LETTERS_PER_LINE = 32.0
_BLOCK = 2  # a side of a picture must be a multiple of it


def record(
    policy: Path,
    mode: Mode,
    config: EnvConfig,
    *,
    output: Path,
    episodes: int,
    seed: int,
    overlay: bool,
    on_words: Callable[[str], None],
    proceed: Callable[[], bool],
) -> Report:
    """Play whole episodes in another process, and write them as a video (H.264 in MP4).

    The file is there once it is whole; another of that name is kept until then.

    ``seed`` and ``proceed`` are as in `evaluate`; with ``overlay`` the pictures have the steps, the
    return so far, and by how much Q finds its best suggestion better than their mean.

    Returns:
        ``frames``, ``fps``, and ``returns`` of the episodes; empty where ``proceed`` ended it.

    Raises:
        UsageError: The environment draws no pictures, or the file cannot be written.
        FaultyEnvironmentError: The environment raised, hung or died.
    """
    drawing = json.dumps({**json.loads(config.kwargs), "render_mode": _MODE})
    partial = output.with_name(f".{output.stem}.partial{output.suffix}")
    try:
        found = ask_child(
            __name__, replace(config, kwargs=drawing), on_words, proceed,
            policy=str(policy), mode=mode, output=str(partial), episodes=episodes, seed=seed,
            overlay=overlay,
        )  # fmt: skip
        if found:
            partial.rename(output)
        return found
    except OSError as error:
        raise UsageError(f"{output}: {error.strerror}") from None
    finally:
        partial.unlink(missing_ok=True)


def _record(parent: Parent) -> None:
    task: dict[str, Any] = parent.task
    policy = read_policy(Path(task["policy"]), task["mode"])
    config = EnvConfig.from_json(task["env"])
    try:
        (environment,) = make_environments(config, policy.metadata, 1, parent.activity)
        _draw_quickly(environment)
        played = Episodes(policy, [environment], task["episodes"], task["seed"])
        first = environment.picture()
    except FaultyEnvironmentError as error:
        modes = _modes(config, policy, parent)
        if _MODE in modes:
            raise
        raise UsageError(
            f"environment {config.env_id}: it draws no pictures: found render_modes {modes} in its "
            f"metadata, expected {_MODE!r} among them, and a render() that gives one"
        ) from error
    told = getattr(environment.unwrapped, "metadata", {}).get("render_fps") or _FRAMES_PER_S
    fps, frames = max(1.0, told / config.action_repeat), 0
    with contextlib.closing(_Video(Path(task["output"]), first, fps)) as video:
        for choice in played.rounds():
            picture = environment.picture()
            if task["overlay"]:
                q_spread = 0.0 if task["mode"] == "mean" else float(choice.q_spread[0])
                picture = _with_text(picture, _words(played.now(0), q_spread))
            video.add(picture)
            frames += 1
    returns = played.evaluation().returns
    parent.report({"result": {"frames": frames, "fps": fps, "returns": returns}})
    environment.close()


def _modes(config: EnvConfig, policy: Suggester, parent: Parent) -> list[str]:
    """The render modes of an environment that was made for none."""
    kwargs = json.loads(config.kwargs)
    del kwargs["render_mode"]
    plain = replace(config, kwargs=json.dumps(kwargs))
    (environment,) = make_environments(plain, policy.metadata, 1, parent.activity)
    environment.close()
    return list(getattr(environment.unwrapped, "metadata", {}).get("render_modes", []))


def _words(now: Played, q_spread: float) -> str:
    words = f"step {now.length}   return {now.episode_return:.0f}"
    return words if q_spread == 0.0 else f"{words}   best Q - mean Q {q_spread:.2g}"


def _draw_quickly(environment: Environment) -> None:
    """Have MuJoCo draw small shadows and smooth no edges, which is four times as fast here."""
    with contextlib.suppress(AttributeError):  # it is not MuJoCo's
        quality = environment.unwrapped.model.vis.quality
        quality.shadowsize, quality.offsamples = _SHADOW_PIXELS, 0


class _Video:
    """A file of pictures, all as large as the first; it is whole once it is closed."""

    def __init__(self, output: Path, first: Picture, fps: float) -> None:
        import imageio_ffmpeg

        self._output = output
        self._height, self._width = (side - side % _BLOCK for side in first.shape[:2])
        self._encoder = imageio_ffmpeg.write_frames(
            str(output), (self._width, self._height), fps=fps, macro_block_size=_BLOCK,
            ffmpeg_log_level="error",
        )  # fmt: skip
        self._encoder.send(None)

    def add(self, picture: Picture) -> None:
        """Append a picture.

        Raises:
            UsageError: The file cannot be written.
        """
        try:
            self._encoder.send(np.ascontiguousarray(picture[: self._height, : self._width]))
        except OSError as error:
            words = str(error).strip().splitlines() or ["no reason given"]
            raise UsageError(f"{self._output}: cannot be written: {words[-1]}") from None

    def close(self) -> None:
        self._encoder.close()


def _with_text(picture: Picture, words: str) -> Picture:
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(picture)
    size = max(10.0, picture.shape[1] / _LETTERS_PER_LINE)
    draw, font, place = ImageDraw.Draw(image), ImageFont.load_default(size), (size / 2, size / 3)
    draw.rectangle(draw.textbbox(place, words, font=font), fill=(0, 0, 0))
    draw.text(place, words, font=font, fill=(255, 255, 255))
    return np.asarray(image)


if __name__ == "__main__":
    answer(_record)
