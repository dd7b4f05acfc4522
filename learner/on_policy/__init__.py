"""Algorithm 1 of the paper, and A2C: pure.

`update.py` is the algorithm, `authors.py` the paper to the letter. Equation 5: `recovery.py`,
equation 6: `suggestions.py` and `distil.py`, equation 4: `policy.py`, whose steps are in
`fit_kernels.py`.
"""
