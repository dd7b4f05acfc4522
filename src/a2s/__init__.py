"""a2s: distributed actor-learner training with the advantage actor-suggester.

The packages ``a2s.protocol``, ``a2s.actors`` and ``a2s.learner`` live in the folders of the same
names at the root of the repository.
"""

__version__ = "0.1.0"
