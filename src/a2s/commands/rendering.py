"""What draws MuJoCo's pictures on this machine, if anything does."""

import os

from a2s.commands.process import run_apart

HELP = "apt-get install libegl1 libgl1-mesa-dri, or libosmesa6"
_BACKENDS = ("egl", "osmesa")
# Run in a child: what crashes there ends the child alone.
_DRAW = """
import gymnasium
env = gymnasium.make("Hopper-v5", render_mode="rgb_array", width=64, height=64)
env.reset(seed=0)
assert env.render().shape == (64, 64, 3)
"""


def find_backend() -> str | None:
    """The value of MUJOCO_GL with which pictures are drawn without a screen: the user's, or ours.

    ``None``: there is none.
    """
    chosen = os.environ.get("MUJOCO_GL")
    if chosen:
        return chosen
    return next((b for b in _BACKENDS if not isinstance(run_apart(_DRAW, MUJOCO_GL=b), str)), None)
