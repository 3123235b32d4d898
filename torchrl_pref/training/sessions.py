"""Sessions that a policy asks while it learns, and what its update needs of them.

Shapes: B sessions side by side, T steps of each in a batch.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_pref.checkpoints.restore import restore_sessions
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.objectives import alignment
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.policies.base import Policy


class Sessions:
    """B sessions that go on from one batch to the next; one that ends makes room for another.

    A batch holds what the networks read and the logits that the actor gave, and not the samples or
    the pool: it is a hundredth of what the steps themselves are.

    Args:
        env: its batch size is B.
        policy: who asks.
        steps: T.
        stages: how many, T steps apart, the sessions are to be at in each batch but the first few,
            so that a batch of less than whole sessions is not about their beginning alone, or
            their end.

    Attributes:
        now: the sessions as they stand, with the reward (``episode_reward``) and the number of
            steps (``step_count``) that each has had.
    """

    def __init__(
        self, env: QueryEnv | FeedEnv, policy: Policy, steps: int, stages: int = 1
    ) -> None:
        self.env, self.policy, self.steps, self.stages = env, policy, steps, stages
        self.strategy = policy.strategy
        self.kept = {*policy.actor.in_keys, *policy.value.in_keys, "logits", "action", "n_asked"}
        self.now: TensorDictBase = env.reset()
        self.now["episode_reward"] = torch.zeros_like(self.now["remaining"][..., :1])
        self.now["step_count"] = torch.zeros_like(self.now["n_asked"])
        self._state_keys = tuple(self.now.keys())

    @property
    def frames(self) -> int:
        """B · T, steps in a batch."""
        return self.now.numel() * self.steps

    @property
    def generator(self) -> torch.Generator:
        """Of all luck but that of the actions."""
        return self.env.generator

    def apart(self) -> AbstractContextManager[None]:
        """Nothing: all sessions are asked here, see :mod:`torchrl_pref.training.parts`."""
        return nullcontext()

    def state_dict(self) -> dict[str, Any]:
        """The sessions as they stand, without what the policy wrote beside them."""
        return self.now.select(*self._state_keys).to_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where :meth:`state_dict` was taken.

        Raises:
            InputError: the state was taken of other sessions.
        """
        self.now = self.now.select(*self._state_keys)
        session = self.now.select(*self.env.state_spec.keys())
        sizes = len(self.env.features), self.env.n_answers
        restore_sessions(self.now, state, session, *sizes)

    @torch.no_grad()
    def collect(self, before: int = 0) -> TensorDict:
        """The next T steps (B T), with the values that the critic gives to each state and the next.

        Args:
            before: how many batches came before. At the start of each of the first but the very
                first, until there are as many stages, one in ``stages`` of the sessions begins
                again.

        A batch holds under ``next``: reward and done flags, ``n_asked``, the alignment where a
        session ended (else NaN), and the ``episode_reward`` and ``step_count`` with the step.
        """
        if 0 < before < self.stages:
            self._begin_again(torch.arange(self.now.numel()) % self.stages == before)
        records, cut_off = [], []
        with set_exploration_type(ExplorationType.RANDOM):
            for t in range(self.steps):
                record, after = self._step()
                records.append(record)
                cut = after["truncated"].squeeze(-1)
                if cut.any():
                    cut_off.append((cut, t, self._value(after[cut])))
        batch = TensorDict.stack(records, 1)
        self.policy.value(batch)
        values = torch.cat([batch["state_value"], self._value(self.now).unsqueeze(1)], 1)
        # The state after a step is the one before the next, but where a session was cut off.
        later = values[:, 1:].clone()
        for cut, t, value in cut_off:
            later[cut, t] = value
        batch["next", "state_value"] = later
        return batch

    def _begin_again(self, chosen: Tensor) -> None:
        """Put those of the sessions (B) that are chosen at their start."""
        chosen = chosen.unsqueeze(-1).to(self.now.device)
        for flag in ("done", "terminated"):
            self.now[flag] = self.now[flag] | chosen
        counts = {key: self.now[key] * ~chosen for key in ("episode_reward", "step_count")}
        self.now = self.env.maybe_reset(self.now).update(counts)

    def _step(self) -> tuple[TensorDict, TensorDictBase]:
        """One step of all sessions: what is kept of it, and the state after it."""
        session, following = self.env.step_and_maybe_reset(self.strategy(self.now))
        after, record = session["next"], session.select(*self.kept)
        total = session["episode_reward"] + after["reward"]
        count = session["step_count"] + 1
        kept = {key: after[key] for key in ("reward", "done", "terminated", "n_asked")}
        kept["alignment"] = torch.full_like(after["reward"], torch.nan)
        ended = after["done"].squeeze(-1).nonzero().squeeze(-1)
        if len(ended):  # of the others nobody asks, and a step would be a tenth slower
            samples, omega = after["session", "samples"], session["human", "omega"]
            kept["alignment"][ended] = alignment(samples[ended], omega[ended])
        record["next"] = TensorDict(
            {**kept, "episode_reward": total, "step_count": count}, self.env.batch_size
        )
        going_on = ~after["done"]
        following["episode_reward"], following["step_count"] = total * going_on, count * going_on
        self.now = following
        return record, after

    def _value(self, session: TensorDictBase) -> Tensor:
        """What the critic gives to sessions (B), (B 1)."""
        seen = session.copy()
        if self.policy.observe is not None:
            seen = self.policy.observe(seen)
        return self.policy.value(seen)["state_value"]
