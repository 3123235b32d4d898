"""Sessions as TorchRL environments: what is shown, what is kept, and what a policy never sees.

Shapes: B sessions, M belief samples, N queries in the pool, C candidates of a session, K options
per query, D features, H query budget, O offers.

A session is one human, from the prior to H answers. An environment is the transition of
``envs.transition`` plus where the questions come from and what is rewarded; a step on a finished
session changes nothing and is worth nothing. All of a session's state is in the tensordict, so
partial resets, collectors and replay work:

====================================  ===========================================================
*shown*: observations, for a policy
``samples`` (B M D)                   belief samples of ω
``mean`` (B D)                        their mean, the paper's state
``remaining`` (B 1) or (B 2)          share of the asks (and of the offers) that is left
``queries`` (B C K D)                 ``QueryEnv``: features of the candidates
``action_mask`` (B C)                 ``QueryEnv``: candidates that may be asked
``offer`` (B K D)                     ``FeedEnv``: features of the offered query
``n_asked``, ``n_offered`` (B 1)      counts so far (``n_offered`` only in ``FeedEnv``)
*kept*: ``session``, an observation
``samples``, ``mean``, ``n_asked`` …  the same again: transforms rewrite what is shown, not these
``ess``, ``information`` (B 1)        effective sample size; bits gained by the answered queries
``history``                           options (B H K D), answers and index (B H): ``History``
``given``                             where humans show something first: ``Given``
``number`` (B 1)                      tells one session from another
*hidden*: state, and no observation
``human``                             omega, noise, care and the number of their session
``offers`` (B O), ``candidates`` …    pool indices of the stream, or of the candidates if not all
====================================  ===========================================================

What is hidden stays the same through a session. ``reset`` returns it, and it stands at the root of
each step's data and not under ``next``. Of what a reset returns, ``SerialEnv`` and ``ParallelEnv``
hand on the observations alone; there the environment remembers whom it drew, by ``number``.
"""

from __future__ import annotations

import os
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_pref.beliefs.base import BeliefBase
from torchrl_pref.envs.objectives import make_objective
from torchrl_pref.envs.state import check_state, overwrite, spec_of
from torchrl_pref.envs.transition import (
    Outcome,
    SessionState,
    Tree,
    begin,
    hear,
    put,
    rows,
    tell,
)
from torchrl_pref.errors import InputError, check_count, check_seed, check_type
from torchrl_pref.humans.base import HumanBase
from torchrl_pref.humans.demonstrations import Demonstrations
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions.base import check_same
from torchrl_pref.questions.prior_evidence import Given, ratio
from torchrl_pref.tensors import check_finite, check_range, check_shape, directions


def is_feed(env: EnvBase) -> bool:
    """Whether an environment, transformed or not, offers queries; if not, it shows candidates."""
    return "offer" in env.observation_spec.keys()  # noqa: SIM118, a spec is no dictionary


