"""Acting, from observation to action in the environment's units, as one module."""

from typing import Literal

import torch
from torch import Tensor

from a2s.learner.networks.acting import ActionBounds, Choice
from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.networks.gaussian import Policy, log_density
from a2s.learner.networks.normaliser import Normaliser
from a2s.learner.on_policy.config import ActionMode
from a2s.learner.on_policy.suggestion import (
    as_q_sees,
    log_preference,
    select_first,
    select_hard,
    select_soft,
    suggest,
    take,
)

SuggesterMode = Literal["first", "hard", "soft"]


class Suggester:
    """Normaliser, policy, K suggestions, Q, selection and action bounds.

    It holds the networks it is given, not copies. One suggester serves every way of acting by
    its noise:

    ==================================================  ==========================================
    behaviour                                           ``normal`` and ``gumbel`` as drawn
    mean action                                         ``normal = 0``
    best of K, the mean among them                      ``normal[:, 0] = 0``, ``gumbel = 0``
    ==================================================  ==========================================

    Args:
        normaliser: Of the observations.
        policy: Suggests.
        q_net: Picks; ``None`` in the mode ``first``.
        action_low: Lowest action of the environment, float32 ``[A]``.
        action_high: Highest, float32 ``[A]``.
        mode: ``first``: the only suggestion, no Q inside (A2C, or Q not trained yet); ``hard``;
            ``soft``.
        suggestions: K; 1 in the mode ``first``.
        temperature: Of ``soft``.
        action_mode: What Q sees. The environment gets the same action either way.
        q_scale: Returns in one unit of Q's output.
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
        temperature: float = 1.0,
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
        self.temperature = temperature
        self.action_mode: ActionMode = action_mode
        self.q_scale = q_scale
        self.bounds = ActionBounds(action_low, action_high)

    def __call__(self, obs: Tensor, normal: Tensor, gumbel: Tensor | None = None) -> Choice:
        """Choose actions.

        Args:
            obs: As the environment gave them, float32 ``[B, D]``.
            normal: Standard normal noise, float32 ``[B, K, A]``.
            gumbel: Standard Gumbel noise, float32 ``[B, K]``; needed in the mode ``soft`` alone.

        Raises:
            A2SError: A score of Q is not finite.
        """
        seen = self.normaliser(obs)
        std = self.policy.std()
        candidates = suggest(self.policy(seen), std, normal)
        q_spread = torch.zeros(len(obs))
        index, preference = select_first(normal), torch.zeros(len(obs))
        if self.q_net is not None:
            q_value = self.q_net.score(seen, as_q_sees(candidates, self.action_mode))
            q_spread = (q_value.amax(1) - q_value.mean(1)) * self.q_scale
            if gumbel is None or self.mode == "hard":
                index = select_hard(q_value)
            else:
                index = select_soft(q_value, gumbel, self.temperature)
                preference = log_preference(q_value, index, self.temperature)
        suggestion, noise = take(candidates, index), take(normal, index)
        log_prob = log_density(noise, self.policy.log_std) + preference
        return Choice(self.bounds.to_env(suggestion), suggestion, log_prob, q_spread)
