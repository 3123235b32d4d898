"""The paper's first question as an environment: which query of a pool to ask.

Shapes: as in ``envs.session``, and n questions asked at once.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchrl.data import Composite

from torchrl_pref.beliefs.base import BeliefBase
from torchrl_pref.envs.allowed import AllowedActions, Table
from torchrl_pref.envs.session import SessionEnv
from torchrl_pref.envs.transition import Outcome, SessionState, Tree
from torchrl_pref.errors import InputError, check_batch, check_count, check_flag
from torchrl_pref.humans.base import HumanBase
from torchrl_pref.humans.demonstrations import Demonstrations
from torchrl_pref.pool import QueryPool


class QueryEnv(SessionEnv):
    r"""The paper's first formulation: the action is which query to ask (section 3.3).

    State: the belief. Action: the index of a candidate. Reward: what the answer adds to the
    objective; for the paper's it is the information gain in bits of the asked query,
    :math:`r = H(\omega \mid Q) - E_{q_i} H(\omega \mid q_i, Q)`. The episode ends after H answers.

    With ``batch`` above 1 an action is n candidates of each session (B n), and a step asks them
    all: whoever chooses knows none of the n answers. They are then let in one after the other, as
    n steps would; the belief after a batch is, bit for bit, that after the same questions one by
    one.

    Args:
        pool: the queries, normalised.
        human: who answers.
        belief: how answers become a belief.
        budget: H, queries in an episode, at least 1.
        candidates: C, how many queries of the pool are on the table, at most N. Fewer than N makes
            a fresh random subset for each session, so that a policy learns to choose and not to
            remember. None puts the whole pool on the table, in order.
        repeats: whether a query may be asked again.
        objective: a name of ``objectives.OBJECTIVES``; the paper's is ``information_gain``.
        batch_size: (B,), sessions that run side by side.
        seed: seeds the environment's own generator; the global generators are never used. None: no
            two environments, in whatever process, face the same humans.
        device: where the tensors live.
        demonstrations: what each human shows before the first question; None is nothing.
        seen: (N K D), the options as the human sees them, where that is not as the belief does.
        batch: n, questions asked at once; the budget is a multiple of it.

    Raises:
        InputError: a number is below its minimum, the budget is no multiple of the batch, or
            without repeats the candidates are too few.
    """

    def __init__(
        self,
        pool: QueryPool,
        human: HumanBase,
        belief: BeliefBase,
        budget: int = 20,
        candidates: int | None = None,
        repeats: bool = True,
        objective: str = "alignment",
        batch_size: tuple[int, ...] = (64,),
        seed: int | None = None,
        device: torch.device | str = "cpu",
        demonstrations: Demonstrations | None = None,
        seen: Tensor | None = None,
        batch: int = 1,
    ) -> None:
        common = budget, objective, batch_size, seed, device, demonstrations, seen
        super().__init__(pool, human, belief, *common)
        self.batch = check_batch(batch, budget)
        self.n_candidates = len(pool)
        if candidates is not None:
            self.n_candidates = min(check_count("setup.candidates", candidates, 1), len(pool))
        if self.n_candidates < self.batch:
            raise InputError(
                f"setup.batch={self.batch} with {self.n_candidates} candidates: expected at least "
                "as many candidates as are asked at once; raise one or lower the other"
            )
        if not repeats and self.n_candidates < budget:
            raise InputError(
                f"{self.n_candidates} candidates and budget={budget} without repeats: expected at "
                "least as many candidates as asks; raise one, lower the other, or let them repeat"
            )
        self.repeats = check_flag("setup.repeats", repeats)
        self._table = Table(batch=self.batch)
        self._make_specs(self.n_candidates)

    def draw_questions(self, size: int) -> dict[str, Tensor]:
        """(B C), pool indices of the candidates of B sessions, where they are not all: hidden."""
        if self._shows_all:
            return {}
        shape = (size, len(self.features))
        keys = torch.rand(shape, generator=self.generator, device=self.device)
        return {"candidates": keys.topk(self.n_candidates, dim=-1).indices}

    def _choice_of(self, n_actions: int) -> Composite:
        inner = super()._choice_of(n_actions)
        if self.repeats:
            return inner
        spec = AllowedActions(action=inner["action"], shape=self.batch_size, device=self.device)
        spec.table = self._table
        return spec

    def _put_on_table(self, shown: dict[str, Tensor], begun: Tensor | None) -> None:
        if not self.repeats:
            self._table.show(shown["action_mask"], begun)

    @property
    def _shows_all(self) -> bool:
        """Whether the whole pool is on the table, in order; an action is then its index."""
        return self.n_candidates == len(self.features)

    def shown(self, session: SessionState, hidden: Tree) -> dict[str, Tensor]:
        """See :meth:`SessionEnv.shown`."""
        shown, size = super().shown(session, hidden), len(session["n_asked"])
        if self._shows_all:
            # A view: the whole pool is the same for every session. Torch lets nobody write into
            # it, but where there is one session: that gets a copy.
            candidates = torch.arange(len(self.features), device=self.device).expand(size, -1)
            queries = self.features.expand(size, *self.features.shape)
            shown["queries"] = queries.clone() if size == 1 else queries
        else:
            candidates = hidden["candidates"]
            shown["queries"] = self.features[candidates]
        mask = torch.ones_like(candidates, dtype=torch.bool)
        if not self.repeats:
            asked = session["history"]["index"]
            mask = ~(candidates.unsqueeze(-1) == asked.unsqueeze(-2)).any(-1)
            # A finished session offers everything again, so that a policy still has a distribution.
            mask = mask | ~mask.any(-1, keepdim=True)
        shown["action_mask"] = mask
        return shown

    def advance(self, hidden: Tree, session: SessionState, action: Any) -> Outcome:
        """See :meth:`SessionEnv.advance`."""
        index = self._check_action(action, self.n_candidates, "the place of a candidate")
        index = index.reshape(-1, self.batch)
        if not self._shows_all:
            index = hidden["candidates"].gather(-1, index)
        if not self.repeats:
            self._check_new(session, index)
        human, going_on = hidden["human"], session["n_asked"].squeeze(-1) < self.budget
        after = session
        for query in index.unbind(-1):
            after = self._ask(after, human, query, going_on)
        reward = self._objective.gained(session, after, human)
        terminated = after["n_asked"] >= self.budget
        return Outcome(after, reward, terminated, torch.zeros_like(terminated))

    def _check_new(self, session: SessionState, index: Tensor) -> None:
        """Refuse to ask pool queries ``index`` (B n) again in a session that goes on."""
        told = torch.cat([session["history"]["index"], index], -1)
        before = (told.unsqueeze(-2) == index.unsqueeze(-1)).sum(-1) > 1  # each is among them once
        again = before.any(-1, keepdim=True)
        if (again & (session["n_asked"] < self.budget)).any():
            raise InputError(
                "action: a query that was asked before, or twice in one action, where "
                "repeats=False; expected others, which action_mask allows; mask the policy, or "
                "make the environment with repeats=True"
            )
