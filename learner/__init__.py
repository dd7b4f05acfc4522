"""The learning side: takes segments in, fits the networks, recovers, publishes, remembers."""
