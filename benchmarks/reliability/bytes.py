"""A byte that is another, or a file that is cut, in what ``--resume`` reads.

``python -m reliability.bytes --look 1 --resume 200``: every ``--look``th byte is flipped and the
file read; every ``--resume``th is flipped, and the file cut there, and the run resumed. It is used
unchanged, repaired with a line, or refused by name; never is anything silently different.
"""

import argparse
import random
import shutil
from collections.abc import Callable
from pathlib import Path

from reliability.faults import Fault, Faults
from reliability.scripted import ACTORS, Ended, ScriptedRun
from reliability.trial import Result, folder, tell

from a2s.learner.ingest import journal
from a2s.learner.ingest.ledger import Ledger, Mark
from a2s.learner.replay import directory as replay
from a2s.learner.run import checkpoint, saver
from a2s.protocol.errors import A2SError

_AGAIN_S = 20.0  # where steps are lost the learner waits for ever: scripted actors do not go on
SHORT = {
    "lockstep": {"total_steps": 400, "checkpoint_every_updates": 3},
    "off-policy": {"total_steps": 100, "checkpoint_every_updates": 20},
}
FILES = (
    "checkpoints/NEWEST/state.json", "checkpoints/NEWEST/tensors.safetensors",
    "checkpoints/NEWEST/SHA256SUMS", "segments.log", "journal/*", "replay/index-1.log",
    "replay/replay.json", "replay/obs-1.f32",
)  # fmt: skip


