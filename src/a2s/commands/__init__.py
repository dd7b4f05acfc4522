"""The commands of ``a2s``: each puts together what actors and learner offer."""
