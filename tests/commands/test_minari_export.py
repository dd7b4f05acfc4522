"""What a data set says of its environment."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import minari
import numpy as np
import pytest
from segments import segment

from a2s.commands.minari_export import export, spec_of
from a2s.learner.replay import directory
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.fields import Spaces


@pytest.mark.parametrize(
    ("code", "env_id", "why"),
    [
        ("raise ValueError('no device')", "badly:X-v0", "ValueError: no device"),
        ("x = (", "badly:X-v0", "SyntaxError: '(' was never closed"),
        ("", "./badly.py:X", "the run made it from a file, badly.py, which a spec does not keep"),
        ("", "/tmp/badly.py:X", "the run made it from a file, badly.py"),
    ],
)
def test_a_module_that_cannot_be_imported_is_why_there_is_no_spec(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, env_id: str, why: str
) -> None:
    """The data are useful without it."""
    (tmp_path / "badly.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    spec, said = spec_of(env_id)
    assert spec is None
    assert said is not None
    assert said.startswith(why)


def test_the_spec_makes_the_environment_as_the_run_did() -> None:
    """With its arguments and its limit; what is around it has no place there."""
    made = EnvConfig(env_id="Pendulum-v1", kwargs='{"g": 1.5}', max_episode_steps=7)
    spec, why = spec_of("Pendulum-v1", made)
    assert spec is not None
    assert (spec.kwargs, spec.max_episode_steps, why) == ({"g": 1.5}, 7, None)
    spec, why = spec_of("Pendulum-v1", replace(made, action_repeat=2, wrappers=("a:B",)))
    assert (spec, why) == (
        None, "the run made it with wrappers, action_repeat, which a spec does not keep",
    )  # fmt: skip


@pytest.mark.parametrize(("options", "limit"), [("max_episode_steps = 7", 7), ("", 200)])
def test_an_export_says_how_its_run_made_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: str, limit: int
) -> None:
    bounds = np.full(1, 2.0, np.float32)
    spaces = Spaces(obs_size=3, action_low=-bounds, action_high=bounds)
    with closing(directory.create(tmp_path / "run" / "replay", "Pendulum-v1", spaces, 9)) as replay:
        replay.insert(segment(0, 5, obs_size=3, action_size=1, terminated=True))
    (tmp_path / "run" / "config.toml").write_text(f'[run]\nenv = "Pendulum-v1"\n{options}\n')
    found = export(tmp_path / "run" / "replay", "p-v0", tmp_path / "minari")
    assert found["no_env_spec"] is None
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    assert minari.load_dataset("p-v0").env_spec.max_episode_steps == limit