class Killed:
    """A run that was killed at two thirds, as often as it is wanted; ``undisturbed`` was not."""

    def __init__(self, way: str, faults: Faults, place: Path) -> None:
        self._way, self._place = way, place
        run = self._run()
        faults.forget()
        faults.arm(Fault.NOTHING)
        ended = run.start()
        assert ended.code == 0, ended.words
        self.undisturbed, writes = run.learned(), faults.count()
        run = self._run()
        faults.arm(Fault.KILL, 2 * writes // 3)
        assert run.start().code < 0
        faults.arm(Fault.NOTHING)
        self.path, self._notes = place / "left" / way, place / "left" / f"{way}-notes"
        for kept, left in ((self.path, run.path), (self._notes, run.notes)):
            shutil.copytree(left, kept)
        self.words = self.resumed(lambda _: None)[1].words

    def _run(self, patience_s: float = 60.0) -> ScriptedRun:
        place = self._place
        return ScriptedRun(
            self._way, place / "faulty" / "run", place / "notes", patience_s=patience_s,
            **SHORT[self._way],
        )  # fmt: skip

    def resumed(self, change: Callable[[Path], None]) -> tuple[ScriptedRun, Ended]:
        """Resume a copy of it in which something was changed."""
        run = self._run(_AGAIN_S)
        for kept, copy in ((self.path, run.path), (self._notes, run.notes)):
            shutil.copytree(kept, copy, dirs_exist_ok=True)
        change(run.path)
        return run, run.start()

    def files(self) -> list[str]:
        """Names of the files to be damaged that it has, and that are not empty."""
        newest = checkpoint.all_of(self.path / "checkpoints")[-1].name
        found = [p for f in FILES for p in sorted(self.path.glob(f.replace("NEWEST", newest)))]
        return [str(p.relative_to(self.path)) for p in found if p.stat().st_size]


def resumes(way: str, stride: int, rng: random.Random, killed: Killed) -> Result:
    """Resume after every damage."""
    result = Result(
        f"damaged bytes, {way}, resumed",
        "used unchanged, repaired with a line, or refused by name; never silently different",
    )
    ends = dict.fromkeys(("the same", "repaired with a line", "refused"), 0)
    for name in killed.files():
        size = (killed.path / name).stat().st_size
        for at in range(rng.randrange(min(stride, size)), size, stride):
            flip = rng.randint(1, 255)
            for what, change in (
                (f"{name}, byte {at} ^ {flip}", lambda path: _flip(path / name, at, flip)),  # noqa: B023
                (f"{name} cut at {at}", lambda path: _cut(path / name, at)),  # noqa: B023
            ):
                run, ended = killed.resumed(change)
                kind, wrong = _judge(killed, run, ended)
                ends[kind] += not wrong
                result.add(wrong, of=f"{what}: {kind}")
    result.figures |= {kind: str(count) for kind, count in ends.items()}
    return result


def _judge(killed: Killed, run: ScriptedRun, ended: Ended) -> tuple[str, str]:
    """Name how a resume ended, and say what is wrong about that."""
    last = (ended.words.strip().splitlines() or [""])[-1]
    if ended.is_one_line:
        return "refused", "" if str(run.path) in last else f"does not name a file: {last}"
    if ended.code and "is lost, though its steps count" in ended.words:
        return "repaired with a line", ""  # scripted actors do not play the same weights again
    if ended.code:
        return "refused", ended.defect
    said = [w for w in ended.words.splitlines() if w not in killed.words.splitlines()]
    difference = killed.undisturbed.difference(run.learned())
    if difference and not said:
        return "the same", f"SILENTLY DIFFERENT: {difference}"
    return ("repaired with a line" if said else "the same"), ""


def looks(way: str, stride: int, rng: random.Random, killed: Killed, place: Path) -> Result:
    """Read after every flip: what is read is what was written, a part of it, or refused."""
    result = Result(f"damaged bytes, {way}, read", "refused, or read as it was, or without its end")
    copy = place / "copy"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(killed.path, copy)
    for name in killed.files():
        read = _reader(name, copy)
        if read is None:
            continue
        whole, missed = read(), 0
        data = (copy / name).read_bytes()
        for at in range(rng.randrange(min(stride, len(data))), len(data), stride):
            _flip(copy / name, at, rng.randint(1, 255))
            try:
                missed += not _is_part(read(), whole)
            except (A2SError, checkpoint.DamagedError):
                pass
            except Exception as error:  # noqa: BLE001  that is what is looked for
                result.add(f"{type(error).__name__}: {error}", of=f"{name}, byte {at}")
            (copy / name).write_bytes(data)
            result.count += 1
        if missed:
            result.add(f"{missed} flips are not noticed", of=name)
        result.figures[name] = f"{missed} not noticed of {len(range(0, len(data), stride))}"
    return result


def _reader(name: str, run: Path) -> Callable[[], list[object]] | None:
    """What reads a file, as a list of what it says."""
    if name.startswith("checkpoints"):
        return lambda: [repr(checkpoint.read((run / name).parent))]
    if name.startswith("journal"):
        return lambda: [repr(each) for each in journal.read(run / "journal", journal.Place())[0]]
    if name == "segments.log":
        known = saver.ledger_mark(checkpoint.load(run / "checkpoints")[1])
        return lambda: [_ledger(run / name, known)]
    if name == "replay/index-1.log":
        return lambda: _rows(run / "replay")
    return None


def _ledger(path: Path, mark: Mark | None) -> object:
    ledger = Ledger(path, mark)
    try:
        known = [
            (slot, n)
            for slot in range(ACTORS)
            for n in range(999)
            if ledger.knows(f"actor-{slot}", n)
        ]
        return ledger.accounts(), ledger.accepted_steps, known
    finally:
        ledger.close()


def _rows(path: Path) -> list[object]:
    found = replay.look_at(path)
    try:
        return [row.tobytes() for row in found.obs_since(0)]
    finally:
        found.close()


def _is_part(found: list[object], whole: list[object]) -> bool:
    return found == whole[: len(found)]


def _flip(path: Path, at: int, flip: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= flip
    path.write_bytes(data)


def _cut(path: Path, at: int) -> None:
    path.write_bytes(path.read_bytes()[:at])


def main() -> None:
    """Parse, damage, tell."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--look", type=int, default=50, help="stride of the flips that are read")
    parser.add_argument("--resume", type=int, default=8000, help="stride of those resumed from")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng, results = random.Random(options.seed), []
    with folder() as place:
        faults = Faults(place)
        faults.enter("reliability.bytes", logged=True)
        for way in SHORT:
            killed = Killed(way, faults, place)
            results.append(looks(way, options.look, rng, killed, place))
            results.append(resumes(way, options.resume, rng, killed))
    tell(results)


if __name__ == "__main__":
    main()
