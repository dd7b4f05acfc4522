"""``a2s export``: a folder with the policy of a run that works without a2s."""

import json
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from a2s import __version__
from a2s.actors.evaluation import read_policy, trained_on
from a2s.commands.evaluate import policy_of
from a2s.learner.numerals import written
from a2s.protocol.env_config import EnvConfig, wrapper_of
from a2s.protocol.errors import UsageError

_REGISTERED = re.compile(r"-v\d+$")
POLICY, PYTHON, JAVASCRIPT, CARD = "policy.onnx", "rollout.py", "act.mjs", "README.md"


def export_run(run: Path, output: Path, weights: str) -> list[Path]:
    """Write the policy, two programs that use it, and a model card.

    Returns:
        The files.

    Raises:
        UsageError: There is no policy, it does not say its environment, or the folder is in use.
    """
    path = policy_of(run, weights)
    metadata = read_policy(path, "mean").metadata
    config = trained_on(str(path), metadata)
    if config is None:
        raise UsageError(f"{path}: its metadata name no environment")
    try:
        output.mkdir(parents=True)
        shutil.copyfile(path, output / POLICY)
        (output / PYTHON).write_text(_python(config, metadata))
        (output / JAVASCRIPT).write_text(_javascript(metadata))
        (output / CARD).write_text(_card(config, metadata, _summary(run)))
    except FileExistsError:
        raise UsageError(f"--output: {output} exists; name a new folder") from None
    except OSError as error:
        raise UsageError(f"--output: {output}: {error.strerror}") from None
    return [output / name for name in (POLICY, PYTHON, JAVASCRIPT, CARD)]


