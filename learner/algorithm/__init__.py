"""The algorithm: tensors, numbers and a generator in, tensors and numbers out.

No clock, logging, file, thread or network. The letters in the shapes are used throughout::

    N  steps in one batch             D  observation size
    S  segments in one batch          A  action size
    B  rows of one call               K  suggestions per observation
    M  rows of one minibatch          E  critics in the ensemble

One update, in order: `gather_evidence` (targets and advantages, V before its update), the rule
of the `StepSize`, `Recovery` (equation 5), `fit_critics`, `update_policy` (equation 6, then the
policy gradient).
"""
