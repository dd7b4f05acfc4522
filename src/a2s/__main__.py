"""``python -m a2s``: the same as ``a2s``."""

from a2s.start import main

if __name__ == "__main__":
    main()
