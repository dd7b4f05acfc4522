"""What a data set says of its environment."""

from pathlib import Path

import pytest

from a2s.commands.minari_export import spec_of


@pytest.mark.parametrize(
    ("code", "env_id", "why"),
    [
        ("raise ValueError('no device')", "badly:X-v0", "ValueError: no device"),
        ("x = (", "badly:X-v0", "SyntaxError: '(' was never closed"),
        ("", "./badly.py:X", "TypeError: the 'package' argument"),
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
