"""A replay served by dm-reverb, for served.py: says when it is ready, then its rates.

Run by an interpreter of its own, for dm-reverb 0.14 needs an older numpy than a2s. A line on
standard input with a number of seconds is answered with the batches a second of that long.
"""

import sys
import time

import numpy as np
import reverb
import tensorflow as tf

OBS, ACTION, BATCH, ROWS = 17, 6, 256, 20_000
TABLE = "replay"


def main() -> None:
    """Fill a table of transitions, then sample batches for as long as told."""
    shapes = {"obs": (OBS,), "action": (ACTION,), "reward": (), "next_obs": (OBS,), "done": ()}
    signature = {name: tf.TensorSpec(shape, tf.float32, name) for name, shape in shapes.items()}
    table = reverb.Table(
        TABLE,
        sampler=reverb.selectors.Uniform(),
        remover=reverb.selectors.Fifo(),
        max_size=ROWS,
        rate_limiter=reverb.rate_limiters.MinSize(1),
        signature=signature,
    )
    server = reverb.Server([table])
    rng = np.random.default_rng(0)
    with server.localhost_client().trajectory_writer(num_keep_alive_refs=1) as writer:
        for _ in range(ROWS):
            step = {name: rng.normal(size=shape) for name, shape in shapes.items()}
            writer.append({name: np.float32(value) for name, value in step.items()})
            item = {name: column[-1] for name, column in writer.history.items()}
            writer.create_item(TABLE, priority=1.0, trajectory=item)
            writer.flush(block_until_num_items=32)
    samples = reverb.TrajectoryDataset.from_table_signature(
        f"localhost:{server.port}", TABLE, max_in_flight_samples_per_worker=2 * BATCH
    )
    batches = samples.batch(BATCH).as_numpy_iterator()
    next(batches)
    _say("ready")
    for line in sys.stdin:
        count, begin_s = 0, time.perf_counter()
        while time.perf_counter() - begin_s < float(line):
            next(batches)
            count += 1
        _say(str(count / (time.perf_counter() - begin_s)))


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
