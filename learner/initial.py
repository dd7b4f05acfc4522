"""What another run has learned, to begin with: whatever fits of it is taken."""

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from a2s.learner.run import checkpoint
from a2s.learner.run.config import read
from a2s.learner.run.directory import CONFIG
from a2s.learner.trainer import Saved, Trainer
from a2s.protocol.errors import RunDirectoryError, UsageError


def begin_with(trainer: Trainer, path: Path, variant: str) -> str:
    """Take over what fits of the networks and normalisers in a run's newest checkpoint.

    Optimisers, random numbers, the window or replay, and recovery begin anew. The other run may be
    of another environment, as long as the sizes of its policy are these.

    Returns:
        What was taken and what was not, for the user.

    Raises:
        UsageError: It is no run, of another variant, or its policy does not fit.
    """
    saved = _newest(path, variant)
    present = _parts(trainer.state()[0])
    there = _parts(saved[0])
    taken = [name for name, part in present.items() if _fits(part, there.get(name, {}))]
    if "policy" not in taken:
        raise UsageError(
            f"--init-from: the policy of {path} does not fit: found {_sizes(there['policy'])}, "
            f"expected {_sizes(present['policy'])} parameters; its observations, actions or "
            "policy_sizes are others"
        )
    trainer.begin_with(saved, taken)
    left = [name for name in present if name not in taken]
    words = f"begins with {', '.join(taken)} of {path}"
    return f"{words}; not with {', '.join(left)}, which has other sizes there" if left else words


def _newest(path: Path, variant: str) -> Saved:
    try:
        options, _ = read(path / CONFIG)
        tensors, state = checkpoint.load(path / "checkpoints")
    except RunDirectoryError as error:
        raise UsageError(f"--init-from: {error}") from None
    found = options.get("variant", "on-policy")
    if found != variant:
        raise UsageError(f"--init-from: {path} is {found}, expected {variant}")
    return tensors, state["algorithm"]


_PARTS = ("policy", "value", "q", "critics", "targets", "average", "log_temperature")
_NORMALISER = "normaliser"


def _parts(tensors: Mapping[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    """The networks by name, and all of the normaliser of observations as one."""
    found = {name: {name: tensors[name]} for name in _PARTS if name in tensors}
    found[_NORMALISER] = {k: v for k, v in tensors.items() if k.startswith(f"{_NORMALISER}.")}
    return found


def _fits(part: Mapping[str, Tensor], other: Mapping[str, Tensor]) -> bool:
    shapes = [{name: tensor.shape for name, tensor in each.items()} for each in (part, other)]
    return shapes[0] == shapes[1]


def _sizes(part: Mapping[str, Tensor]) -> int:
    return sum(tensor.numel() for tensor in part.values())
