"""Which process of torchrun this is."""

import pytest

from a2s.learner.torchrun import number_and_count


@pytest.mark.parametrize(("run_id", "found"), [("x", (1, 4)), (None, (0, 1))])
def test_numbers_that_others_set_mean_nothing(
    monkeypatch: pytest.MonkeyPatch, run_id: str | None, found: tuple[int, int]
) -> None:
    """Those who train in a cluster have them in every process, also where a2s is alone."""
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setenv("WORLD_SIZE", "4")
    monkeypatch.delenv("TORCHELASTIC_RUN_ID", raising=False)
    if run_id is not None:
        monkeypatch.setenv("TORCHELASTIC_RUN_ID", run_id)
    assert number_and_count() == found
