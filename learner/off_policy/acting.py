"""Acting off-policy, from observation to action in the environment's units, as one module."""

import math
from typing import Literal

import torch
from torch import Tensor

from a2s.learner.networks.acting import ActionBounds, Choice
from a2s.learner.networks.ensemble import Ensemble, score_many
from a2s.learner.networks.gaussian import log_density
from a2s.learner.networks.layers import run
from a2s.learner.networks.normaliser import Normaliser
from a2s.learner.off_policy.squashed import draw_several, gaussian
from a2s.learner.off_policy.targets import pick_best

OffPolicySuggesterMode = Literal["uniform", "first", "hard", "soft"]


class OffPolicySuggester:
    """Normaliser, policy, K suggestions, critics, selection and action bounds.

    It holds the networks it is given, not copies, and computes in float32 whatever they learn in.
    One suggester serves every way of acting by its noise:

    ==================================================  ==========================================
    behaviour                                           ``normal`` and ``gumbel`` as drawn
    mean action                                         ``normal = 0``
    best of K, the mean among them                      ``normal[:, 0] = 0``, ``gumbel = 0``
    ==================================================  ==========================================

    The modes are ``uniform``: actions spread evenly over the bounds, for warm-up, without the
    policy; ``first``: the only suggestion; ``hard``: the one of largest score; ``soft``: drawn,
    each with a chance in proportion to exp(score / temperature) over its density under the policy.
    As K grows, that is a draw from the Boltzmann distribution of the scores, to which SAC's policy
    is fitted, and so no less random than the policy is to be (docs/adr/0011).

    Only ``hard`` and ``soft`` use the critics; in the other modes K is 1. Action bounds are float32
    ``[A]``. The ``temperature`` of ``soft`` is in returns, ``[]``; critics are in units of
    ``return_size``, ``[]``.
    """

    def __init__(
        self,
        *,
        normaliser: Normaliser,
        policy: Ensemble,
        critics: Ensemble,
        action_low: Tensor,
        action_high: Tensor,
        mode: OffPolicySuggesterMode,
        suggestions: int,
        temperature: Tensor,
        return_size: Tensor,
    ) -> None:
        if mode in ("uniform", "first") and suggestions != 1:
            raise ValueError(f"mode {mode}, K {suggestions}: expected K 1 without critics")
        self.normaliser = normaliser
        self.policy = policy
        self.critics = critics
        self.bounds = ActionBounds(action_low, action_high)
        self.mode: OffPolicySuggesterMode = mode
        self.suggestions = suggestions
        self.temperature = temperature
        self.return_size = return_size

    @torch.no_grad()
    def __call__(self, obs: Tensor, normal: Tensor, gumbel: Tensor | None = None) -> Choice:
        """Choose actions for observations as the environment gave them, float32 ``[B, D]``.

        Standard normal noise is ``[B, K, A]``; standard Gumbel noise ``[B, K]`` is for the mode
        ``soft``. Without it, or where all of it is 0, the largest score counts.
        """
        q_spread = torch.zeros(len(obs), device=obs.device)
        if self.mode == "uniform":
            suggestion = torch.erf(normal[:, 0] * math.sqrt(0.5))
            log_prob = torch.full_like(q_spread, -math.log(2.0) * suggestion.shape[1])
            return Choice(self.bounds.to_env(suggestion), suggestion, log_prob, q_spread)
        norm_obs = self.normaliser(obs)
        output = run(self.policy.form.layers, self.policy.exact, norm_obs.unsqueeze(0))
        policy = gaussian(output[0])
        u = draw_several(policy, normal)
        log_prob = log_density(normal, policy.log_std.unsqueeze(1), u)
        if self.mode == "first":
            return self._choice(u.squeeze(1), log_prob.squeeze(1), q_spread)
        score = self.score(norm_obs, u.tanh())
        q_spread = score.amax(1) - score.mean(1)
        if self.mode == "soft":
            if gumbel is None:
                gumbel = torch.zeros_like(score)
            is_drawn = gumbel.square().sum(1, keepdim=True).sign()
            score = score / self.temperature - is_drawn * log_prob
            log_prob = log_prob + score.log_softmax(1) + math.log(self.suggestions)
            score = score + gumbel
        u, chosen = pick_best(score, u, log_prob.unsqueeze(2))
        return self._choice(u, chosen.squeeze(1), q_spread)

    def _choice(self, u: Tensor, log_prob: Tensor, q_spread: Tensor) -> Choice:
        suggestion = u.tanh()
        return Choice(self.bounds.to_env(suggestion), suggestion, log_prob, q_spread)

    def score(self, norm_obs: Tensor, action: Tensor) -> Tensor:
        """Means of the critics, in returns, ``[B, K]``.

        Observations are normalised, ``[B, D]``, actions canonical, ``[B, K, A]``.
        """
        critics = self.critics
        shared = action.expand(critics.members, *action.shape)
        q_value = score_many(critics.form, critics.exact, norm_obs, shared) * self.return_size
        return q_value.mean(0)
