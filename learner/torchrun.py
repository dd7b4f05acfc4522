"""What torchrun tells the processes that it starts; read without importing torch."""

import os


def number_and_count() -> tuple[int, int]:
    """This process's number, from 0, and how many there are; ``(0, 1)`` without torchrun.

    Others set ``RANK`` and ``WORLD_SIZE`` too, and mean nothing for a2s by that.
    """
    if "TORCHELASTIC_RUN_ID" not in os.environ:
        return 0, 1
    return int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
