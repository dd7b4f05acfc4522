"""The presets of on-policy learning: for use, as the published code, as the text of the paper."""

from dataclasses import replace

from a2s.learner.on_policy.authors_config import AuthorsConfig
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.settings import Preset

AnyOnPolicyConfig = OnPolicyConfig | AuthorsConfig

_PAPER = replace(
    AuthorsConfig(),
    batch_steps=1,  # algorithm 1: one episode
    min_episodes=1,  # algorithm 1
    advantage="q-v",  # algorithm 1
    recovery_statistic="mean",  # section 4.1.1
    recovery_offset=0.0,  # equation 5
    recovery_learns=False,  # section 4.1.1
)
PRESETS: dict[str, Preset[AnyOnPolicyConfig]] = {
    "modern": Preset(OnPolicyConfig(), ""),
    "authors": Preset(AuthorsConfig(), ""),
    "paper": Preset(_PAPER, "text of the paper"),
}
