"""``a2s export``: a folder with the policy of a run that works without a2s."""

import hashlib
import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from a2s import __version__
from a2s.actors.evaluation import read_policy, trained_on
from a2s.commands.evaluate import policy_of
from a2s.learner.numerals import written
from a2s.protocol.env_config import EnvConfig, wrapper_of
from a2s.protocol.errors import UsageError

_OF_RUN = {"variant", "algo", "preset", "seed", "env_steps", "wall_s"}
_OF_EVALUATION = {"mean", "std", "episodes", "mode"}
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
    texts = {
        PYTHON: _python(config, metadata),
        JAVASCRIPT: _javascript(metadata),
        CARD: _card(config, metadata, _summary(run, weights)),
    }
    own = _files_of(config)
    names = [POLICY, *texts, *(file.name for file in own)]
    _require(path, own, names)
    try:
        output.mkdir(parents=True)
        shutil.copyfile(path, output / POLICY)
        for name, text in texts.items():
            (output / name).write_text(text)
        for file in own:
            shutil.copyfile(file, output / file.name)
    except FileExistsError:
        raise UsageError(f"--output: {output} exists; name a new folder") from None
    except OSError as error:
        raise UsageError(f"--output: {output}: {error.strerror}") from None
    return [output / name for name in names]


def _files_of(config: EnvConfig) -> list[Path]:
    """The user's files that the environment and its wrappers are classes of, each once."""
    places = (code.rpartition(":")[0] for code in config.code)
    return [Path(place) for place in dict.fromkeys(places) if place.endswith(".py")]


def _require(path: Path, own: list[Path], names: list[str]) -> None:
    """Require that the environment's files are there, and that no two of the folder have a name."""
    for file in own:
        if not file.is_file():
            raise UsageError(f"{path}: found no {file}, which its environment needs; restore it")
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise UsageError(
            f"{path}: found two files for {twice} of the folder, expected one: that of the "
            "environment needs another name"
        )


def _beside(wrapper: str) -> str:
    """A wrapper with its file, if it is in one, named as it lies in the folder."""
    place, py, rest = wrapper.partition(".py:")
    return f"{Path(place).name}{py}{rest}" if py and "=" not in place else wrapper


def _module_of(place: str) -> str:
    """The name by which a module, or a file beside the program, is imported."""
    return Path(place).stem if place.endswith(".py") else place


def _summary(run: Path, weights: str) -> dict[str, Any]:
    """The summary of a run that has ended, without an evaluation of other weights; else empty."""
    try:
        found = json.loads((run / "summary.json").read_text())
        latest = hashlib.sha256((run / "latest" / POLICY).read_bytes()).hexdigest()
    except (OSError, ValueError):
        return {}
    if not (isinstance(found, dict) and found.keys() >= _OF_RUN):
        return {}
    if found.get("weights_sha256", latest) != latest:
        return {}  # the run has gone on since
    evaluation = found.get("evaluation") or {}
    is_of_it = evaluation.get("weights", weights) == weights
    return {**found, "evaluation": evaluation if is_of_it else {}}


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
            "place = os.path.dirname(os.path.abspath(__file__))",
            'policy = onnxruntime.InferenceSession(os.path.join(place, "policy.onnx"))',
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
    imports = [
        "import os",
        "",
        "import gymnasium as gym",
        "import numpy as np",
        "import onnxruntime",
    ]
    place, _, name = config.env_id.rpartition(":")
    place = _module_of(place)
    given = [f"{key}={value!r}" for key, value in config.constructor_arguments(0, 0).items()]
    limit = [f"max_episode_steps={config.max_episode_steps}"] if config.max_episode_steps else []
    lines = [f"env = gym.make({', '.join([repr(name), *given, *limit])})"]
    if place:
        imports.append(f"import {place}")
        lines = [
            f"if {name!r} in gym.registry:",
            f"    {lines[0]}",
            "else:",
            f"    env = {place}.{name.replace('-', '_')}({', '.join(given)})",
        ]
        if limit:
            lines.append(f"    env = gym.wrappers.TimeLimit(env, {config.max_episode_steps})")
    for setting in config.wrappers:
        module, wrapper, arguments = wrapper_of(setting)
        imports.append(f"from {_module_of(module)} import {wrapper}")
        lines.append(f"env = {wrapper}(env, **{arguments!r})")
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
            f"const seen = new Float64Array({metadata['obs_size']}); // {_row(metadata)}",
            f"const offset = {metadata.get('obs_offset', '[]')}; // subtracted first",
            "const obs = Float32Array.from(seen, (x, i) => x - (offset[i] ?? 0));",
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


def _row(metadata: Mapping[str, str]) -> str:
    """What the numbers of an observation are."""
    if "obs_layout" not in metadata:
        return "as the environment gives it"
    return ", ".join(f"{name} ({size})" for name, size in json.loads(metadata["obs_layout"]))


def _card(config: EnvConfig, metadata: Mapping[str, str], summary: Mapping[str, Any]) -> str:
    """A model card as model hubs read it."""
    found = summary.get("evaluation", {})
    found = found if found.keys() >= _OF_EVALUATION else {}
    module, _, name = config.env_id.rpartition(":")
    made = replace(config, env_id=name, wrappers=tuple(map(_beside, config.wrappers)))
    needs = "gymnasium" if module else "'gymnasium[mujoco]'"
    score = f"{found['mean']:.2f} +/- {found['std']:.2f}" if found else ""
    low, high = metadata["action_low"], metadata["action_high"]
    lines = [
        "---",
        "library_name: a2s",
        f"tags: [{name}, reinforcement-learning, a2s, onnx]",
    ]
    if found:
        lines += [
            "model-index:",
            f"- name: {summary['algo']}",
            "  results:",
            "  - task: {type: reinforcement-learning, name: reinforcement-learning}",
            f"    dataset: {{name: {name}, type: {name}}}",
            f"    metrics: [{{type: mean_reward, value: {score}, name: mean_reward}}]",
        ]
    lines += [
        "---",
        "",
        f"# {name}",
        "",
        f"A policy for continuous control by the advantage actor-suggester, a2s {__version__}.",
        "",
        f"- Observation: {metadata['obs_size']} numbers, {_row(metadata)}; action: "
        f"{metadata['action_size']}, from {low} to {high}.",
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
        f"pip install {needs} onnxruntime && python rollout.py",
        "npm install onnxruntime-web && node act.mjs",
        "```",
        "",
        *([f"`rollout.py` also needs what `{Path(module).name}` needs.", ""] if module else []),
        f"The environment as it was made: `{made.to_json()}`",
        "",
    ]
    return "\n".join(lines)
