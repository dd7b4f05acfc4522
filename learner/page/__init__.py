"""The live page: the newest two hours of runs in a browser, from what `/metrics` says."""
