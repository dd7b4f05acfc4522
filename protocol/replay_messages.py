"""The messages of a served replay; see ``messages.py``."""

from dataclasses import dataclass
from typing import Literal, get_args

from a2s.protocol.fields import Array, Spaces, require, require_finite

Column = Literal["obs", "action", "reward", "next_obs", "discount", "weight", "row"]
COLUMNS: tuple[Column, ...] = get_args(Column)
MOST_SAMPLED = 4096
MOST_STEPS = 64


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReplayInfo:
    """What a served replay holds now.

    Attributes:
        run: Name of the run.
        generation: Which start of the learner serves it.
        env_id: Environment of the transitions.
        spaces: Its spaces.
        capacity: Transitions that it holds at most.
        begin: Number of the oldest row that can be sampled.
        end: Rows ever inserted, and so the number of the next.
    """

    run: str
    generation: int
    env_id: str
    spaces: Spaces
    capacity: int
    begin: int
    end: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReplayRequest:
    """Somebody asks for a batch of transitions.

    Attributes:
        batch_size: B, 1 to 4096.
        seed: Of the draw: while nothing is inserted and no priority changes, the same request is
            answered by the same batch.
        n_step: Steps that a transition goes over at most, 1 to 64.
        gamma: Discount of one step, 0 to 1.
        prioritised: Draw in proportion to the priorities, else uniformly.
        beta: How far importance weights make up for that, 0 to 1.
        fields: What is wanted of each transition, at least one.

    Raises:
        MalformedMessageError: A number is out of its range, or a field comes twice.
    """

    batch_size: int
    seed: int
    n_step: int
    gamma: float
    prioritised: bool
    beta: float
    fields: tuple[Column, ...]

    def __post_init__(self) -> None:
        """Check that the work is bounded."""
        subject = "replay request"
        size, steps, names = self.batch_size, self.n_step, self.fields
        require(1 <= size <= MOST_SAMPLED, f"{subject}: batch_size", size, f"1..{MOST_SAMPLED}")
        require(0 <= self.seed < 1 << 63, f"{subject}: seed", self.seed, "0 to 2^63 - 1")
        require(1 <= steps <= MOST_STEPS, f"{subject}: n_step", steps, f"1..{MOST_STEPS}")
        require(0.0 <= self.gamma <= 1.0, f"{subject}: gamma", self.gamma, "0 to 1")
        require(0.0 <= self.beta <= 1.0, f"{subject}: beta", self.beta, "0 to 1")
        once = len(names) == len(set(names)) > 0
        require(once, f"{subject}: fields", names, "at least one, none twice")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReplaySample:
    """A batch of transitions; what was not asked for is missing.

    The target of a value at ``(obs, action)`` is ``reward + discount * value(next_obs)``.

    Attributes:
        begin: Number of the oldest row when it was drawn.
        end: Number of the row that was to come next.
        obs: Observation before the first step, float32 ``[B, D]``.
        action: The first step's executed suggestion, canonical, not clipped, float32 ``[B, A]``.
        reward: Discounted sum of the rewards of the steps, float32 ``[B]``.
        next_obs: Observation after the last step, float32 ``[B, D]``.
        discount: gamma to the number of steps; 0 where the last one terminated, float32 ``[B]``.
        weight: Importance weight, the highest is 1, float32 ``[B]``.
        row: Number of the first step's row, B of them, or none.

    Raises:
        MalformedMessageError: The columns disagree about B, or a number is not finite.
    """

    begin: int
    end: int
    obs: Array | None
    action: Array | None
    reward: Array | None
    next_obs: Array | None
    discount: Array | None
    weight: Array | None
    row: tuple[int, ...]

    def __post_init__(self) -> None:
        """Check the columns against each other."""
        arrays: dict[str, Array] = {
            name: array for name in COLUMNS[:-1] if (array := getattr(self, name)) is not None
        }
        lengths = {name: len(array) for name, array in arrays.items()}
        if self.row:
            lengths["row"] = len(self.row)
        agree = len(set(lengths.values())) == 1
        require(agree, "replay sample: columns disagree about B", lengths, "one length")
        for name, array in arrays.items():
            rank = 2 if name in ("obs", "action", "next_obs") else 1
            require(array.ndim == rank, f"replay sample: {name}", array.shape, f"rank {rank}")
        require_finite("replay sample", **arrays)
