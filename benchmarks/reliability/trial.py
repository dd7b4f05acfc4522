"""The result of a trial, and how one is told."""

import json
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path


@dataclass
class Result:
    """Repetitions of one trial.

    Attributes:
        trial: Its name.
        must_hold: What must hold in each repetition.
        count: Repetitions so far.
        failures: One line for each in which it did not hold.
        figures: Names and numbers that belong to it.
    """

    trial: str
    must_hold: str
    count: int = 0
    failures: list[str] = field(default_factory=list)
    figures: dict[str, str] = field(default_factory=dict)

    def add(self, *found: str, of: str = "") -> None:
        """Count a repetition, and what did not hold in it; empty words are nothing."""
        self.count += 1
        wrong = "; ".join(filter(None, found))
        if wrong:
            self.failures.append(f"{of}: {wrong}" if of else wrong)
        sys.stderr.write(f"{self.trial} {self.count}: {of} {wrong or 'ok'}\n")

    def quantiles(self, name: str, values: Sequence[float]) -> None:
        """Keep median and 95th percentile of some seconds."""
        if values:
            ordered = sorted(values)
            middle, high = (
                ordered[min(len(ordered) - 1, int(q * len(ordered)))] for q in (0.5, 0.95)
            )
            self.figures[name] = f"median {middle:.1f} s, p95 {high:.1f} s, n {len(ordered)}"


def tell(results: Sequence[Result]) -> None:
    """Print results as the last line; exit with 1 if anything did not hold."""
    sys.stdout.write(json.dumps([asdict(result) for result in results]) + "\n")
    sys.exit(any(result.failures for result in results))


@contextmanager
def folder() -> Iterator[Path]:
    """A folder for the files of a trial; RELIABILITY_FOLDER names one that stays."""
    kept = os.environ.get("RELIABILITY_FOLDER")
    if kept:
        Path(kept).mkdir(parents=True, exist_ok=True)
        yield Path(kept).resolve()
        return
    with tempfile.TemporaryDirectory(prefix="reliability-") as found:
        yield Path(found).resolve()
