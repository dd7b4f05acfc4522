"""What a replay directory survives, and what it refuses without destroying anything."""

import dataclasses
import json
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import replay_writer
from replay_oracle import ENV_ID, SPACES, make_segment

from a2s.learner.ingest.ledger import Ledger
from a2s.learner.replay import directory
from a2s.learner.replay.index import RECORD_BYTES
from a2s.learner.replay.replay import Replay
from a2s.protocol.errors import A2SError, RunDirectoryError, UsageError

FOREVER = 1_000_000


def fill(path: Path, segments: int = 10, capacity: int = 100) -> Path:
    """Make a replay with segments of four steps of one episode, and close it."""
    replay = directory.create(path, ENV_ID, SPACES, capacity)
    for seq in range(segments):
        insert(replay, seq)
    replay.close()
    return path


def insert(replay: Replay, seq: int) -> None:
    """Insert four steps."""
    obs = [4.0 * seq + i for i in range(5)]
    replay.insert(make_segment(obs, [1.0] * 4, seq=seq, before=4 * seq))


def observations(replay: Replay) -> list[float]:
    """First number of the observation of every live row, oldest first."""
    batch = replay.sample(60 * len(replay), np.random.default_rng(0))
    found = dict(zip(batch.row.tolist(), batch.obs[:, 0].tolist(), strict=True))
    return [found[row] for row in replay.live]


def snapshot(path: Path) -> dict[str, bytes]:
    """Every file and what is in it."""
    return {file.name: file.read_bytes() for file in path.iterdir()}


@contextmanager
def opened(path: Path, **how: object) -> Iterator[Replay]:
    """Open, and close at the end."""
    replay = directory.open_existing(path, **how)  # type: ignore[arg-type]
    yield replay
    replay.close()


