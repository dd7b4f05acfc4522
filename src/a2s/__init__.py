"""a2s: distributed actor-learner training with the advantage actor-suggester.

The packages ``a2s.protocol``, ``a2s.actors`` and ``a2s.learner`` live in the folders of the same
names at the root of the repository.
"""

TYPE_CHECKING = False  # as type checkers know it; until the program begins, a signal is Python's

if TYPE_CHECKING:
    from pathlib import Path

    from a2s.actors.policy import Policy

__version__ = "0.1.0"


def load_policy(path: "str | Path", mode: str = "mean", seed: int = 0) -> "Policy":
    """Load a trained policy; ``policy(obs)`` is the action, for one observation or a batch.

    Args:
        path: A run directory (its best policy if there is one, else the latest), or a policy file.
        mode: ``mean``, ``best-of-k`` or ``behaviour``, as in ``a2s evaluate --mode``.
        seed: Of the noise of ``best-of-k`` and ``behaviour``.

    Raises:
        UsageError: There is no policy, or the mode is unknown.
    """
    from pathlib import Path

    from a2s.actors.policy import load_policy

    return load_policy(Path(path), mode, seed)
