"""The learning side: gathers segments, fits the networks, recovers, publishes, remembers."""
