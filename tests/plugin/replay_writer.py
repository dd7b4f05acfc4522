"""A learner in miniature: inserts what one actor played, and tells each acknowledgement.

``python replay_writer.py DIRECTORY FIRST_SEQ``: prints ``SEQ`` once segment SEQ is in the replay.
"""

import sys
from pathlib import Path

from replay_oracle import make_segment

from a2s.learner.replay import directory

MAX_STEPS = 7


def played(seq: int, begin: int) -> list[float]:
    """Observations of segment ``seq``, of which the first step is the ``begin``-th of all."""
    return [float(begin + i) for i in range(1 + seq % MAX_STEPS + 1)]


def main() -> None:
    """Insert until killed."""
    replay = directory.open_existing(Path(sys.argv[1]))
    seq = int(sys.argv[2])
    while True:
        obs = played(seq, replay.live.stop)
        steps = len(obs) - 1
        replay.insert(make_segment(obs, [1.0] * steps, seq=seq, before=replay.live.stop))
        sys.stdout.write(f"{seq}\n")
        sys.stdout.flush()
        seq += 1


if __name__ == "__main__":
    main()
