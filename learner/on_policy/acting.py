"""Acting: the policy suggests K actions, Q picks one, the environment gets it in its own units.

Source: algorithm 1 of the paper, "for k = 1, K action suggestions".
"""

import math
from typing import Literal

import torch
from torch import Tensor

from a2s.learner.networks.acting import ActionBounds, Choice
from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.networks.gaussian import Policy, log_density
from a2s.learner.networks.normaliser import Normaliser
from a2s.learner.on_policy import categorical
from a2s.protocol.errors import A2SError

ActionMode = Literal["clip", "raw"]
SuggesterMode = Literal["first", "hard", "soft"]


class Suggester:
    """Normaliser, policy, K suggestions, Q, selection and action bounds.

    It holds the networks it is given, not copies. Its noise decides how it acts:

    ==================================================  ==========================================
    as in training                                      ``normal`` and ``gumbel`` as drawn
    mean action                                         ``normal = 0``
    best of K, the mean among them                      ``normal[:, 0] = 0``, ``gumbel = 0``
    ==================================================  ==========================================

    The modes are ``first``: the only suggestion, ``q_net`` ``None`` and K 1 (A2C, or Q is not
    trained yet: the argmax of an untrained Q is one arbitrary direction everywhere); ``hard``;
    ``soft``, with ``inverse_temperature`` per unit of Q's output. ``action_mode`` decides whether
    Q sees suggestions clipped to the bounds, ``[A]``, or raw: the environment gets the same action
    either way. ``q_scale`` is the returns in one unit of Q's output.

    Raises:
        ValueError: Mode, Q and K contradict each other.
    """

    def __init__(
        self,
        *,
        normaliser: Normaliser,
        policy: Policy,
        q_net: Ensemble | None,
        action_low: Tensor,
        action_high: Tensor,
        mode: SuggesterMode,
        suggestions: int,
        inverse_temperature: float = 1.0,
        action_mode: ActionMode = "clip",
        q_scale: float = 1.0,
    ) -> None:
        if (q_net is None) != (mode == "first") or (mode == "first" and suggestions != 1):
            raise ValueError(f"mode {mode}, K {suggestions}: only mode 'first' has no Q, and K 1")
        self.normaliser = normaliser
        self.policy = policy
        self.q_net = q_net
        self.mode: SuggesterMode = mode
        self.suggestions = suggestions
        self.inverse_temperature = inverse_temperature
        self.action_mode: ActionMode = action_mode
        self.q_scale = q_scale
        self.bounds = ActionBounds(action_low, action_high)

    def __call__(self, obs: Tensor, normal: Tensor, gumbel: Tensor | None = None) -> Choice:
        """Choose actions for observations as the environment gave them, float32 ``[B, D]``.

        Standard normal noise is ``[B, K, A]``; standard Gumbel noise ``[B, K]``, only for ``soft``.

        Raises:
            A2SError: A score of Q is not finite.
        """
        norm_obs = self.normaliser(obs)
        candidates = suggest(self.policy(norm_obs), self.policy.std(), normal)
        index = torch.zeros(len(obs), dtype=torch.int64)
        preference = q_spread = torch.zeros(len(obs))
        if self.q_net is not None:
            q_value = q_scores(self.q_net, norm_obs, as_q_sees(candidates, self.action_mode))
            q_spread = self.q_scale * (q_value.amax(1) - q_value.mean(1))
            if self.mode == "hard" or gumbel is None:
                index = select_hard(q_value)
            else:
                index = select_soft(q_value, gumbel, self.inverse_temperature)
                preference = log_preference(q_value, index, self.inverse_temperature)
        suggestion, noise = take(candidates, index), take(normal, index)
        log_prob = log_density(noise, self.policy.log_std) + preference
        return Choice(self.bounds.to_env(suggestion), suggestion, log_prob, q_spread)


def suggest(mean: Tensor, std: Tensor, normal: Tensor) -> Tensor:
    """Draw suggestions, canonical (-1..1 spans the action bounds) and not clipped.

    Means ``[B, A]``, deviation ``[A]`` and standard normal noise ``[B, K, A]`` to ``[B, K, A]``.
    """
    return mean.unsqueeze(1) + std * normal


def as_q_sees(suggestion: Tensor, mode: ActionMode) -> Tensor:
    """Suggestions of any shape in the form that Q takes: clipped to -1..1, or raw."""
    return suggestion.clamp(-1.0, 1.0) if mode == "clip" else suggestion


def select_hard(q_value: Tensor) -> Tensor:
    """Pick the suggestion of largest Q, among equals the first: ``[B, K]`` to int64 ``[B]``.

    Raises:
        A2SError: A score is not finite.
    """
    _require_finite(q_value)
    return q_value.argmax(1)


def select_soft(q_value: Tensor, gumbel: Tensor, inverse_temperature: float) -> Tensor:
    """Draw a suggestion by ``softmax(inverse_temperature * q)``.

    ``argmax(z + gumbel)`` is a draw from ``softmax(z)``: scores and standard Gumbel noise
    ``[B, K]`` to int64 ``[B]``. Noise of 0 gives the suggestion of largest Q.

    Raises:
        A2SError: A score is not finite.
    """
    _require_finite(q_value)
    return (_preferences(q_value, inverse_temperature) + gumbel).argmax(1)


def log_preference(q_value: Tensor, index: Tensor, inverse_temperature: float) -> Tensor:
    """How much likelier than a draw from the policy the soft selection made its choice, in logs.

    ``log(K p)``, p the chance of the chosen one given the K. An average over executed suggestions,
    each weighed by ``1 / (K p)``, is one over the policy: K drawn alike, each counted once.
    Scores ``[B, K]`` and chosen indices ``[B]`` to ``[B]``; 0 where K is 1 or all scores are equal.
    """
    chance = _preferences(q_value, inverse_temperature).log_softmax(1)
    return chance.gather(1, index.unsqueeze(1)).squeeze(1) + math.log(q_value.shape[1])


def take(candidate: Tensor, index: Tensor) -> Tensor:
    """Row by row the candidate of that index: ``[B, K, A]``, ``[B]`` to ``[B, A]``."""
    return candidate[torch.arange(len(index), device=index.device), index]


def q_scores(q_net: Ensemble, norm_obs: Tensor, action: Tensor) -> Tensor:
    """Scores of actions ``[B, K, A]``, ``[B, K]``: of one Q, or of several categorical ones."""
    if q_net.single:
        return q_net.score(norm_obs, action)
    return categorical.score(q_net, norm_obs, action)


def _preferences(q_value: Tensor, inverse_temperature: float) -> Tensor:
    return inverse_temperature * (q_value - q_value.mean(1, keepdim=True))


def _require_finite(q_value: Tensor) -> None:
    if not bool(torch.isfinite(q_value).all()):
        bad = int((~torch.isfinite(q_value)).sum())
        raise A2SError(f"q scores: found {bad} non-finite of {q_value.numel()}, expected finite")
