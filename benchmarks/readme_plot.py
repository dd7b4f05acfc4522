"""Draw docs/curves.png, the picture of the README, from the kept episodes of the suite ``100k``."""

from pathlib import Path

from matplotlib import pyplot as plt
from suites import SUITES, kept_episodes, name_of

from a2s.commands.plot import on_a_grid, read_curve, smooth

SUITE = "100k"
ENVS = ("Hopper-v5", "Walker2d-v5", "HalfCheetah-v5", "Ant-v5")
LABELS = {
    "off-policy": "a2s off-policy, 10 suggestions (default)",
    "off-policy-k1": "a2s off-policy, 1 suggestion",
    "sb3-sac": "SAC of Stable-Baselines3, its defaults",
}


def main() -> None:
    """Draw a panel for each environment: each seed thin, the mean over seeds thick."""
    root = Path(__file__).parents[1]
    folder = root / "benchmarks" / SUITES[SUITE].folder
    figure, axes = plt.subplots(2, 2, figsize=(11, 7.5), layout="constrained")
    for axis, env in zip(axes.flat, ENVS, strict=True):
        for index, (label, text) in enumerate(LABELS.items()):
            names = [name_of(SUITE, env, label, seed) for seed in SUITES[SUITE].seeds]
            steps, returns = on_a_grid(
                [read_curve(kept_episodes(folder, SUITE, name)) for name in names]
            )
            axis.plot(steps, returns.T, color=f"C{index}", alpha=0.3, linewidth=0.8)
            mean = smooth(returns.mean(0))
            axis.plot(steps, mean, color=f"C{index}", linewidth=2.0, label=text)
        axis.set(title=env, xlabel="environment steps", ylabel="training return")
        axis.grid(alpha=0.3)
    handles, texts = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, texts, loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(root / "docs" / "curves.png", dpi=100)


if __name__ == "__main__":
    main()
