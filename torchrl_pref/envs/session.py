"""The two questions as TorchRL environments: which query to ask, and whether to ask this one.

Shapes: B sessions, M belief samples, N queries in the pool, C candidates of a session, K options
per query, D features, H query budget, O offers.

A session is one human, from the prior to H answers. A step on a finished session changes nothing
and is worth nothing, so that ``rollout(break_when_all_done=True)`` can wait for the others. All of
a session's state is in the tensordict, under these keys, so partial resets, collectors and replay
work and one environment serves any batch:

====================================  ===========================================================
``samples`` (B M D)                   belief samples of ω
``mean`` (B D)                        their mean, the paper's state
``remaining`` (B 1) or (B 2)          share of the asks (and of the offers) that is left
``queries`` (B C K D)                 ``QueryEnv``: features of the candidates
``action_mask`` (B C)                 ``QueryEnv``: candidates that may be asked
``offer`` (B K D)                     ``FeedEnv``: features of the offered query
``n_asked``, ``n_offered`` (B 1)      counts so far (``n_offered`` only in ``FeedEnv``)
``human`` (omega, noise, care)        hidden: a strategy must not read it
``history`` (queries, answers)        (B H) pool indices and chosen options, -1 where open
``offers`` (B O), ``candidates`` …    pool indices of the stream or of the candidates
``metrics``                           alignment, alignment_of_mean, information, ess (B 1)
====================================  ===========================================================

The seed of the constructor is the same for every copy: call ``set_seed`` on a ``ParallelEnv``,
which gives each worker its own seed, or the workers face the same humans.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, TypeAlias

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor
from torch.nn import functional as F
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_pref.acquisition.functions import information_gain
from torchrl_pref.acquisition.scoring import score_queries
from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.envs.objectives import make_objective
from torchrl_pref.envs.state import check_state
from torchrl_pref.errors import InputError, check_count, check_type
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions.base import check_same
from torchrl_pref.tensors import check_range, check_shape

State: TypeAlias = TensorDict | dict[str, Any]
"""A state: a dictionary while a step makes it, as writing to a tensordict takes time."""


NESTED = ("human", "history", "metrics")
"""What of a state holds several tensors."""


class SessionEnv(EnvBase):
    """What both environments share: a human, a belief, and what an answer does to it."""

    _supports_set_state = True
    _state_keys: tuple[str, ...]

    def __init__(
        self,
        pool: QueryPool,
        human: SimulatedHuman,
        belief: Belief,
        budget: int,
        objective: str,
        batch_size: tuple[int, ...],
        seed: int,
        device: torch.device | str,
    ) -> None:
        if not isinstance(batch_size, Sequence) or len(batch_size) != 1:
            raise InputError(f"batch_size={batch_size}: expected one size, such as (64,)")
        check_count("batch_size", batch_size[0], 1)
        check_type("pool", pool, QueryPool, "QueryPool(features)")
        check_type("human", human, SimulatedHuman, "SimulatedHuman(Boltzmann(2.0))")
        check_type("belief", belief, Belief, "Belief(Boltzmann(2.0))")
        check_same(human.response_model.question, belief.response_model.question)
        check_count("seed", seed, 0)
        super().__init__(device=device, batch_size=torch.Size(batch_size))
        self.register_buffer("features", pool.features.to(device))
        self.human = human
        self.belief = belief
        self.objective = objective
        self._objective = make_objective(objective)
        self.budget = check_count("setup.budget", budget, 1)
        self._set_seed(seed)

    def _make_specs(self, n_actions: int) -> None:
        """Read the specs off a state, so that no shape is written down twice."""
        rng_state = self._generator.get_state()
        state = self._start(self._fresh_state())
        self._generator.set_state(rng_state)
        self.observation_spec = _spec_of(state)
        self.state_spec = _spec_of(state.select(*self._state_keys))
        batch, device = self.batch_size, self.device
        self.action_spec = Categorical(n_actions, shape=batch, device=device)
        self.reward_spec = Unbounded(shape=(*batch, 1), device=device)
        flag = Binary(n=1, shape=(*batch, 1), dtype=torch.bool, device=device)
        self.done_spec = Composite(
            done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=batch
        )

    def _set_seed(self, seed: int | None) -> None:
        self._generator = Generator(self.device).manual_seed(0 if seed is None else seed)

    @property
    def generator(self) -> Generator:
        """The environment's own source of randomness, on its device."""
        if self._generator.device != self.device:
            self._set_seed(self._generator.initial_seed())
        return self._generator

    @property
    def max_steps(self) -> int:
        """Steps after which every session has ended."""
        return self.budget

    def _reset(
        self, tensordict: TensorDictBase | None = None, set_state: bool = False, **kwargs: Any
    ) -> TensorDictBase:
        state = self._fresh_state()
        if set_state and tensordict is not None:
            state.update(check_state(tensordict, state, len(self.features)).clone())
        return self._start(state)

    def _check_action(self, tensordict: TensorDictBase, n_actions: int, meaning: str) -> Tensor:
        """The action (B) of each session; refused unless it is from 0 to ``n_actions`` - 1."""
        action = check_range("action", tensordict.get("action"), 0, n_actions - 1, meaning)
        check_shape("action", action, self.batch_size, "one number for each session")
        return action

    def _fresh_state(self) -> TensorDict:
        """New humans who have answered nothing. The draws that strategies share come first."""
        size, n_features = self.batch_size.numel(), self.features.shape[-1]
        rng, device = self.generator, self.device
        n_answers = self.human.response_model.n_answers(self.features.shape[1])
        human = self.human.draw(size, self.budget, n_answers, n_features, rng)
        open_slots = torch.full((size, self.budget), -1, device=device)
        zero = torch.zeros((size, 1), device=device)
        return TensorDict(
            {
                "human": human,
                "samples": self.belief.prior(size, n_features, rng),
                "history": {"queries": open_slots, "answers": open_slots.clone()},
                "n_asked": zero.long(),
                "metrics": {"information": zero, "ess": zero + self.belief.n_samples},
            },
            self.batch_size,
            device=device,
        )

    def _start(self, state: TensorDict) -> TensorDict:
        """The observed first state, from what was drawn or given."""
        state["mean"], measured = _measure(state["samples"], state["human", "omega"])
        state["metrics"].update(measured)
        self._observe(state)
        return state

    def _observe(self, state: State) -> None:
        """Add to a state what follows from its counts. Subclasses add what is on the table."""
        state["remaining"] = 1 - state["n_asked"] / self.budget

    def _ask(self, before: TensorDictBase, index: Tensor, asked: Tensor) -> dict[str, Any]:
        """The state after the sessions marked in ``asked`` (B) asked pool query ``index`` (B).

        What stays the same is shared with the state before: a skip costs next to nothing.
        """
        state = {key: before[key] for key in self._state_keys}
        for key in NESTED:
            state[key] = dict(state[key])
        who = asked.nonzero().squeeze(-1)
        if len(who) == len(asked):
            _put(state, self._answer(state, index), None)
        elif len(who):
            _put(state, self._answer(_rows(state, who), index[who]), who)
        return state

    def _answer(self, session: dict[str, Any], index: Tensor) -> dict[str, Any]:
        """What changes in sessions (B) that ask pool queries ``index`` (B)."""
        human, history, metrics = (session[key] for key in NESTED)
        queries, model = self.features[index], self.belief.response_model
        turn, samples = session["n_asked"].squeeze(-1), session["samples"]
        answers = self.human.respond(queries, human, turn)
        # On the CPU only as many turns as were taken are worth the work; -1 slots come last.
        taken = int(turn.max())
        past, given = (history[key][:, :taken] for key in ("queries", "answers"))
        options = torch.cat([self.features[past], queries.unsqueeze(1)], 1)
        evidence = model.evidence(options, torch.cat([given, answers.unsqueeze(1)], 1))
        ess = metrics["ess"].squeeze(-1)
        update = self.belief.update(samples, ess, evidence, self.generator)
        mean, measured = _measure(update.samples, human["omega"])
        gain = score_queries(samples, queries.unsqueeze(1), model, information_gain)
        place = torch.arange(history["queries"].shape[1], device=turn.device) == turn.unsqueeze(-1)
        used = torch.where(update.used, answers, -1)
        return {
            "samples": update.samples,
            "mean": mean,
            "n_asked": session["n_asked"] + 1,
            "history": {
                "queries": torch.where(place, index.unsqueeze(-1), history["queries"]),
                "answers": torch.where(place, used.unsqueeze(-1), history["answers"]),
            },
            "metrics": {
                **measured,
                "information": metrics["information"] + gain,
                "ess": update.ess.unsqueeze(-1),
            },
        }

    def _finish(
        self, state: dict[str, Any], reward: Tensor, truncated: Tensor, terminated: Tensor
    ) -> TensorDict:
        """The observed next state with its reward and done flags."""
        state["reward"] = reward
        state["terminated"] = terminated
        state["truncated"] = truncated & ~terminated
        state["done"] = terminated | truncated
        for key in NESTED:
            state[key] = TensorDict(state[key], self.batch_size, device=self.device)
        return TensorDict(state, self.batch_size, device=self.device)

    @abstractmethod
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase: ...


