"""Gymnasium's MuJoCo environments stepped without what a run does not read (docs/adr/0035).

The same calls of MuJoCo in the same order, and the formulas of Gymnasium's `v5` environments in the
same precision, so that observation, reward and end are equal to the bit. Left out are `info`,
rendering, checks and copies, and forces that nobody looks at. Resets stay Gymnasium's.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium
import mujoco
import numpy as np
import numpy.typing as npt
from gymnasium import wrappers
from gymnasium.envs.mujoco import (
    ant_v5,
    half_cheetah_v5,
    hopper_v5,
    humanoid_v5,
    humanoidstandup_v5,
    inverted_double_pendulum_v5,
    inverted_pendulum_v5,
    pusher_v5,
    reacher_v5,
    swimmer_v5,
    walker2d_v5,
)

_COMPARED_WITH = "1.4."  # of Gymnasium: the tests compare with it

_Floats = npt.NDArray[np.float64]
_Join = Callable[[], _Floats]
_join = np.concatenate
_sum = np.add.reduce


class _Parts(NamedTuple):
    """What makes a step of one environment.

    Attributes:
        place: What a velocity is the change of.
        judge: Reward and whether it is terminal, from action and change of place.
        obs: The observation, float64 ``[D]``.
        needs_forces: Whether anything is read that MuJoCo computes after a step on request.
    """

    place: Callable[[], float]
    judge: Callable[[npt.NDArray[np.float32], float], tuple[float, bool]]
    obs: _Join
    needs_forces: bool = False


class FastSteps:
    """Steps ``env``, which has Gymnasium's own wrappers only, and counts to its time limit."""

    def __init__(self, inner: Any, parts: _Parts, limit: float) -> None:
        self._model, self._data, self._frames = inner.model, inner.data, inner.frame_skip
        self._ctrl = inner.data.ctrl
        self._place_of, self._judge, self._obs, self._needs_forces = parts
        self._limit = limit
        self.begin()

    def begin(self) -> None:
        """An episode has begun."""
        self._place, self._steps = self._place_of(), 0

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[_Floats, float, bool, bool, dict[str, float]]:
        """Make a step, as Gymnasium's does, with an empty ``info``."""
        self._ctrl[:] = action
        mujoco.mj_step(self._model, self._data, self._frames)
        if self._needs_forces:
            mujoco.mj_rnePostConstraint(self._model, self._data)
        place = self._place_of()
        reward, terminated = self._judge(action, place - self._place)
        self._place = place
        self._steps += 1
        return self._obs(), reward, terminated, self._steps >= self._limit, {}


def fast_steps(env: "gymnasium.Env[Any, Any]") -> FastSteps | None:
    """Give the fast steps of an environment; ``None``: it is none of these, wrapped or changed."""
    layer: Any = env
    limits = []
    while type(layer) in (wrappers.TimeLimit, wrappers.OrderEnforcing):
        if type(layer) is wrappers.TimeLimit:
            limits.append(layer._max_episode_steps)
        layer = layer.env
    parts_of = _PARTS.get(type(layer))
    known = gymnasium.__version__.startswith(_COMPARED_WITH)
    if parts_of is None or layer.render_mode is not None or not known or _is_changed(layer):
        return None
    return FastSteps(layer, parts_of(layer), min(limits, default=math.inf))


def _is_changed(env: Any) -> bool:
    """Whether a method of its class was replaced in this object."""
    return any(callable(found) and hasattr(type(env), name) for name, found in vars(env).items())


def _half_cheetah(env: Any) -> _Parts:
    def judge(action: Any, change: float) -> tuple[float, bool]:
        forward = env._forward_reward_weight * (change / dt)
        return forward - env._ctrl_cost_weight * _sum(np.square(action)), False

    dt = env.dt
    return _Parts(_first(env), judge, _joined(env))


def _hopper(env: Any) -> _Parts:
    def is_healthy() -> bool:
        z, angle = qpos[1], qpos[2]
        state = _join((qpos[2:], qvel))
        return bool(
            low < state.min() and state.max() < high
            and low_z < z < high_z and low_angle < angle < high_angle
        )  # fmt: skip

    qpos, qvel = env.data.qpos, env.data.qvel
    (low, high), (low_z, high_z) = env._healthy_state_range, env._healthy_z_range
    low_angle, high_angle = env._healthy_angle_range
    return _Parts(_first(env), _walking(env, is_healthy), _with_clipped_velocities(env))


