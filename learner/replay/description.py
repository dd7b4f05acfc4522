"""What a replay directory says about itself, so that it is never read as something else."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from a2s.learner.run.directory import write_atomically
from a2s.protocol.errors import MalformedMessageError, RunDirectoryError
from a2s.protocol.fields import Spaces

NAME = "replay.json"
_FORMAT = 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Description:
    """The first file of a replay directory; it names the others.

    Attributes:
        env_id: Environment of the transitions.
        spaces: Its spaces.
        capacity: Rows that are live at most.
        files: Number in the names of the files: another capacity has others.
    """

    env_id: str
    spaces: Spaces
    capacity: int
    files: int

    def write(self, path: Path) -> None:
        """Write ``replay.json`` into a directory, whole or not at all."""
        offset = self.spaces.obs_offset
        document = {
            "format": _FORMAT,
            "env_id": self.env_id,
            "obs_size": self.spaces.obs_size,
            "action_low": self.spaces.action_low.tolist(),
            "action_high": self.spaces.action_high.tolist(),
            "obs_offset": None if offset is None else offset.tolist(),
            "capacity": self.capacity,
            "files": self.files,
        }
        write_atomically(path / NAME, json.dumps(document, indent=2).encode())

    def require(self, path: Path, env_id: str, spaces: Spaces) -> None:
        """Check that the transitions are of this environment.

        Raises:
            RunDirectoryError: They are of another one.
        """
        advice = "name another run directory"
        if self.env_id != env_id:
            raise RunDirectoryError(
                f"replay {path}: found environment {self.env_id}, expected {env_id}; {advice}"
            )
        difference = spaces.differs_from(self.spaces)
        if difference:
            raise RunDirectoryError(f"replay {path}: found {difference}; {advice}")


def read(path: Path) -> Description:
    """Read the description of a replay directory.

    Raises:
        RunDirectoryError: There is none, or it is of another format.
    """
    try:
        document = json.loads((path / NAME).read_bytes())
        if document["format"] != _FORMAT:
            raise RunDirectoryError(
                f"replay {path}: found format {document['format']}, expected {_FORMAT}"
            )
        offset = document.get("obs_offset")
        return Description(
            env_id=str(document["env_id"]),
            spaces=Spaces(
                obs_size=int(document["obs_size"]),
                action_low=np.array(document["action_low"], np.float32),
                action_high=np.array(document["action_high"], np.float32),
                obs_offset=None if offset is None else np.array(offset, np.float32),
            ),
            capacity=int(document["capacity"]),
            files=int(document["files"]),
        )
    except FileNotFoundError:
        raise RunDirectoryError(f"{path}: holds no replay, it has no {NAME}") from None
    except (OSError, ValueError, KeyError, TypeError, MalformedMessageError) as error:
        raise RunDirectoryError(f"replay {path}: {NAME} is damaged ({error})") from None