def _rows(state: dict[str, Any], who: Tensor) -> dict[str, Any]:
    """The sessions ``who`` of a state."""
    return {
        key: _rows(value, who) if isinstance(value, dict) else value[who]
        for key, value in state.items()
    }


def _put(state: dict[str, Any], changed: dict[str, Any], who: Tensor | None) -> None:
    """Put what changed in sessions ``who``, or in all, into a state; no tensor is overwritten."""
    for key, new in changed.items():
        if isinstance(new, dict):
            _put(state[key], new, who)
        else:
            state[key] = new if who is None else state[key].index_copy(0, who, new)


def _measure(samples: Tensor, omega: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """The mean (B D) of the samples, and the metrics (B 1) that compare them with omega (B D)."""
    mean = samples.mean(1)
    cosines = F.cosine_similarity(samples, omega.unsqueeze(1), dim=-1)
    of_mean = F.cosine_similarity(mean, omega).unsqueeze(-1)
    return mean, {"alignment": cosines.mean(1, keepdim=True), "alignment_of_mean": of_mean}


def _spec_of(state: TensorDictBase) -> Composite:
    """Unbounded specs of the shapes and types in a state."""
    spec = Composite(shape=state.batch_size, device=state.device)
    for key, value in state.items(include_nested=True, leaves_only=True):
        if value.dtype == torch.bool:
            spec[key] = Binary(n=value.shape[-1], shape=value.shape, dtype=torch.bool)
        else:
            spec[key] = Unbounded(shape=value.shape, dtype=value.dtype)
    return spec.to(state.device)
