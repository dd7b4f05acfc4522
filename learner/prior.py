"""Prior data: transitions of elsewhere, of which every batch has a share.

Source: RLPD (Ball et al. 2023, arXiv:2302.02948), symmetric sampling: half of a batch from the
prior data, half from the run's own replay, and no learning before there are own steps. Differs:
observations and returns are normalised here, by what batches consist of.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xxhash

from a2s.learner.replay import directory, files
from a2s.learner.replay.sampling import Transitions
from a2s.learner.run.run_config import RunConfig
from a2s.protocol.errors import RunDirectoryError, UsageError
from a2s.protocol.fields import Array, Spaces


class Prior:
    """A replay that never changes, drawn from uniformly.

    It lies in a directory that `a2s replay import` wrote, or in that of a run; nobody may write to
    it meanwhile. ``rows`` of the ``batch_rows`` rows of a batch are drawn from it.

    Attributes:
        rows: Of a batch.
        identity: The same for the same transitions wherever they lie: 16 hexadecimal digits.

    Raises:
        RunDirectoryError: It is missing, damaged, in use or of another environment.
        UsageError: A batch would be prior data only, or own steps only.
    """

    def __init__(
        self, path: Path, env_id: str, spaces: Spaces, share: float, batch_rows: int
    ) -> None:
        self.rows = round(share * batch_rows)
        self._own_rows = batch_rows - self.rows
        if not (self.rows and self._own_rows):
            raise UsageError(
                f"prior_share: found {share:g}, {self.rows} of the {batch_rows} rows of a batch, "
                "expected at least one of either kind; set another, or batch_rows"
            )
        place = directory.find(path)
        if not (place / files.NAME).exists():
            raise RunDirectoryError(
                f"prior data {path}: found no {files.NAME} there, expected a directory that "
                "`a2s replay import` wrote, or a run with a replay; name it with --prior"
            )
        self._replay = directory.look_at(place, alone=True)
        try:
            about = self._replay.about
            about.require(place, env_id, spaces, "name other prior data, or import them with --env")
            _require_offset(place, about.spaces.obs_offset, spaces.obs_offset)
            if not len(self._replay):
                raise RunDirectoryError(f"prior data {path}: found no transition, expected some")
        except RunDirectoryError:
            self.close()
            raise
        index = (place / about.index_name).read_bytes()  # it has a hash of every row
        self.identity = xxhash.xxh3_64_hexdigest(index)
        self._path, self._batch_rows = path, batch_rows

    def __str__(self) -> str:
        return (
            f"prior data {self._path}: {len(self._replay):,} transitions, "
            f"{self.rows} of the {self._batch_rows} rows of every batch"
        )

    def sample(self, rng: np.random.Generator, *, n_step: int, gamma: float) -> Transitions:
        """Draw the prior rows of a batch."""
        return self._replay.sample(self.rows, rng, n_step=n_step, gamma=gamma)

    def obs_beside(self, begin: int, end: int, rng: np.random.Generator) -> Array:
        """Draw observations to go with the own rows from ``begin`` to below ``end``, ``[N, D]``.

        Of all that were drawn for the first ``end`` own rows there are as many as batches have.
        """
        count = end * self.rows // self._own_rows - begin * self.rows // self._own_rows
        if count < 1:
            return np.empty((0, self._replay.about.spaces.obs_size), np.float32)
        return self._replay.sample(count, rng).obs

    def close(self) -> None:
        """Close the files."""
        self._replay.close()


def open_prior(
    run: RunConfig, spaces: Spaces, batch_rows: int, saved: Mapping[str, Any] | None
) -> Prior | None:
    """Open the prior data of a run, if it has any; ``saved`` is the state that it goes on from.

    Raises:
        RunDirectoryError: They cannot be used, or are not those that the run began with.
        UsageError: A batch would be prior data only, or own steps only.
    """
    prior = None
    if run.prior:
        prior = Prior(Path(run.prior), run.env, spaces, run.prior_share, batch_rows)
    found = prior.identity if prior else ""
    expected = found if saved is None else saved.get("prior", "")
    if found != expected:
        if prior is not None:
            prior.close()
        raise RunDirectoryError(
            f"prior data {run.prior}: found {found or 'none'}, expected {expected or 'none'}, as "
            "the run began with; name the same with --prior, or begin another run"
        )
    return prior


def _require_offset(path: Path, found: Array | None, expected: Array | None) -> None:
    """Raise RunDirectoryError if other numbers were subtracted from the observations."""
    zero = np.float32(0.0)
    if np.any((zero if found is None else found) != (zero if expected is None else expected)):
        raise RunDirectoryError(
            f"replay {path}: found observations less {_listed(found)}, expected less "
            f"{_listed(expected)}; name other prior data"
        )


def _listed(offset: Array | None) -> object:
    return 0 if offset is None else offset.tolist()
