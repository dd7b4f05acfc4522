"""The commands of ``a2s``, built from actors and learner."""
