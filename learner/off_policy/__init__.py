"""Algorithm 2 of the paper, and SAC: pure."""
