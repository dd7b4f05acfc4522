"""Check that stored tensors fit the present networks."""

from collections.abc import Mapping

from torch import Tensor

from a2s.protocol.errors import RunDirectoryError


def check_tensors(found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    """Refuse stored tensors that do not fit.

    Raises:
        RunDirectoryError: One is missing or has another shape.
    """
    for name, tensor in expected.items():
        if name not in found:
            wrong = f"found no tensor {name!r}, expected one"
        elif found[name].shape != tensor.shape:
            shapes = f"found shape {list(found[name].shape)}, expected {list(tensor.shape)}"
            wrong = f"{name}: {shapes}"
        else:
            continue
        raise RunDirectoryError(
            f"learner state: {wrong}; it is of other hyperparameters or of another version of a2s: "
            "begin a new run"
        )
