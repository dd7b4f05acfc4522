"""The replay: every accepted transition of a run, durable, sampled and served."""