@pytest.mark.parametrize("capacity", [50, FOREVER])
@pytest.mark.slow
def test_every_acknowledged_transition_survives_kill_9_and_none_comes_twice(
    tmp_path: Path, capacity: int
) -> None:
    """Twenty kills at any moment, of a process that inserts as fast as it can."""
    directory.create(tmp_path, ENV_ID, SPACES, capacity).close()
    rng = np.random.default_rng(0)
    last = -1
    for _ in range(20):
        command = [sys.executable, replay_writer.__file__, str(tmp_path), str(last + 1)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as child:
            assert child.stdout is not None
            said = [child.stdout.readline() for _ in range(int(rng.integers(1, 300)))]
            child.kill()
            said += child.stdout.readlines()  # what it had said before it died
        acknowledged = [int(line) for line in said if line.endswith(b"\n")]
        assert acknowledged == list(range(last + 1, last + 1 + len(acknowledged)))
        last = acknowledged[-1]
        with opened(tmp_path, is_known=lambda _, seq, last=last: seq <= last) as replay:
            assert replay.live.stop == sum(
                1 + seq % replay_writer.MAX_STEPS for seq in range(last + 1)
            )
            assert len(replay) == min(capacity, replay.live.stop)
            assert replay.taken_back <= replay_writer.MAX_STEPS
            batch = replay.sample(2 * len(replay), rng, n_step=2, gamma=0.5)
            assert np.array_equal(batch.obs[:, 0], batch.row)
            assert np.array_equal(batch.reward == 1.0, batch.row == replay.live.stop - 1)


def test_a_torn_record_is_cut_and_counted(tmp_path: Path) -> None:
    """Wherever a kill tears it."""
    fill(tmp_path / "whole")
    size = (tmp_path / "whole" / "index-1.log").stat().st_size
    for missing in (0, 1, 8, RECORD_BYTES - 1):
        path = tmp_path / f"torn-{missing}"
        shutil.copytree(tmp_path / "whole", path)
        with (path / "index-1.log").open("r+b") as file:
            file.truncate(size - missing)
            file.seek(size - RECORD_BYTES)
            file.write(b"?")
        before = snapshot(path)
        assert directory.look_at(path).torn_records == 1
        assert snapshot(path) == before
        with opened(path) as replay:
            assert (replay.torn_records, replay.live.stop) == (1, 36)
            insert(replay, 9)
            assert observations(replay) == [float(i) for i in range(40)]
        with opened(path) as replay:
            assert (replay.torn_records, replay.live.stop) == (0, 40)


def test_rows_that_never_reached_the_disk_are_cut_at_the_end_and_refused_elsewhere(
    tmp_path: Path,
) -> None:
    """As when the machine dies: the index may be ahead of the rows."""
    fill(tmp_path, segments=30)
    rows = np.memmap(tmp_path / "obs-1.f32", np.float32, "r+").reshape(-1, 2)
    rows[116:120] = 0.0
    rows[112, 0] += 1.0
    with opened(tmp_path) as replay:
        assert (replay.torn_records, replay.live) == (2, range(12, 112))
        assert observations(replay) == [float(i) for i in range(12, 112)]
    rows[100, 1] = 1.0
    before = snapshot(tmp_path)
    reason = "the checksum of the rows from 100 does not match"
    for how in (directory.open_existing, directory.look_at):
        with pytest.raises(RunDirectoryError, match=reason):
            how(tmp_path)
    assert snapshot(tmp_path) == before


def test_when_much_is_cut_no_row_is_made_up(tmp_path: Path) -> None:
    """What had been written after the oldest rows may lie over them: they stay evicted."""
    fill(tmp_path, segments=30, capacity=4)
    rows = np.memmap(tmp_path / "obs-1.f32", np.float32, "r+").reshape(-1, 2)
    for cut in range(1, 4):
        rows[(120 - 4 * cut) % len(rows), 0] = -1.0
    with opened(tmp_path) as replay:
        assert (replay.torn_records, replay.live.start, replay.live.stop) == (3, 108, 108)
        insert(replay, 27)
        assert observations(replay) == [108.0, 109.0, 110.0, 111.0]


def test_a_long_segment_is_there_whole_or_not_at_all(tmp_path: Path) -> None:
    """It has several records."""
    replay = directory.create(tmp_path, ENV_ID, SPACES, 10)
    insert(replay, 0)
    replay.insert(make_segment([float(i) for i in range(4, 30)], [1.0] * 25, before=4, seq=1))
    replay.close()
    with (tmp_path / "index-1.log").open("r+b") as file:
        file.truncate((tmp_path / "index-1.log").stat().st_size - RECORD_BYTES)
    with opened(tmp_path) as replay:
        assert (replay.live.stop, replay.torn_records) == (4, 2)


def test_segments_that_the_ledger_does_not_know_are_taken_back(tmp_path: Path) -> None:
    """They will be sent again: the rows they had pushed out are there again too."""
    fill(tmp_path / "replay", segments=30)
    ledger = Ledger(tmp_path / "segments.log")
    for seq in range(29):
        ledger.record("a", seq, "accepted", 4)
    with opened(tmp_path / "replay", is_known=ledger.knows) as replay:
        assert (replay.taken_back, replay.live) == (4, range(16, 116))
        assert observations(replay) == [float(i) for i in range(16, 116)]
    assert ledger.accounts().duplicate == 0
    ledger.close()
    with opened(tmp_path / "replay") as replay:
        assert replay.live.stop == 116


@pytest.mark.parametrize(("steps", "first"), [(150, 100), (252, 152), (350, 200)])
def test_a_long_segment_is_taken_back_and_rows_that_it_was_not_written_over_are_there_again(
    tmp_path: Path, steps: int, first: int
) -> None:
    """Of 400 slots, those of the newest 300 rows and of a piece that may have come next."""
    replay = directory.create(tmp_path, ENV_ID, SPACES, 100)
    for seq in range(50):
        insert(replay, seq)
    obs = [200.0 + i for i in range(steps + 1)]
    replay.insert(make_segment(obs, [1.0] * steps, seq=50, before=200))
    replay.close()
    with opened(tmp_path, is_known=lambda _, seq: seq < 50) as replay:
        assert (replay.taken_back, replay.torn_records) == (steps, 0)
        assert replay.live == range(first, 200)
        insert(replay, 50)
        first = max(first, 104)
        assert observations(replay) == [float(i) for i in range(first, 204)]


def test_the_index_does_not_grow_without_bound(tmp_path: Path) -> None:
    """Records of evicted rows go; what is opened again is the same."""
    fill(tmp_path, segments=4100, capacity=100)
    assert (tmp_path / "index-1.log").stat().st_size < 50 * RECORD_BYTES
    with opened(tmp_path) as replay:
        assert replay.live == range(16_300, 16_400)
        assert observations(replay) == [float(i) for i in range(16_300, 16_400)]


def describe(**changes: object) -> Callable[[bytes], bytes]:
    """Change ``replay.json``."""
    return lambda data: json.dumps(json.loads(data) | changes).encode()


def halve(data: bytes) -> bytes:
    """Cut off the second half."""
    return data[: len(data) // 2]


def flip(data: bytes) -> bytes:
    """Damage a record that is not the last."""
    at = RECORD_BYTES + 3
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]


def swap(data: bytes) -> bytes:
    """Exchange two records, each of which is whole."""
    first, second = data[:RECORD_BYTES], data[RECORD_BYTES : 2 * RECORD_BYTES]
    return second + first + data[2 * RECORD_BYTES :]


@pytest.mark.parametrize(
    ("name", "harm", "reason"),
    [
        ("next_obs-1.f32", halve, "found 1600 bytes, expected 3200"),
        ("priority-1.f32", halve, "found 800 bytes, expected 1600"),
        ("replay.json", halve, "replay.json is damaged"),
        ("action-1.f32", None, "No such file"),
        ("index-1.log", None, "No such file"),
        ("replay.json", None, "holds no replay"),
        ("replay.json", describe(format=3), "found format 3, expected 2"),
        ("replay.json", describe(obs_size="x"), "replay.json is damaged"),
        ("replay.json", describe(obs_size=3), "found 3200 bytes, expected"),
        ("index-1.log", flip, "the checksum of record 1 does not match"),
        ("index-1.log", swap, "record 1 does not follow the one before"),
    ],
)
def test_what_is_damaged_is_refused_by_one_line_and_left_alone(
    tmp_path: Path, name: str, harm: Callable[[bytes], bytes] | None, reason: str
) -> None:
    """It may be all that is left of a long run."""
    file = fill(tmp_path) / name
    if harm is None:
        file.unlink()
    else:
        file.write_bytes(harm(file.read_bytes()))
    before = snapshot(tmp_path)
    with pytest.raises(RunDirectoryError, match=reason) as caught:
        directory.open_existing(tmp_path)
    assert "\n" not in str(caught.value)
    assert "move the directory away" not in str(caught.value)  # a run without it is refused
    assert snapshot(tmp_path) == before


OTHER = dataclasses.replace(SPACES, action_high=np.array([3.0, 0.8], np.float32))


@pytest.mark.parametrize(
    ("how", "kind", "reason"),
    [
        ({"env_id": "Hopper-v5", "spaces": SPACES}, RunDirectoryError, "found environment"),
        ({"env_id": ENV_ID, "spaces": OTHER}, RunDirectoryError, "found action_high"),
        ({"capacity": 255, "batch_size": 256}, UsageError, "at least one batch of 256"),
        ({"batch_size": 256}, UsageError, "found 100, expected at least one batch"),
    ],
)
def test_another_environment_or_a_capacity_below_one_batch_is_refused(
    tmp_path: Path, how: dict[str, object], kind: type[A2SError], reason: str
) -> None:
    before = snapshot(fill(tmp_path))
    with pytest.raises(kind, match=reason):
        directory.open_existing(tmp_path, **how)  # type: ignore[arg-type]
    assert snapshot(tmp_path) == before


def test_a_replay_is_made_only_where_there_is_none(tmp_path: Path) -> None:
    """One that lost its description has transitions; what a kill left of making one has not."""
    path = fill(tmp_path / "replay")
    with pytest.raises(RunDirectoryError, match="is there already"):
        directory.create(path, ENV_ID, SPACES, 100)
    (path / "replay.json").unlink()
    before = snapshot(path)
    with pytest.raises(RunDirectoryError) as caught:
        directory.create(path, ENV_ID, SPACES, 100)
    assert str(caught.value) == (
        f"replay {path}: found transitions in index-1.log, but no replay.json; "
        "restore it from a copy, or begin another run with --init-from RUN"
    )
    assert snapshot(path) == before
    (path / "index-1.log").write_bytes(b"")
    fill(path, capacity=50)


def test_one_learner_writes_or_readers_keep_learners_out(tmp_path: Path) -> None:
    """Anybody may look at any time; to be alone is to see no row written over."""
    path = fill(tmp_path)
    with opened(path) as replay:
        with pytest.raises(RunDirectoryError, match="another learner writes to it"):
            directory.open_existing(path)
        said = "a learner writes to it; stop it first, or, .* a2s learner --replay-from NAME --"
        with pytest.raises(RunDirectoryError, match=said):
            directory.look_at(path, alone=True)
        looking = directory.look_at(path)
        insert(replay, 10)
        assert (looking.live.stop, replay.live.stop) == (40, 44)
        with pytest.raises(UsageError, match="read only"):
            insert(looking, 10)
    before = snapshot(path)
    for alone in [directory.look_at(path, alone=True) for _ in range(2)]:
        with pytest.raises(RunDirectoryError, match="or learns from it; stop that first"):
            directory.open_existing(path)
        directory.look_at(path)
        alone.close()
    assert snapshot(path) == before
    with opened(path) as replay:
        assert replay.live.stop == 44


@contextmanager
def no_file_larger_than(num_bytes: int) -> Iterator[None]:
    """Let the system refuse to make files larger, as on a disk that is full."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, hard))


def test_no_room_is_noticed_when_files_are_made(tmp_path: Path) -> None:
    """Not by a signal in the middle of a run; nothing half made stays, and the old files do."""
    path = tmp_path / "replay"
    with no_file_larger_than(2_000_000), pytest.raises(RunDirectoryError, match="MiB are needed"):
        directory.create(path, ENV_ID, SPACES, 4_000_000)
    assert [file.name for file in path.iterdir()] == ["lock"]
    fill(path)
    before = snapshot(path)
    with no_file_larger_than(20_000), pytest.raises(RunDirectoryError, match="MiB are needed"):
        directory.open_existing(path, capacity=100_000)
    assert snapshot(path) == before
    with opened(path, capacity=100_000) as replay:
        assert observations(replay) == [float(i) for i in range(40)]
    columns = ("obs", "action", "next_obs", "outcome", "priority")
    files = {"index-2.log", "lock", "replay.json", *(f"{name}-2.f32" for name in columns)}
    assert {file.name for file in path.iterdir()} == files


def test_no_room_for_a_record_is_an_error_and_the_replay_is_as_before(tmp_path: Path) -> None:
    """The segment was not acknowledged, and can be inserted once there is room."""
    path = fill(tmp_path)
    with opened(path) as replay:
        size = (path / "index-1.log").stat().st_size
        with no_file_larger_than(size + 20), pytest.raises(RunDirectoryError, match="make room"):
            insert(replay, 10)
        assert (path / "index-1.log").stat().st_size == size
        insert(replay, 10)
        assert observations(replay) == [float(i) for i in range(44)]
    with opened(path) as replay:
        assert (replay.live.stop, replay.torn_records) == (44, 0)