def _walker2d(env: Any) -> _Parts:
    def is_healthy() -> bool:
        return bool(low_z < qpos[1] < high_z and low_angle < qpos[2] < high_angle)

    qpos = env.data.qpos
    (low_z, high_z), (low_angle, high_angle) = env._healthy_z_range, env._healthy_angle_range
    return _Parts(_first(env), _walking(env, is_healthy), _with_clipped_velocities(env))


def _walking(
    env: Any, is_healthy: Callable[[], bool], contact_cost: Callable[[], Any] | None = None
) -> Callable[[Any, float], tuple[float, bool]]:
    def judge(action: Any, change: float) -> tuple[float, bool]:
        healthy = is_healthy()
        rewards = env._forward_reward_weight * (change / dt) + healthy * env._healthy_reward
        costs = env._ctrl_cost_weight * _sum(np.square(action))
        if contact_cost is not None:
            costs = costs + contact_cost()
        return rewards - costs, not healthy and env._terminate_when_unhealthy

    dt = env.dt
    return judge


def _ant(env: Any) -> _Parts:
    def is_healthy() -> bool:
        state = _join((qpos, qvel))
        return bool(np.isfinite(state).all() and low_z <= qpos[2] <= high_z)

    def contact_cost() -> Any:
        np.maximum(forces, low, out=clipped)
        np.minimum(clipped, high, out=clipped)
        return env._contact_cost_weight * _sum(np.square(clipped), axis=None)

    qpos, qvel, forces = env.data.qpos, env.data.qvel, env.data.cfrc_ext
    (low_z, high_z), (low, high) = env._healthy_z_range, env._contact_force_range
    clipped = np.clip(forces, low, high)
    main = env.data.body(env._main_body).xpos
    seen = [clipped[1:].reshape(-1)] if env._include_cfrc_ext_in_observation else []
    judge = _walking(env, is_healthy, contact_cost)
    return _Parts(lambda: main[0], judge, _joined(env, *seen), needs_forces=True)


def _humanoid(env: Any) -> _Parts:
    def place() -> float:
        weighed = np.einsum("b,bj->j", masses, centres)
        x: float = weighed[0] / mass
        return x

    def contact_cost() -> Any:
        cost = env._contact_cost_weight * _sum(np.square(forces), axis=None)
        return np.clip(cost, low, high)

    def judge(action: Any, change: float) -> tuple[float, bool]:
        return walking(ctrl, change)

    data, masses = env.data, env.model.body_mass
    centres, mass, ctrl, forces = data.xipos, masses.sum(), data.ctrl, data.cfrc_ext
    (low, high), (low_z, high_z) = env._contact_cost_range, env._healthy_z_range
    qpos = data.qpos
    walking = _walking(env, lambda: bool(low_z < qpos[2] < high_z), contact_cost)
    return _Parts(place, judge, _humanoid_obs(env), needs_forces=True)


def _humanoid_standup(env: Any) -> _Parts:
    def judge(action: Any, change: float) -> tuple[float, bool]:
        up = qpos[2] / timestep
        effort = env._ctrl_cost_weight * _sum(np.square(ctrl))
        impact = env._impact_cost_weight * _sum(np.square(forces), axis=None)
        return up - effort - np.clip(impact, low, high) + 1, False

    qpos, ctrl, forces = env.data.qpos, env.data.ctrl, env.data.cfrc_ext
    timestep, (low, high) = env.model.opt.timestep, env._impact_cost_range
    return _Parts(_first(env), judge, _humanoid_obs(env), needs_forces=True)


def _humanoid_obs(env: Any) -> _Join:
    data = env.data
    more = {
        "cinert": data.cinert[1:], "cvel": data.cvel[1:],
        "qfrc_actuator": data.qfrc_actuator[6:], "cfrc_ext": data.cfrc_ext[1:],
    }  # fmt: skip
    seen = [part for name, part in more.items() if getattr(env, f"_include_{name}_in_observation")]
    return _joined(env, *(part.reshape(-1) for part in seen))


