"""Samples per insert: whichever side is ahead waits for the other.

Source: the rate limiter of Reverb (Cassirer et al. 2021, arXiv:2102.04736, section 3.4,
``SampleToInsertRatio``). Differs: counts are of transitions, not of items, and a band that can
block both sides is refused when it is made, whatever the sizes of segments and batches.
"""

from collections.abc import Mapping

from a2s.protocol.errors import RunDirectoryError, UsageError


class Limiter:
    """Keeps ``samples`` near ``ratio * (inserts - min_size)``, both in transitions.

    The difference, ``error = ratio * (inserts - min_size) - samples``, stays within ``-band`` and
    ``band``: an insertion that would raise it above waits, and so does a batch that would lower it
    below. Until ``min_size`` transitions are there, insertions never wait and batches always do.
    Not locked: its owner calls it from one place. Use::

        if limiter.may_sample():
            batch = replay.sample(batch_size, rng)
            limiter.count_sample()

    ``ratio`` is updates a step times the batch size, ``band`` is in sampled transitions, and
    ``segment_steps`` are the transitions of the longest segment.

    Raises:
        UsageError: A number is out of its range, or with this band both sides could wait.
    """

    def __init__(
        self, ratio: float, min_size: int, band: float, *, segment_steps: int, batch_size: int
    ) -> None:
        sizes = {"min_size": min_size, "segment_steps": segment_steps, "batch_size": batch_size}
        for name, value in ({"ratio": ratio} | sizes).items():
            if not 0 < value < float("inf"):
                raise UsageError(f"samples per insert: {name}: found {value}, expected above 0")
        min_band = max(ratio * segment_steps, batch_size)
        if not band >= min_band:
            raise UsageError(
                f"samples per insert: band: found {band:g}, expected at least {min_band:g}: the "
                f"larger of a batch ({batch_size}) and of a segment times the ratio "
                f"({ratio * segment_steps:g}), or both sides could wait for each other for ever"
            )
        self._ratio = ratio
        self._min_size = min_size
        self._band = band
        self._segment_steps = segment_steps
        self._batch_size = batch_size
        self.inserts = 0
        self.samples = 0
        self.insert_waits = 0
        self.sample_waits = 0

    @property
    def error(self) -> float:
        """Transitions by which sampling is behind; negative when it is ahead."""
        return self._error(self.inserts)

    @property
    def excess(self) -> float:
        """Transitions by which the longest segment would raise the error above the band."""
        return self.error + self._ratio * self._segment_steps - self._band

    @property
    def free_inserts(self) -> int:
        """Transitions that can be inserted before the longest segment has to wait."""
        return max(0, int(-self.excess / self._ratio))

    def may_insert(self) -> bool:
        """Whether the longest segment keeps within the band; counts a wait if not."""
        is_free = self.error + self._ratio * self._segment_steps <= self._band
        self.insert_waits += not is_free
        return is_free

    def may_sample(self, inserts: int | None = None) -> bool:
        """Whether another batch keeps within the band; counts a wait if not.

        It goes by ``inserts``, by default the number of all insertions.
        """
        present = self.inserts if inserts is None else inserts
        is_filled = present >= self._min_size
        is_free = is_filled and self._error(present) - self._batch_size >= -self._band
        self.sample_waits += not is_free
        return is_free

    def count_insert(self, steps: int) -> None:
        """Count transitions that were inserted, whether or not `may_insert` was asked."""
        self.inserts += steps

    def count_sample(self) -> None:
        """Count a batch that was sampled."""
        self.samples += self._batch_size

    def state(self, inserts: int) -> dict[str, float]:
        """The contents of a checkpoint, which goes on after this number of insertions."""
        return {
            "inserts": inserts,
            "error": self._error(inserts),
            "insert_waits": self.insert_waits,
            "sample_waits": self.sample_waits,
        }

    def load(self, state: Mapping[str, float], inserts: int) -> None:
        """Go on from a checkpoint: as far behind as then, plus the insertions since.

        The ratio may have been another then, and ``inserts``, those by now, may be fewer because
        another replay was begun.

        Raises:
            RunDirectoryError: A number is missing or is not one.
        """
        try:
            found = {name: float(state[name]) for name in self.state(0)}
        except (KeyError, TypeError, ValueError) as error:
            raise RunDirectoryError(
                f"checkpoint: samples per insert: found no usable {error}"
            ) from None
        due = found["error"] + self._ratio * max(0.0, inserts - found["inserts"])
        self.inserts = inserts
        self.samples = max(0, round(self._ratio * (inserts - self._min_size) - due))
        self.insert_waits = int(found["insert_waits"])
        self.sample_waits = int(found["sample_waits"])

    def _error(self, inserts: int) -> float:
        return self._ratio * (inserts - self._min_size) - self.samples
