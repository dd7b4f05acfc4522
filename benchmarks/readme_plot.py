"""Draw docs/curves.png, the picture of the README, from the kept episodes of the suite."""

from pathlib import Path

from suites import SUITES, kept_episodes, name_of

from a2s.commands.plot import draw, read_curve

SUITE = "suggestions"
LABELS = {"modern": "A2S, the default", "a2c": "A2C"}


def main() -> None:
    """Draw a panel for each environment, as figure 4 of the paper."""
    root, suite = Path(__file__).parents[1], SUITES[SUITE]
    folder = root / "benchmarks" / suite.folder
    panels = {
        env: {
            text: [
                read_curve(kept_episodes(folder, SUITE, name_of(SUITE, env, label, seed)))
                for seed in suite.seeds
            ]
            for label, text in LABELS.items()
        }
        for env in suite.envs
    }
    draw(panels, root / "docs" / "curves.png")


if __name__ == "__main__":
    main()
