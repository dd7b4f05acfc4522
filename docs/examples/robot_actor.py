"""An actor for a robot of your own, written from docs/protocol.md alone: it imports no a2s.

    a2s learner --env ./robot.py:Robot --envs 1      # terminal 1
    python robot_actor.py tcp/127.0.0.1:7447         # terminal 2

It needs eclipse-zenoh, msgpack, numpy and onnxruntime, which exist for other languages too. Numbers
in brackets are the steps of "The life of an actor". It plays one robot, cart.py, and sends each
segment before it goes on, so it needs no queue. It leaves out `timeout_s`, `doing` and `metrics`.
"""

import hashlib
import json
import random
import signal
import socket
import sys
import threading
import uuid
from typing import Any

import msgpack
import numpy as np
import numpy.typing as npt
import onnxruntime
import zenoh
from cart import HIGH, LOW, NAME, OBS_SIZE, Robot

Array = npt.NDArray[np.float32]
Message = dict[str, Any]
LARGEST, MAX_USELESS = 1e10, 10
MAX_ROWS = (15 << 20) // (4 * (OBS_SIZE + len(LOW) + 2))  # of a segment of 16 MiB


class Policy:
    """One version of the weights: a graph and the notice that describes it."""

    def __init__(self, notice: Message, graph: bytes) -> None:
        self.notice = notice
        self._graph = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
        self._noise = {i.name: [1, *i.shape[1:]] for i in self._graph.get_inputs()[1:]}

    def __call__(self, obs: Array, rng: np.random.Generator) -> list[Array]:
        """Choose as in training: action, suggestion, log_prob."""
        draw: dict[str, Any] = {"normal": rng.standard_normal, "gumbel": rng.gumbel}
        noise = {n: draw[n](size=size).astype(np.float32) for n, size in self._noise.items()}
        found = self._graph.run(["action", "suggestion", "log_prob"], {"obs": obs[None], **noise})
        return [output[0] for output in found]


def packed(kind: str, **fields: object) -> bytes:
    """Write a message."""
    return bytes(msgpack.packb({"a2s": 2, "kind": kind, **fields}))


def array(numbers: object) -> Message:
    """Write an array of numbers."""
    found = np.asarray(numbers, "<f4")
    return {"dtype": "<f4", "shape": list(found.shape), "data": found.tobytes()}


def usable(numbers: npt.ArrayLike) -> bool:
    """Whether numbers are finite and not too large."""
    return bool(np.all(np.abs(numbers) <= LARGEST))


