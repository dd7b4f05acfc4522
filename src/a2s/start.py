"""Where the program begins: a signal ends it without a word, also while the rest is imported."""

# What is behind `signal`, and takes no time to import: until then a signal is Python's to tell of.
import _signal as signal  # type: ignore[import-not-found]
import os


def main() -> None:
    """Run the command line; until it has its own way, signals end with their exit codes."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:  # as nohup, and shells, have it
            signal.signal(number, lambda number, _: os._exit(128 + number))
    from a2s.cli import main as run

    run()


if __name__ == "__main__":
    main()