def _inverted_pendulum(env: Any) -> _Parts:
    def judge(action: Any, change: float) -> tuple[float, bool]:
        terminated = bool(not np.isfinite(obs()).all() or abs(qpos[1]) > 0.2)
        return int(not terminated), terminated

    qpos, qvel = env.data.qpos, env.data.qvel
    obs = _views(qpos, qvel)
    return _Parts(_first(env), judge, obs)


def _inverted_double_pendulum(env: Any) -> _Parts:
    def judge(action: Any, change: float) -> tuple[float, bool]:
        x, y = site[0], site[2]
        terminated = bool(y <= 1)
        v1, v2 = qvel[1], qvel[2]
        far = 0.01 * x**2 + (y - 2) ** 2
        fast = 1e-3 * v1**2 + 5e-3 * v2**2
        return env._healthy_reward * int(not terminated) - far - fast, terminated

    def obs() -> _Floats:
        angles, force = qpos[1:], _within(env.data.qfrc_constraint)[:1]
        return _join((qpos[:1], np.sin(angles), np.cos(angles), _within(qvel), force))

    qpos, qvel, site = env.data.qpos, env.data.qvel, env.data.site_xpos[0]
    return _Parts(_first(env), judge, obs)


def _pusher(env: Any) -> _Parts:
    def judge(action: Any, change: float) -> tuple[float, bool]:
        near = -_norm(thing - tip) * env._reward_near_weight
        far = -_norm(thing - goal) * env._reward_dist_weight
        return far + -_sum(np.square(action)) * env._reward_control_weight + near, False

    thing, tip, goal = (env.data.body(name).xpos for name in ("object", "tips_arm", "goal"))
    obs = _views(env.data.qpos[:7], env.data.qvel[:7], tip, thing, goal)
    return _Parts(_first(env), judge, obs)


def _reacher(env: Any) -> _Parts:
    def judge(action: Any, change: float) -> tuple[float, bool]:
        far = -_norm(tip - target) * env._reward_dist_weight
        return far + -_sum(np.square(action)) * env._reward_control_weight, False

    def obs() -> _Floats:
        angles = qpos[:2]
        return _join((np.cos(angles), np.sin(angles), qpos[2:], qvel[:2], (tip - target)[:2]))

    qpos, qvel = env.data.qpos, env.data.qvel
    tip, target = (env.data.body(name).xpos for name in ("fingertip", "target"))
    return _Parts(_first(env), judge, obs)


def _first(env: Any) -> Callable[[], float]:
    qpos = env.data.qpos
    return lambda: qpos[0]


def _joined(env: Any, *more: _Floats) -> _Join:
    """Join positions, but for those that the environment hides, velocities, and more."""
    return _views(_seen_positions(env), env.data.qvel, *more)


def _with_clipped_velocities(env: Any) -> _Join:
    positions, velocities = _seen_positions(env), env.data.qvel
    return lambda: _join((positions, _within(velocities)))


def _seen_positions(env: Any) -> _Floats:
    seen: _Floats = env.data.qpos[env.observation_structure["skipped_qpos"] :]
    return seen


def _views(*parts: _Floats) -> _Join:
    return lambda: _join(parts)


def _within(values: _Floats) -> _Floats:
    return np.minimum(np.maximum(values, -10.0), 10.0)


def _norm(vector: _Floats) -> Any:
    return np.sqrt(vector.dot(vector))


_PARTS: dict[type, Callable[[Any], _Parts]] = {
    ant_v5.AntEnv: _ant,
    half_cheetah_v5.HalfCheetahEnv: _half_cheetah,
    hopper_v5.HopperEnv: _hopper,
    humanoid_v5.HumanoidEnv: _humanoid,
    humanoidstandup_v5.HumanoidStandupEnv: _humanoid_standup,
    inverted_double_pendulum_v5.InvertedDoublePendulumEnv: _inverted_double_pendulum,
    inverted_pendulum_v5.InvertedPendulumEnv: _inverted_pendulum,
    pusher_v5.PusherEnv: _pusher,
    reacher_v5.ReacherEnv: _reacher,
    swimmer_v5.SwimmerEnv: _half_cheetah,
    walker2d_v5.Walker2dEnv: _walker2d,
}
