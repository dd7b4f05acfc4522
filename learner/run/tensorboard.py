"""A run for TensorBoard, under the names that Stable-Baselines3 uses."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from a2s.learner.run.status import Score, Status

FOLDER = "tensorboard"
_ON_POLICY = {
    "kl": "train/approx_kl",
    "value_explained_variance": "train/explained_variance",
    "learning_rate": "train/learning_rate",
    "policy_loss": "train/policy_gradient_loss",
    "value_loss": "train/value_loss",
    "q_loss": "train/q_loss",
    "std": "train/std",
}
_OFF_POLICY = {
    "policy_loss": "train/actor_loss",
    "q_loss": "train/critic_loss",
    "temperature": "train/ent_coef",
}


class Board:
    """Writes event files into ``tensorboard/`` of a run directory, over environment steps.

    A run goes on after ``env_steps``: what files of earlier starts have after that, TensorBoard
    drops. Of ``scores``, those of earlier starts, what is dropped with it is written again.
    """

    def __init__(
        self, path: Path, variant: str, env_steps: int = 0, scores: Sequence[Score] = ()
    ) -> None:
        from tensorboardX import SummaryWriter  # of an extra: a2s[tensorboard]

        self._writer = SummaryWriter(logdir=str(path / FOLDER), purge_step=env_steps + 1)
        self._tags = _OFF_POLICY if variant == "off-policy" else _ON_POLICY
        self._is_on_policy = variant != "off-policy"
        self._score = scores[-1] if scores else None
        for score in scores:
            if score.env_steps > env_steps:
                self._add(score)

    def update(self, row: Mapping[str, object], status: Status) -> None:
        """Write an update's row, the episodes so far, and an evaluation if there is a new one."""
        step, episodes = status.env_steps, status.episodes
        found = {tag: row.get(name) for name, tag in self._tags.items()}
        if self._is_on_policy and isinstance(entropy := row.get("entropy"), float):
            found["train/entropy_loss"] = -entropy  # as they minimise it
        found["time/fps"] = status.env_steps_per_s
        found["train/n_updates"] = status.updates
        if episodes.returns:
            found["rollout/ep_rew_mean"] = episodes.mean_return
            found["rollout/ep_len_mean"] = sum(episodes.lengths) / len(episodes.lengths)
        if (success := episodes.mean_metrics.get("is_success")) is not None:
            found["rollout/success_rate"] = success
        for tag, value in found.items():
            if isinstance(value, int | float) and math.isfinite(value):
                self._writer.add_scalar(tag, value, step)
        score = status.latest_score
        if score is not None and score is not self._score:
            self._score = score
            self._add(score)

    def _add(self, score: Score) -> None:
        self._writer.add_scalar("eval/mean_reward", score.mean, score.env_steps)

    def close(self) -> None:
        """Write what is left, and close the file."""
        self._writer.close()