class Actor:
    """A member of a run from its hello to its leave."""

    def __init__(self, endpoint: str, run: str) -> None:
        self.ended = threading.Event()
        self._prefix, self._name = f"a2s/2/{run}", f"{socket.gethostname()}-{uuid.uuid4().hex[:8]}"
        self._heard = threading.Condition()
        self._newest = (0, 0)  # generation and version of the newest notice that was heard
        self._claim = (0, 0)  # generation and epoch of the same, or of an Ack, until it was asked
        self._session = self._open(endpoint)  # [1]
        live, notice = f"{self._prefix}/live/actor/{self._name}", f"{self._prefix}/notice"
        self._token = self._session.liveliness().declare_token(live)  # [2]
        self._notices = self._session.declare_subscriber(notice, self._on_notice)
        self._status: Message = {
            "actor": self._name, "slot": -1, "weights_version": 0, "epoch": 0, "env_steps": 0,
            "episodes": 0, "segments_sent": 0, "segments_answered": 0, "spooled_steps": 0,
            "dropped_steps": 0, "trouble": "",
        }  # fmt: skip
        self._rows: list[tuple[Array, Array, Array, float]] = []  # of the segment so far

    def _open(self, endpoint: str) -> zenoh.Session:
        config = zenoh.Config()
        retry = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}
        for key, value in {
            "mode": "client", "connect/endpoints": [endpoint], "connect/retry": retry,
            "scouting/multicast/enabled": False, "scouting/gossip/enabled": False,
            "transport/shared_memory/enabled": False,
            "transport/link/rx/max_message_size": 268435456,
        }.items():  # fmt: skip
            config.insert_json5(key, json.dumps(value))
        while True:
            try:
                return zenoh.open(config)
            except zenoh.ZError:
                self.ended.wait(0.2)

    def _on_notice(self, sample: zenoh.Sample) -> None:
        notice = msgpack.unpackb(bytes(sample.payload))
        with self._heard:
            self._newest = max(self._newest, _identity(notice))
            self._claim = max(self._claim, (notice["generation"], notice["epoch"]))
            self._heard.notify_all()

    def _ask(self, key: str, message: bytes = b"", timeout_s: float = 5.0) -> Message | None:
        for reply in self._session.get(f"{self._prefix}/{key}", payload=message, timeout=timeout_s):
            payload = b"" if reply.ok is None else bytes(reply.ok.payload)
            if payload:
                answer: Message = msgpack.unpackb(payload)
                if answer["a2s"] != 2:
                    sys.exit(f"the learner speaks protocol {answer['a2s']}, this is 2")
                return answer
        return None

    def _hello(self, **fields: object) -> Message | None:
        while not self.ended.is_set():
            answer = self._ask("hello", packed("Hello", actor=self._name, **fields))
            if answer is not None and answer["kind"] == "Refusal":  # [6]
                sys.exit(f"the learner refused this actor: {answer['reason']}")
            if answer is not None:
                self._status["slot"] = answer["slot"]
                return answer
            self.ended.wait(0.2)
        return None

    def _join(self) -> None:  # [5]
        spaces = {"obs_size": OBS_SIZE, "action_low": array(LOW), "action_high": array(HIGH)}
        self._welcome = self._hello(num_envs=1, env_id=self._env_id, spaces=spaces)
        if self._welcome and _how_made(self._welcome) != self._how_made:
            sys.exit("the learner now wants the environment made otherwise: start this actor again")
        self._rng = np.random.default_rng(self._welcome["seed"] if self._welcome else 0)
        with self._heard:
            self._newest = self._claim = (0, 0)

    def run(self) -> None:
        """Play until ended."""
        beat = threading.Thread(target=self._beat)
        try:
            told = self._hello(num_envs=0, env_id="", spaces=None)  # [3]
            if told is not None:
                beat.start()
                self._take_part(told)
        finally:
            self.ended.set()  # [11]
            if beat.ident is not None:
                beat.join()
                self._publish(leaving=True)
            self._session.close()  # type: ignore[no-untyped-call]

    def _take_part(self, told: Message) -> None:
        self._env_id, self._how_made = told["env_id"], _how_made(told)
        self._robot = Robot(told["seed"])  # [4]
        self._robot.max_steps = honoured(told) or self._robot.max_steps
        offset = told["spaces"].get("obs_offset")
        self._offset = np.frombuffer(offset["data"], "<f4") if offset else np.zeros(OBS_SIZE)
        self._join()
        self._begin_episode()
        policy: Policy | None = None
        while not self.ended.is_set() and self._welcome is not None:
            waits = self._welcome["clock"] == "lockstep"
            if policy is None or waits or self._newest > _identity(policy.notice):
                policy = self._fetch(policy, waits=waits) or policy
            if policy is not None:
                self._play(policy)

    def _fetch(self, last: Policy | None, *, waits: bool) -> Policy | None:
        """Fetch weights that are not the last; wait for them, if need be."""
        played = _identity(last.notice) if last else (0, 0)
        while not self.ended.is_set():
            self._newest = (0, 0)  # what was put before is forgotten: the learner's answer counts
            notice = self._ask("notice")
            if notice is not None and _identity(notice) != played:
                is_mine = self._welcome and notice["generation"] == self._welcome["generation"]
                if not is_mine or _identity(notice) < played:
                    self._join()  # another learner, perhaps without the past of the last one
                weights = self._ask("weights")  # [7]
                if weights is not None and _is_whole(weights):
                    found = weights["notice"]
                    self._status |= {"weights_version": found["version"], "epoch": found["epoch"]}
                    return Policy(found, weights["graph"])
            if last and not waits:
                return last
            with self._heard:  # [10]
                self._heard.wait_for(lambda: self._newest > played, timeout=1.0)
        return None

    def _begin_episode(self) -> None:
        for _ in range(MAX_USELESS):
            self._obs = self._seen(self._robot.reset())
            if usable(self._obs):
                self._return, self._length = 0.0, 0
                return
        sys.exit("the robot is broken: its first observations are not numbers")

    def _seen(self, obs: npt.NDArray[np.float64]) -> Array:
        return (obs - self._offset).astype(np.float32)

    def _play(self, policy: Policy) -> None:  # [8]
        """Play the quota of one version, unless the learner recovers or restarts."""
        notice, steps, episodes, useless = policy.notice, 0, 0, 0
        whole = notice["quota_episodes"]
        while not self.ended.is_set():
            if self._is_overruled(notice):
                break
            is_over = self._step(policy)
            useless = useless + 1 if is_over is None else 0
            if useless == MAX_USELESS:
                sys.exit("the robot is broken: what it returns is no number")
            steps, episodes = steps + (is_over is not None), episodes + bool(is_over)
            if steps >= notice["quota_steps"] and (not whole or (is_over and episodes >= whole)):
                break
        self._send(policy, terminated=False, truncated=False)

    def _is_overruled(self, notice: Message) -> bool:
        """Whether the learner has recovered or restarted, and says so itself when asked."""
        with self._heard:
            claim, self._claim = self._claim, (0, 0)
        if claim <= (notice["generation"], notice["epoch"]):
            return False
        found = self._ask("notice") or notice
        return bool(found["generation"] != notice["generation"] or found["epoch"] > notice["epoch"])

    def _step(self, policy: Policy) -> bool | None:
        """Make a step: whether it ended the episode; ``None`` if it had to be dropped."""
        action, suggestion, log_prob = policy(self._obs, self._rng)
        raw, reward, terminated, truncated = self._robot.step(action)
        obs, is_over = self._seen(raw), terminated or truncated
        if terminated and not usable(obs):
            obs = self._obs  # it is never used
        if not usable(obs) or not usable(reward):
            self._status["dropped_steps"] += 1
            self._status["trouble"] = f"{NAME}: {raw} or reward {reward} is no number"
            self._send(policy, terminated=False, truncated=True)
            self._begin_episode()
            return None
        self._rows.append((self._obs, suggestion, log_prob, reward))
        self._obs = obs
        self._return, self._length = self._return + reward, self._length + 1
        self._status["env_steps"] += 1
        if is_over or len(self._rows) == MAX_ROWS:
            self._send(policy, terminated=terminated, truncated=truncated)
        if is_over:
            self._status["episodes"] += 1
            self._begin_episode()
        return is_over

    def _send(self, policy: Policy, *, terminated: bool, truncated: bool) -> None:  # [9]
        """Send a segment, if there are steps, until it is answered."""
        if not self._rows:
            return
        columns = [list(column) for column in zip(*self._rows, strict=True)]
        obs, suggestion, log_prob, reward = map(array, columns)
        notice, seq = policy.notice, self._status["segments_sent"]
        self._status |= {"segments_sent": seq + 1, "spooled_steps": len(self._rows)}
        self._rows = []
        payload = packed(
            "Segment", actor=self._name, seq=seq, generation=notice["generation"],
            epoch=notice["epoch"], weights_version=notice["version"], env=0, obs=obs,
            suggestion=suggestion, log_prob=log_prob, reward=reward, final_obs=array(self._obs),
            terminated=terminated, truncated=truncated, episode_return=self._return,
            episode_length=self._length,
        )  # fmt: skip
        pause_s = 0.05
        while not self.ended.is_set():
            ack = self._ask("segment", payload, 3.0)
            if ack is not None and ack["verdict"] != "unknown":
                with self._heard:
                    self._claim = max(self._claim, (ack["generation"], ack["epoch"]))
                self._status["segments_answered"] += 1
                self._status["spooled_steps"] = 0
                self.ended.wait(ack["wait_s"])
                return
            if ack is not None:
                self._join()
            self.ended.wait(pause_s * random.uniform(0.5, 1.0))
            pause_s = min(2 * pause_s, 1.0)

    def _beat(self) -> None:
        while not self.ended.wait(1.0):
            self._publish(leaving=False)

    def _publish(self, *, leaving: bool) -> None:
        status = packed("ActorStatus", **{**self._status, "leaving": leaving})
        self._session.put(f"{self._prefix}/actor/{self._name}", status)


def honoured(told: Message) -> int:
    """Its limit of steps, 0 for the robot's own; it ends where the run wants something else."""
    env = told.get("env") or {"env_id": told["env_id"]}
    wanted = {"action_repeat": 1, "frame_stack": 1, "kwargs": "{}", "wrappers": []}
    refused = [key for key, value in wanted.items() if env.get(key, value) != value]
    if env["env_id"].rpartition(":")[2] != NAME or refused:
        sys.exit(f"this actor plays {NAME} as it is, not {env['env_id']} with {refused}")
    return int(env.get("max_episode_steps", 0))


def _how_made(welcome: Message) -> object:
    return welcome.get("env"), welcome["spaces"].get("obs_offset")


def _identity(notice: Message) -> tuple[int, int]:
    return notice["generation"], notice["version"]


def _is_whole(weights: Message) -> bool:
    return bool(hashlib.sha256(weights["graph"]).hexdigest() == weights["notice"]["sha256"])


if __name__ == "__main__":
    _arguments = [*sys.argv[1:], *["tcp/127.0.0.1:7447", "default"][len(sys.argv) - 1 :]]
    _actor = Actor(*_arguments)
    for _number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(_number, lambda *_: _actor.ended.set())
    _actor.run()
