"""The paper's second question as an environment: queries stream by, ask or skip.

Shapes: as in ``envs.session``.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchrl_pref.beliefs.base import BeliefBase
from torchrl_pref.envs.session import SessionEnv
from torchrl_pref.envs.transition import Outcome, SessionState, Tree
from torchrl_pref.errors import check_choice, check_count
from torchrl_pref.humans.base import HumanBase
from torchrl_pref.humans.demonstrations import Demonstrations
from torchrl_pref.pool import QueryPool


class FeedEnv(SessionEnv):
    r"""The paper's second formulation: queries stream by, ask or skip (section 3.4).

    State: the belief and the offered query. Action: 1 asks, 0 skips. The episode ends at H asked
    queries or O offered ones. Reward, by ``skip``: with ``regret``, the paper's, asking is worth
    what the offer is expected to add to the objective, r, and skipping costs it: -r; running out of
    offers truncates. With ``free``, asking is worth what the answer does add and skipping is worth
    nothing: what is scarce is the H asks, and running out of offers is an end as any other.

    Args:
        pool: the queries, normalised. Offers are drawn from it independently and uniformly.
        human: who answers.
        belief: how answers become a belief.
        budget: H, queries asked in an episode, at least 1.
        offers: O, at least H. None is the paper's 2H with ``regret`` and 5H with ``free``.
        on_skip: ``new`` offers another query after a skip; ``repeat`` is the paper's literal
            s' = s and offers the same one again.
        skip: ``free``, or ``regret`` as in the paper.
        objective: a name of ``objectives.OBJECTIVES``; the paper's is ``information_gain``.
        batch_size: (B,), sessions that run side by side.
        seed: seeds the environment's own generator; the global generators are never used. None: no
            two environments, in whatever process, face the same humans.
        device: where the tensors live.
        demonstrations: what each human shows before the first question; None is nothing.
        seen: (N K D), the options as the human sees them, where that is not as the belief does.

    Raises:
        InputError: a number is below its minimum, or ``on_skip`` or ``skip`` is another word.
    """

    def __init__(
        self,
        pool: QueryPool,
        human: HumanBase,
        belief: BeliefBase,
        budget: int = 20,
        offers: int | None = None,
        on_skip: str = "new",
        skip: str = "free",
        objective: str = "alignment",
        batch_size: tuple[int, ...] = (64,),
        seed: int | None = None,
        device: torch.device | str = "cpu",
        demonstrations: Demonstrations | None = None,
        seen: Tensor | None = None,
    ) -> None:
        common = budget, objective, batch_size, seed, device, demonstrations, seen
        super().__init__(pool, human, belief, *common)
        self.skip = check_choice("skip", skip, ("regret", "free"))
        self.n_offers = (2 if skip == "regret" else 5) * budget
        if offers is not None:
            self.n_offers = check_count("setup.offers", offers, budget)
        self.on_skip = check_choice("setup.on_skip", on_skip, ("new", "repeat"))
        self._make_specs(2)

    @property
    def max_steps(self) -> int:
        """O: a session that asks less sees every offer."""
        return self.n_offers

    def draw_questions(self, size: int) -> dict[str, Tensor]:
        """(B O), pool indices of what streams by in B sessions: hidden."""
        n_queries, shape = len(self.features), (size, self.n_offers)
        offers = torch.randint(n_queries, shape, generator=self.generator, device=self.device)
        return {"offers": offers}

    def _counted(self, session: SessionState, number: Tensor) -> SessionState:
        n_offered = torch.zeros_like(session["n_asked"])
        return {**super()._counted(session, number), "n_offered": n_offered}

    def offered(self, session: SessionState, hidden: Tree) -> Tensor:
        """(B), pool index of the query on offer; after the last offer, the last one."""
        place = session["n_offered" if self.on_skip == "new" else "n_asked"]
        return hidden["offers"].gather(-1, place.clamp(max=self.n_offers - 1)).squeeze(-1)

    def shown(self, session: SessionState, hidden: Tree) -> dict[str, Tensor]:
        """See :meth:`SessionEnv.shown`."""
        shown, n_offered = super().shown(session, hidden), session["n_offered"]
        offers_left = 1 - n_offered / self.n_offers
        shown["remaining"] = torch.cat([shown["remaining"], offers_left], -1)
        shown["n_offered"] = n_offered.clone()
        shown["offer"] = self.features[self.offered(session, hidden)]
        return shown

    def advance(self, hidden: Tree, session: SessionState, action: Any) -> Outcome:
        """See :meth:`SessionEnv.advance`."""
        action = self._check_action(action, 2, "1 to ask and 0 to skip")
        human, index = hidden["human"], self.offered(session, hidden)
        n_offered = session["n_offered"]
        going_on = (session["n_asked"] < self.budget) & (n_offered < self.n_offers)
        asks = (action == 1).unsqueeze(-1)
        after = self._ask(session, human, index, (asks & going_on).squeeze(-1))
        after["n_offered"] = n_offered = n_offered + going_on
        if self.skip == "free":
            reward = self._objective.gained(session, after, human)
        else:
            query, model = self.features[index].unsqueeze(1), self.belief.response_model
            worth = self._objective.forecast(session, human, query, model) * going_on
            reward = torch.where(asks, worth, -worth)
        out_of_offers = n_offered >= self.n_offers
        terminated = after["n_asked"] >= self.budget
        if self.skip == "free":
            # Scarce offers are part of the task, and nothing is to come after the last.
            terminated = terminated | out_of_offers
        return Outcome(after, reward, terminated, out_of_offers & ~terminated)
