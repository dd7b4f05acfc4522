"""Algorithm 1 of the paper, and A2C: pure."""