class SessionEnv(EnvBase):
    """What the environments share: a human, a belief, and what an answer does to it."""

    _supports_set_state = True

    batch = 1
    """n, questions that one action asks."""

    def __init__(
        self,
        pool: QueryPool,
        human: HumanBase,
        belief: BeliefBase,
        budget: int,
        objective: str,
        batch_size: tuple[int, ...],
        seed: int | None,
        device: torch.device | str,
        demonstrations: Demonstrations | None,
        seen: Tensor | None,
    ) -> None:
        if not isinstance(batch_size, Sequence) or len(batch_size) != 1:
            raise InputError(f"batch_size={batch_size}: expected one size, such as (64,)")
        check_count("batch_size", batch_size[0], 1)
        check_type("pool", pool, QueryPool, "QueryPool(features)")
        check_type("human", human, HumanBase, "SimulatedHuman(Boltzmann(2.0))")
        check_type("belief", belief, BeliefBase, "Belief(Boltzmann(2.0))")
        check_same(human.response_model.question, belief.response_model.question)
        super().__init__(device=device, batch_size=torch.Size(batch_size))
        self.register_buffer("features", pool.features.to(device))
        if seen is not None:
            check_shape("seen", seen, tuple(pool.features.shape), "of the features in the pool")
            check_finite("seen", seen)
            seen = seen.to(device)
        self.register_buffer("seen", seen)
        self.human = human
        self.n_answers = human.response_model.n_answers(pool.n_options)
        self.belief = belief
        self.objective = objective
        self._objective = make_objective(objective)
        self.demonstrations = demonstrations or Demonstrations()
        self.budget = check_count("setup.budget", budget, 1)
        self._set_seed(seed)

    def _make_specs(self, n_actions: int) -> None:
        """Read the specs off a state, so that no shape is written down twice."""
        rng_state = self._generator.get_state()
        hidden, session = self.fresh()
        self._generator.set_state(rng_state)
        batch, device = self.batch_size, self.device
        shown = self.shown(session, hidden)
        kept = {"session": session}
        self.state_spec = spec_of(TensorDict({**hidden, **kept}, batch, device=device))
        self.observation_spec = spec_of(TensorDict({**shown, **kept}, batch, device=device))
        self.action_spec = self._choice_of(n_actions)
        self.reward_spec = Unbounded(shape=(*batch, 1), device=device)
        flag = Binary(n=1, shape=(*batch, 1), dtype=torch.bool, device=device)
        self.done_spec = Composite(
            done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=batch
        )
        self._hidden_keys = tuple(hidden)
        self._remembered = hidden

    def _choice_of(self, n_actions: int) -> Composite:
        """The spec of an action."""
        device = self.device
        action = Categorical(n_actions, shape=self._action_shape, device=device)
        return Composite(action=action, shape=self.batch_size, device=device)

    @property
    def _action_shape(self) -> torch.Size:
        """(B), or (B n) where an action asks several questions."""
        return self.batch_size if self.batch == 1 else torch.Size((*self.batch_size, self.batch))

    def _set_seed(self, seed: int | None) -> None:
        """Without a seed humans are new ones each time, in whatever process."""
        if seed is None:
            chosen = int.from_bytes(os.urandom(6), "big")
        else:
            chosen = check_seed("seed", seed, bits=63)
        self._seed, self._home = seed, (os.getpid(), id(self))
        self._generator = Generator(self.device).manual_seed(chosen)

    @property
    def generator(self) -> Generator:
        """The environment's own source of randomness, on its device."""
        if self._seed is None and self._home != (os.getpid(), id(self)):
            self._set_seed(None)  # this is a copy, here or in a worker: other humans
        elif self._generator.device != self.device:
            self._generator = Generator(self.device).manual_seed(self._generator.initial_seed())
        return self._generator

    @property
    def max_steps(self) -> int:
        """Steps after which every session has ended."""
        return self.budget // self.batch

    def _reset(
        self, tensordict: TensorDictBase | None = None, set_state: bool = False, **kwargs: Any
    ) -> TensorDictBase:
        hidden, session = self.fresh()
        if set_state and tensordict is not None:
            state = TensorDict({**hidden, "session": session}, self.batch_size, device=self.device)
            given = check_state(tensordict, state, len(self.features), self.n_answers)
            given = given.clone().to_dict()
            overwrite(hidden, given)
            overwrite(cast(Tree, session), given.get("session", {}))
            session["mean"] = directions(session["samples"]).mean(1)
        mask = None if tensordict is None else tensordict.get("_reset", None)
        self._remember(hidden, mask)
        shown = self.shown(session, hidden)
        self._put_on_table(shown, mask)
        return TensorDict(
            {**hidden, "session": session, **shown}, self.batch_size, device=self.device
        )

    def fresh(self) -> tuple[Tree, SessionState]:
        """What is hidden and what is kept of B new sessions, in which nothing was asked yet."""
        size, (_, n_options, n_features) = self.batch_size.numel(), self.features.shape
        rng = self.generator  # the draws that strategies share come first
        human = self.human.draw(size, self.budget, self.n_answers, n_features, rng).to_dict()
        session = begin(self.belief.prior(size, n_features, rng), self.budget, n_options)
        # The bits of a number of the prior: another one for each session, and no draw more.
        human["number"] = number = session["samples"][:, 0, :1].clone().view(torch.int32)
        hidden: Tree = {"human": human, **self.draw_questions(size)}
        if self.demonstrations.count:
            session = hear(self.belief, session, self._given_by(human), rng)
        return hidden, self._counted(session, number)

    def _given_by(self, human: Tree) -> Given:
        """What humans show before the first question, of the trajectories in the pool."""
        seen = self.features if self.seen is None else self.seen
        model, rng = self.human.response_model, self.generator
        rows = self.demonstrations.draw(
            self.features.flatten(0, 1), seen.flatten(0, 1), human["omega"], model, rng
        )
        rows = ratio(self.demonstrations.tau, self.belief.response_model) * rows
        return {"rows": rows, "offsets": torch.zeros_like(rows[..., 0])}

    def draw_questions(self, size: int) -> dict[str, Tensor]:
        """What is drawn of the questions to come, for B sessions: hidden."""
        return {}

    def _counted(self, session: SessionState, number: Tensor) -> SessionState:
        """Sessions that begin, with their numbers. Subclasses may add what else is counted."""
        return {**session, "number": number}

    def shown(self, session: SessionState, hidden: Tree) -> dict[str, Tensor]:
        """What a policy sees: copies, which may be rewritten. Subclasses add what is asked."""
        n_asked = session["n_asked"]
        return {
            "samples": session["samples"].clone(),
            "mean": session["mean"].clone(),
            "n_asked": n_asked.clone(),
            "remaining": 1 - n_asked / self.budget,
        }

    def show(self, session: SessionState, hidden: Tree) -> TensorDict:
        """What a strategy sees of sessions that somebody else keeps, as a live person's.

        Args:
            session: what is known of them, of as many as there are.
            hidden: what :meth:`draw_questions` drew for them.
        """
        shown = {**self.shown(session, hidden), "session": session}
        return TensorDict(shown, session["n_asked"].shape[:1], device=self.device)

    def _put_on_table(self, shown: dict[str, Tensor], begun: Tensor | None) -> None:
        """Tell random actions what is shown now, in all sessions or where they began (B 1)."""

    def _session_of(self, tensordict: TensorDictBase) -> tuple[Tree, SessionState]:
        """What is hidden and what is kept of the sessions in a tensordict."""
        if "session" not in tensordict.keys():  # noqa: SIM118, a tensordict is no dictionary
            raise InputError(
                "a step without the key session, in which a session's own state is: expected it "
                "beside the action; let no transform exclude it, nor a SelectTransform leave it out"
            )
        session = {**tensordict["session"]}
        session["history"] = {**session["history"]}
        return self._hidden_of(tensordict), cast(SessionState, session)

    def _hidden_of(self, tensordict: TensorDictBase) -> Tree:
        """What is hidden of sessions: as they carry it, or else as this environment remembers it.

        Raises:
            InputError: neither knows of these sessions.
        """
        number, human = tensordict["session", "number"], tensordict.get("human", None)
        if human is not None and torch.equal(human["number"], number):
            return {key: tensordict[key] for key in self._hidden_keys}
        hidden = self._remembered
        if not torch.equal(hidden["human"]["number"].to(number.device), number):
            raise InputError(
                "sessions without their humans, which this environment does not remember: expected "
                "the root of a step's data, or of the sessions that it began last; hand them on by "
                "step_mdp, or begin others by reset"
            )
        if human is not None:  # a worker's buffer, in which no reset writes what is hidden
            tensordict.select(*self._hidden_keys).update_(hidden)
        return hidden

    def _remember(self, hidden: Tree, mask: Tensor | None) -> None:
        """Keep what is hidden of the sessions that begin, where ``mask`` (B 1), or of all."""
        if mask is None or mask.all():
            self._remembered = hidden
        else:
            who = mask.reshape(-1).nonzero().squeeze(-1)
            remembered = dict(self._remembered)
            put(remembered, rows(hidden, who), who)
            self._remembered = remembered

    def _check_action(self, action: Any, n_actions: int, meaning: str) -> Tensor:
        """The action of each session; refused unless it is from 0 to ``n_actions`` - 1."""
        action = check_range("action", action, 0, n_actions - 1, meaning)
        each = "one number" if self.batch == 1 else f"{self.batch} numbers"
        check_shape("action", action, self._action_shape, f"{each} for each session")
        return action

    def _ask(
        self, session: SessionState, human: Tree, index: Tensor, asked: Tensor
    ) -> SessionState:
        """The sessions after those marked in ``asked`` (B) asked pool query ``index`` (B).

        What stays the same is shared with the sessions before: a skip costs next to nothing.
        """
        who = asked.nonzero().squeeze(-1)
        if len(who) == len(asked):
            return self._answered(session, human, index)
        after: Tree = {**session}
        if len(who):
            part = cast(SessionState, rows(session, who))
            put(after, self._answered(part, rows(human, who), index[who]), who)
        return cast(SessionState, after)

    def _answered(self, session: SessionState, human: Tree, index: Tensor) -> SessionState:
        """Sessions (B) after their humans answered pool queries ``index`` (B)."""
        options = self.features[index]
        seen = options if self.seen is None else self.seen[index]
        answers = self.human.respond(seen, human, session["n_asked"].squeeze(-1))
        return tell(self.belief, session, options, answers, index, self.generator)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        hidden, session = self._session_of(tensordict)
        session, reward, terminated, truncated = self.advance(
            hidden, session, tensordict.get("action")
        )
        shown = self.shown(session, hidden)
        self._put_on_table(shown, None)
        flags = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        # What is hidden stays where it is.
        after = {"session": session, **shown, **flags, "reward": reward}
        return TensorDict(after, self.batch_size, device=self.device)

    @abstractmethod
    def advance(self, hidden: Tree, session: SessionState, action: Any) -> Outcome:
        """A step, without a tensordict: what is hidden stays, and what is known changes.

        Args:
            hidden: of the sessions, as :meth:`fresh` gives it.
            session: what is known of them.
            action: (B), or (B n) where an action asks several questions.

        Raises:
            InputError: an action is out of range, or asks again what may not be.
        """
