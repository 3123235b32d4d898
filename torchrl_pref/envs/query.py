"""The paper's first question as an environment: which query of a pool to ask.

Shapes: as in ``envs.session``.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_pref.beliefs.base import BeliefBase
from torchrl_pref.envs.session import SessionEnv, State
from torchrl_pref.errors import InputError, check_count, check_flag
from torchrl_pref.humans.base import HumanBase
from torchrl_pref.pool import QueryPool


class QueryEnv(SessionEnv):
    r"""The paper's first formulation: the action is which query to ask (section 3.3).

    State: the belief. Action: the index of a candidate. Reward: what the answer adds to the
    objective; for the paper's it is the information gain in bits of the asked query,
    :math:`r = H(\omega \mid Q) - E_{q_i} H(\omega \mid q_i, Q)`. The episode ends after H answers.

    Args:
        pool: the queries, normalised.
        human: who answers.
        belief: how answers become a belief.
        budget: H, queries in an episode, at least 1.
        candidates: C, how many queries of the pool are on the table, at most N. Fewer than N makes
            a fresh random subset for each session, so that a policy learns to choose and not to
            remember. None puts the whole pool on the table, in order.
        repeats: whether a query may be asked again.
        objective: a name of ``objectives.OBJECTIVES``; the default is the paper's.
        batch_size: (B,), sessions that run side by side.
        seed: seeds the environment's own generator; the global generators are never used.
        device: where the tensors live.

    Raises:
        InputError: a number is below its minimum, or without repeats the candidates are too few.
    """

    _state_keys = ("human", "samples", "mean", "history", "n_asked", "metrics", "candidates")

    def __init__(
        self,
        pool: QueryPool,
        human: HumanBase,
        belief: BeliefBase,
        budget: int = 20,
        candidates: int | None = None,
        repeats: bool = True,
        objective: str = "information_gain",
        batch_size: tuple[int, ...] = (64,),
        seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(pool, human, belief, budget, objective, batch_size, seed, device)
        self.n_candidates = len(pool)
        if candidates is not None:
            self.n_candidates = min(check_count("setup.candidates", candidates, 1), len(pool))
        if not repeats and self.n_candidates < budget:
            raise InputError(
                f"setup.repeats=false with {self.n_candidates} candidates and setup.budget={budget}"
                ": expected at least as many candidates as asks; raise one or lower the other"
            )
        self.repeats = check_flag("setup.repeats", repeats)
        self._make_specs(self.n_candidates)

    def _fresh_state(self) -> TensorDict:
        state = super()._fresh_state()
        size, n_queries = self.batch_size.numel(), len(self.features)
        if self.n_candidates == n_queries:
            chosen = torch.arange(n_queries, device=self.device).expand(size, -1)
        else:
            keys = torch.rand((size, n_queries), generator=self.generator, device=self.device)
            chosen = keys.topk(self.n_candidates, dim=-1).indices
        return state.set("candidates", chosen)

    def _observe(self, state: State) -> None:
        super()._observe(state)
        candidates = state["candidates"]
        if self.n_candidates == len(self.features):
            # A view: the whole pool is the same for every session.
            state["queries"] = self.features.expand(len(candidates), *self.features.shape)
        else:
            state["queries"] = self.features[candidates]
        mask = torch.ones_like(candidates, dtype=torch.bool)
        if not self.repeats:
            asked = state["history"]["queries"]
            mask = ~(candidates.unsqueeze(-1) == asked.unsqueeze(-2)).any(-1)
            # A finished session offers everything again, so that a policy still has a distribution.
            mask = mask | ~mask.any(-1, keepdim=True)
        state["action_mask"] = mask

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = self._check_action(tensordict, self.n_candidates, "the place of a candidate")
        index = tensordict["candidates"].gather(-1, action.unsqueeze(-1)).squeeze(-1)
        if not self.repeats:
            self._check_new(tensordict, index)
        state = self._ask(tensordict, index, tensordict["n_asked"].squeeze(-1) < self.budget)
        self._observe(state)
        reward = self._objective.potential(state) - self._objective.potential(tensordict)
        terminated = state["n_asked"] >= self.budget
        return self._finish(state, reward, torch.zeros_like(terminated), terminated)

    def _check_new(self, tensordict: TensorDictBase, index: Tensor) -> None:
        """Refuse to ask pool query ``index`` (B) again in a session that goes on."""
        again = (tensordict["history", "queries"] == index.unsqueeze(-1)).any(-1, keepdim=True)
        if (again & (tensordict["n_asked"] < self.budget)).any():
            raise InputError(
                "action: a query that was asked before, where repeats=False; expected one that "
                "action_mask allows; mask the policy, or make the environment with repeats=True"
            )
