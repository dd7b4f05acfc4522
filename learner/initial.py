"""What another run has learned, to begin with: whatever fits of it is taken."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from torch import Tensor

from a2s.learner.run import checkpoint
from a2s.learner.run.config import Configuration, assemble, read
from a2s.learner.run.directory import CONFIG
from a2s.learner.trainer import Trainer
from a2s.protocol.errors import RunDirectoryError, UsageError


def begin_with(trainer: Trainer, path: Path, configuration: Configuration) -> str:
    """Take over what fits of the networks and normalisers in a run's newest checkpoint.

    Optimisers, random numbers, the window or replay, and recovery begin anew. The other run may be
    of another environment, as long as its policy fits.

    Returns:
        What was taken and what was not, for the user.

    Raises:
        UsageError: It is no run, of another variant, or its policy does not fit.
    """
    other = configuration_of(path, configuration.run.variant)
    try:
        tensors, state = checkpoint.load(path / "checkpoints")
    except RunDirectoryError as error:
        raise UsageError(f"--init-from: {error}") from None
    present, there = _parts(trainer.state()[0]), _parts(tensors)
    ours, theirs = asdict(configuration.hyper), asdict(other.hyper)

    def fits(name: str) -> bool:
        same = all(ours.get(each) == theirs.get(each) for each in _SHAPED_BY.get(name, ()))
        return same and _shapes(present[name]) == _shapes(there.get(name, {}))

    if not (fits(_NORMALISER) and fits("policy")):
        raise UsageError(
            f"--init-from: the policy of {path} ({other.run.env}) does not fit: its observations, "
            f"its actions or one of {', '.join(e for e in _SHAPED_BY['policy'] if e in ours)} are "
            f"others than those of this run ({configuration.run.env})"
        )
    taken = [name for name in present if fits(name)]
    trainer.begin_with((tensors, state["algorithm"]), taken)
    left = [name for name in present if name not in taken]
    words = f"begins with {', '.join(taken)} of {path}"
    return f"{words}; not with {', '.join(left)}, which has other sizes there" if left else words


def configuration_of(path: Path, variant: str) -> Configuration:
    """The configuration of a run to begin with.

    Raises:
        UsageError: It is no run, or of another variant.
    """
    try:
        found = assemble(*read(path / CONFIG))
    except UsageError as error:
        raise UsageError(f"--init-from: {path} is no run that can be used: {error}") from None
    if found.run.variant != variant:
        raise UsageError(f"--init-from: {path} is {found.run.variant}, expected {variant}")
    return found


_PARTS = ("policy", "value", "q", "critics", "targets", "average", "log_temperature")
_NORMALISER = "normaliser"
_OF_POLICY = ("policy_sizes", "layer_norm", "network", "norm_obs")
_OF_CRITICS = ("critic_sizes", "num_critics", "num_quantiles", "layer_norm", "network")
# Networks are stored flat: what else decides how the numbers are to be read.
_SHAPED_BY = {
    "policy": _OF_POLICY,
    "average": _OF_POLICY,
    "value": ("value_sizes", "layer_norm"),
    "q": ("q_sizes", "layer_norm"),
    "critics": _OF_CRITICS,
    "targets": _OF_CRITICS,
}


def _parts(tensors: Mapping[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    """The networks by name, and all of the normaliser of observations as one."""
    found = {name: {name: tensors[name]} for name in _PARTS if name in tensors}
    found[_NORMALISER] = {k: v for k, v in tensors.items() if k.startswith(f"{_NORMALISER}.")}
    return found


def _shapes(part: Mapping[str, Tensor]) -> dict[str, tuple[int, ...]]:
    return {name: tuple(tensor.shape) for name, tensor in part.items()}
