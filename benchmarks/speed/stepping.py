"""Steps without a learner, on both cores: ``python -m speed.stepping CONTENDER ENV SECONDS``.

Prints steps/s, the sum over two processes; EnvPool has two threads instead. Actions are drawn
before, uniformly; who acts draws its own.
"""

import itertools
import multiprocessing
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

CORES, ENVS, WARM_UP_S, _PATIENCE_S = 2, 8, 1.0, 120.0
_DRAWN = 4096
Step = Callable[[], int]  # makes some steps, and says how many


def _actions(space: Any, rng: np.random.Generator) -> Any:
    return rng.uniform(space.low, space.high, (_DRAWN, *space.shape)).astype(np.float32)


def gym_make(env_id: str, index: int) -> Step:
    """``gym.make(...).step``, as most programs step."""
    import gymnasium

    env: Any = gymnasium.make(env_id)
    env.reset(seed=index)
    return _stepping(env.step, env.reset, _actions(env.action_space, np.random.default_rng(index)))


def fast_path(env_id: str, index: int) -> Step:
    """The steps of an actor of a2s: `a2s.actors.environments.fast_mujoco`."""
    import gymnasium

    from a2s.actors.environments.fast_mujoco import fast_steps

    env: Any = gymnasium.make(env_id, disable_env_checker=True)
    env.reset(seed=index)
    fast = fast_steps(env)
    assert fast is not None

    def reset() -> None:
        env.reset()
        fast.begin()

    return _stepping(fast.step, reset, _actions(env.action_space, np.random.default_rng(index)))


def physics(env_id: str, index: int) -> Step:
    """MuJoCo's calls alone, from Python, on the states of such episodes; resets are Gymnasium's."""
    import gymnasium
    import mujoco

    env: Any = gymnasium.make(env_id, disable_env_checker=True)
    env.reset(seed=index)
    inner = env.unwrapped
    model, data, frames = inner.model, inner.data, inner.frame_skip
    lengths = itertools.cycle(_lengths(env_id, index))
    left = next(lengths)

    def step(action: Any) -> tuple[None, None, bool, bool, None]:
        nonlocal left
        data.ctrl[:] = action
        mujoco.mj_step(model, data, frames)
        mujoco.mj_rnePostConstraint(model, data)
        left -= 1
        return None, None, left <= 0, False, None

    def reset() -> None:
        nonlocal left
        env.reset()
        left = next(lengths)

    return _stepping(step, reset, _actions(env.action_space, np.random.default_rng(index)))


def _lengths(env_id: str, index: int) -> list[int]:
    """Lengths of episodes with drawn actions."""
    import gymnasium

    env: Any = gymnasium.make(env_id)
    env.reset(seed=index)
    found, steps = [], 0
    for action in _actions(env.action_space, np.random.default_rng(index)):
        _, _, terminated, truncated, _ = env.step(action)
        steps += 1
        if terminated or truncated:
            found.append(steps)
            steps = 0
            env.reset()
    return found or [_DRAWN]


def _stepping(step: Callable[[Any], Any], reset: Callable[[], Any], actions: Any) -> Step:
    def some() -> int:
        for action in actions[:256]:
            _, _, terminated, truncated, _ = step(action)
            if terminated or truncated:
                reset()
        return 256

    return some


def acting(env_id: str, index: int, suggestions: int = 10) -> Step:
    """What a process of actors does: suggestions, steps, segments."""
    from a2s.actors.environments.environment import Environment
    from a2s.actors.metrics import ActorMetrics
    from a2s.actors.rollout import Rollout
    from a2s.actors.suggester import Suggester
    from a2s.actors.troubles import Troubles
    from a2s.commands.bench_actor import graph
    from a2s.protocol.env_config import EnvConfig
    from a2s.protocol.messages import Notice

    environments = [Environment(EnvConfig(env_id=env_id), fast=True) for _ in range(ENVS)]
    suggester = Suggester(graph(environments[0].spaces, suggestions))
    rollout = Rollout("speed", environments, index, ActorMetrics(), Troubles())
    notice = Notice(
        generation=1, epoch=0, version=1, quota_steps=64, quota_episodes=0, num_bytes=1, sha256=""
    )

    def some() -> int:
        return sum(s.num_steps for s in rollout.play(suggester, notice, lambda: False))

    return some


def envpool(env_id: str, index: int) -> Step:
    """EnvPool with two threads, in one process."""
    import envpool as peer

    del index
    count = CORES * ENVS
    env: Any = peer.make_gymnasium(env_id, num_envs=count, num_threads=CORES)
    env.reset()
    rng, space = np.random.default_rng(0), env.action_space
    drawn = rng.uniform(space.low, space.high, (64, count, *space.shape[-1:]))

    def some() -> int:
        for action in drawn:
            env.step(action)
        return count * len(drawn)

    return some


CONTENDERS: dict[str, tuple[Callable[[str, int], Step], int]] = {  # and its processes
    "gym.make": (gym_make, CORES),
    "fast path": (fast_path, CORES),
    "physics": (physics, CORES),
    "acting, K 10": (acting, CORES),
    "EnvPool": (envpool, 1),
}


_ready: list[Any] = []  # in each process: where all of them wait for the others


def _prepare(ready: Any) -> None:
    _ready.append(ready)


def _work(name: str, env: str, index: int, seconds: float) -> float:
    some = CONTENDERS[name][0](env, index)
    begin_s = time.perf_counter()
    while time.perf_counter() - begin_s < WARM_UP_S:
        some()
    _ready[0].wait(_PATIENCE_S)
    count, begin_s = 0, time.perf_counter()
    while (spent_s := time.perf_counter() - begin_s) < seconds:
        count += some()
    return count / spent_s


def main() -> None:
    """Measure one."""
    name, env, seconds = sys.argv[1], sys.argv[2], float(sys.argv[3])
    context = multiprocessing.get_context("spawn")
    count = CONTENDERS[name][1]
    ready = context.Barrier(count)
    with ProcessPoolExecutor(count, context, _prepare, (ready,)) as pool:
        rates = [pool.submit(_work, name, env, index, seconds) for index in range(count)]
    sys.stdout.write(f"{sum(rate.result() for rate in rates)}\n")


if __name__ == "__main__":
    main()
