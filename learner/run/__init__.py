"""The settings of a run, its files on the disk, and its display."""
