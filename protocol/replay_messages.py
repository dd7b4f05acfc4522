"""The messages of a served replay; see ``messages.py``."""

from dataclasses import dataclass
from typing import Literal, get_args

from a2s.protocol.checks import require, require_counts
from a2s.protocol.fields import Array, Spaces, require_finite

Column = Literal["obs", "action", "reward", "next_obs", "discount", "weight", "row"]
COLUMNS: tuple[Column, ...] = get_args(Column)
MAX_SAMPLED = 4096
MAX_STEPS = 64


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReplayInfo:
    """What a served replay holds now: rows ``begin`` to ``end`` can be sampled."""

    run: str
    generation: int  # of the learner that serves it
    env_id: str
    spaces: Spaces
    capacity: int  # transitions
    begin: int  # number of the oldest row
    end: int  # rows ever inserted

    def __post_init__(self) -> None:
        """Check the numbers against each other."""
        require_counts("replay", self, "generation", "begin", "capacity")
        require(self.begin <= self.end, "replay: end", self.end, f">= {self.begin}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReplayRequest:
    """A peer asks for a batch of transitions.

    The same request gets the same batch until a row is inserted or a priority changes.
    """

    batch_size: int  # B
    seed: int  # of the draw
    n_step: int  # steps of a transition, fewer where its episode ends
    gamma: float  # discount of one step
    prioritised: bool  # draw in proportion to the priorities, else uniformly
    beta: float  # how far importance weights make up for that
    fields: tuple[Column, ...]  # what is wanted of each transition

    def __post_init__(self) -> None:
        """Check that the work is bounded."""
        subject = "replay request"
        size, steps, names = self.batch_size, self.n_step, self.fields
        require(1 <= size <= MAX_SAMPLED, f"{subject}: batch_size", size, f"1..{MAX_SAMPLED}")
        require(0 <= self.seed < 1 << 63, f"{subject}: seed", self.seed, "0 to 2^63 - 1")
        require(1 <= steps <= MAX_STEPS, f"{subject}: n_step", steps, f"1..{MAX_STEPS}")
        require(0.0 <= self.gamma <= 1.0, f"{subject}: gamma", self.gamma, "0 to 1")
        require(0.0 <= self.beta <= 1.0, f"{subject}: beta", self.beta, "0 to 1")
        once = len(names) == len(set(names)) > 0
        require(once, f"{subject}: fields", names, "at least one, none twice")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReplaySample:
    """A batch of transitions; columns that were not asked for are ``None`` or empty.

    The target of a value at ``(obs, action)`` is ``reward + discount * value(next_obs)``.
    Arrays are float32.
    """

    begin: int  # number of the oldest row when the batch was drawn
    end: int  # rows ever inserted by then
    obs: Array | None  # [B, D], before the first step
    action: Array | None  # [B, A], the first step's executed suggestion, canonical, not clipped
    reward: Array | None  # [B], discounted sum over the steps
    next_obs: Array | None  # [B, D], after the last step
    discount: Array | None  # [B], gamma to the number of steps; 0 if the last one terminated
    weight: Array | None  # [B], importance weight, the highest is 1
    row: tuple[int, ...]  # number of each first step's row, counted from the first ever inserted

    def __post_init__(self) -> None:
        """Check the columns against each other."""
        require(0 <= self.begin <= self.end, "replay sample: end", self.end, f">= {self.begin}")
        outside = [row for row in self.row if not self.begin <= row < self.end]
        require(not outside, "replay sample: row", outside[:1], f"{self.begin} to {self.end} - 1")
        arrays: dict[str, Array] = {
            name: array for name in COLUMNS[:-1] if (array := getattr(self, name)) is not None
        }
        for name, array in arrays.items():
            rank = 2 if name in ("obs", "action", "next_obs") else 1
            require(array.ndim == rank, f"replay sample: {name}", array.shape, f"rank {rank}")
        lengths = {name: len(array) for name, array in arrays.items()}
        if self.row:
            lengths["row"] = len(self.row)
        agree = len(set(lengths.values())) == 1
        require(agree, "replay sample: columns disagree about B", lengths, "one length")
        require_finite("replay sample", **arrays)