def _summary(run: Path) -> dict[str, Any]:
    """The summary of a run that has ended; empty otherwise."""
    try:
        found = json.loads((run / "summary.json").read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _python(config: EnvConfig, metadata: Mapping[str, str]) -> str:
    """An episode by the mean action, with the environment as the run had it."""
    imports, making = _making(config)
    seen = "gym.spaces.flatten(env.observation_space, obs)"
    joined = "np.concatenate(rows)"
    if "obs_offset" in metadata:
        joined = f"({joined} - np.array({metadata['obs_offset']}))"
    step = (
        "obs, reward, terminated, truncated, _ = env.step(action.reshape(env.action_space.shape))"
    )
    count = "episode_return, over = episode_return + float(reward), terminated or truncated"
    steps = [f"    {step}", f"    {count}"]
    if config.action_repeat > 1:
        steps = [
            f"    for _ in range({config.action_repeat}):",
            *(f"    {line}" for line in steps),
            "        if over:",
            "            break",
        ]
    stack = config.frame_stack
    first, following = f"[{seen}]", f"[{seen}]"
    if stack > 1:
        first, following = f"{first} * {stack}", f"[*rows[1:], {seen}]"
    return "\n".join(
        [
            '"""An episode by the mean action of policy.onnx; it needs no a2s."""',
            "",
            *imports,
            "",
            'policy = onnxruntime.InferenceSession("policy.onnx")',
            "noise = {i.name: np.zeros([1, *i.shape[1:]], np.float32)"
            " for i in policy.get_inputs()[1:]}",
            *making,
            "obs, _ = env.reset(seed=0)",
            f"rows, episode_return, over = {first}, 0.0, False",
            "while not over:",
            f"    seen = {joined}[None].astype(np.float32)",
            '    (action,) = policy.run(["action"], {"obs": seen, **noise})',
            *steps,
            f"    rows = {following}",
            'print(f"return {episode_return:.1f}")',
            "",
        ]
    )


def _making(config: EnvConfig) -> tuple[list[str], list[str]]:
    """Imports, and the lines that make the environment."""
    imports = ["import gymnasium as gym", "import numpy as np", "import onnxruntime"]
    place, _, name = config.env_id.rpartition(":")
    arguments = [f"{key}={value!r}" for key, value in json.loads(config.kwargs).items()]
    if place.endswith(".py"):
        imports += ["import sys", f"sys.path.insert(0, {str(Path(place).parent)!r})"]
        place = Path(place).stem
    if place and not _REGISTERED.search(name):
        imports.append(f"from {place} import {name}")
        lines = [f"env = {name}({', '.join(arguments)})"]
        if config.max_episode_steps:
            lines.append(f"env = gym.wrappers.TimeLimit(env, {config.max_episode_steps})")
    else:
        imports += [f"import {place}  # registers the environment"] if place else []
        if config.max_episode_steps:
            arguments.append(f"max_episode_steps={config.max_episode_steps}")
        lines = [f"env = gym.make({', '.join([repr(name), *arguments])})"]
    for setting in config.wrappers:
        module, wrapper, given = wrapper_of(setting)
        imports.append(f"from {module} import {wrapper}")
        lines.append(f"env = {wrapper}(env, **{given!r})")
    return imports, lines


def _javascript(metadata: Mapping[str, str]) -> str:
    """The mean action for one observation, in Node or a browser."""
    return "\n".join(
        [
            "// npm install onnxruntime-web; node act.mjs: the mean action for one observation",
            'import { readFile } from "node:fs/promises";',
            'import * as ort from "onnxruntime-web";',
            "",
            'const policy = await ort.InferenceSession.create(await readFile("policy.onnx"));',
            f"const obs = new Float32Array({metadata['obs_size']}); // as the environment gives it",
            f"const [K, A] = [{metadata['K']}, {metadata['action_size']}];",
            "const noise = { normal: [1, K, A], gumbel: [1, K] }; // zeros: the mean action",
            'const feed = { obs: new ort.Tensor("float32", obs, [1, obs.length]) };',
            "for (const name of policy.inputNames.slice(1)) {",
            "  const size = noise[name].reduce((a, b) => a * b);",
            '  feed[name] = new ort.Tensor("float32", new Float32Array(size), noise[name]);',
            "}",
            "const { action } = await policy.run(feed);",
            "console.log(Array.from(action.data));",
            "",
        ]
    )


def _card(config: EnvConfig, metadata: Mapping[str, str], summary: Mapping[str, Any]) -> str:
    """A model card as model hubs read it."""
    found = summary.get("evaluation") or {}
    score = f"{found['mean']:.2f} +/- {found['std']:.2f}" if found else ""
    low, high = metadata["action_low"], metadata["action_high"]
    lines = [
        "---",
        "library_name: a2s",
        f"tags: [{config.env_id.rpartition(':')[2]}, reinforcement-learning, a2s, onnx]",
    ]
    if found:
        lines += [
            "model-index:",
            f"- name: {summary['algo']}",
            "  results:",
            "  - task: {type: reinforcement-learning, name: reinforcement-learning}",
            f"    dataset: {{name: {config.env_id}, type: {config.env_id}}}",
            f"    metrics: [{{type: mean_reward, value: {score}, name: mean_reward}}]",
        ]
    lines += [
        "---",
        "",
        f"# {config.env_id}",
        "",
        f"A policy for continuous control by the advantage actor-suggester, a2s {__version__}.",
        "",
        f"- Observation: {metadata['obs_size']} numbers; action: {metadata['action_size']}, from "
        f"{low} to {high}.",
        f"- K = {metadata['K']} suggestions; version {metadata['weights_version']} of the weights.",
    ]
    if summary:
        lines.append(
            f"- Trained {summary['variant']} ({summary['algo']}, preset {summary['preset']}, seed "
            f"{summary['seed']}) for {summary['env_steps']:,} steps in {summary['wall_s']:.0f} s."
        )
    if found:
        lines.append(
            f"- Return of {found['episodes']} fresh episodes, {found['mode']} action: "
            f"{written(found['mean'])} ± {written(found['std'])}."
        )
    lines += [
        "",
        "`policy.onnx` holds normalisation, policy, Q and bounds. Its noise is an input: zeros "
        "give the mean action.",
        "",
        "```",
        "pip install 'gymnasium[mujoco]' onnxruntime && python rollout.py",
        "npm install onnxruntime-web && node act.mjs",
        "```",
        "",
        f"The environment as it was made: `{config.to_json()}`",
        "",
    ]
    return "\n".join(lines)
