"""What a learner may have an actor run."""

from pathlib import Path

import pytest

from a2s.actors.environments.allowed import require_allowed
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import UsageError


@pytest.mark.parametrize(
    ("env_id", "wrappers", "allowed"),
    [
        ("Hopper-v5", (), []),
        ("mine:Walk-v0", (), ["mine"]),
        ("mine.legs:Walk", (), ["other", "mine"]),
        ("mine:Walk", (), ["mine:Walk"]),
        ("Hopper-v5", ('mine:Slow={"by": ":"}',), ["mine:Slow"]),
        ("./walk.py:Walk", (), ["walk.py"]),
        ("/home/learner/walk.py:Walk", (), ["./walk.py"]),  # it would run ours
    ],
)
def test_what_is_allowed_is_run(env_id: str, wrappers: tuple[str, ...], allowed: list[str]) -> None:
    require_allowed(EnvConfig(env_id=env_id, wrappers=wrappers), allowed)


@pytest.mark.parametrize(
    ("env_id", "wrappers", "allowed", "advice"),
    [
        ("os:system", (), [], "--allow-env os"),
        ("os:system", (), ["o", "os:path", "os.path", "os.py", "Hopper-v5", ""], "--allow-env os"),
        ("mines:Walk", (), ["mine"], "--allow-env mines"),
        ("Hopper-v5", ("mine:Slow", "evil:Own"), ["mine"], "--allow-env evil"),
        ("mine.py:Walk", (), ["mine", "mine.py:Run"], "mine.py"),
        ("a b:Walk", (), [], "--allow-env 'a b'"),
    ],
)
def test_all_else_is_refused_with_what_to_add(
    env_id: str, wrappers: tuple[str, ...], allowed: list[str], advice: str
) -> None:
    config = EnvConfig(env_id=env_id, wrappers=wrappers)
    with pytest.raises(UsageError, match="was not told to run") as caught:
        require_allowed(config, allowed)
    assert str(caught.value).endswith(advice)


def test_a_file_elsewhere_is_another_one(tmp_path: Path) -> None:
    theirs = tmp_path / "walk.py"
    theirs.touch()
    with pytest.raises(UsageError, match=f"--allow-env {theirs}"):
        require_allowed(EnvConfig(env_id=f"{theirs}:Walk"), ["./walk.py"])
