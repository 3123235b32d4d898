"""Sessions that a policy asks while it learns, and what its update needs of them.

Shapes: B sessions side by side, T steps of each in a batch.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_pref.checkpoints.restore import restore_sessions
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.objectives import alignment
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.envs.transition import SessionState, Tree, put, rows
from torchrl_pref.policies.base import Policy


class Sessions:
    """B sessions that go on from one batch to the next; one that ends makes room for another.

    They are advanced by the environment's own step without its tensordict, which would take longer
    than the step itself where there is one session. A batch holds what the networks read and the
    logits that the actor gave, and not the samples or the pool: it is a hundredth of what the steps
    themselves are.

    Args:
        env: its batch size is B.
        policy: who asks.
        steps: T.
        stages: how many, T steps apart, the sessions are to be at in each batch but the first few,
            so that a batch of less than whole sessions is not about their beginning alone, or
            their end.

    Attributes:
        hidden: what is hidden of the sessions as they stand.
        session: what is known of them.
        counts: the reward (``episode_reward``) and the number of steps (``step_count``) that each
            has had, (B 1).
    """

    def __init__(
        self, env: QueryEnv | FeedEnv, policy: Policy, steps: int, stages: int = 1
    ) -> None:
        self.env, self.policy, self.steps, self.stages = env, policy, steps, stages
        # A policy may read parts of what is kept, as ("session", "ess").
        keys = (*policy.strategy.in_keys, *policy.critic.in_keys, "n_asked")
        self.read = {key if isinstance(key, str) else key[0] for key in keys}
        self.kept = {*policy.actor.in_keys, *policy.value.in_keys, "logits", "action", "n_asked"}
        self.hidden, self.session = env.fresh()
        zero = torch.zeros_like(self.session["n_asked"])
        self.counts = {"episode_reward": zero.float(), "step_count": zero}
        self._now = self._seen(self.session, self.hidden)

    @property
    def frames(self) -> int:
        """B · T, steps in a batch."""
        return self.env.batch_size.numel() * self.steps

    @property
    def generator(self) -> torch.Generator:
        """Of all luck but that of the actions."""
        return self.env.generator

    def apart(self) -> AbstractContextManager[None]:
        """Nothing: all sessions are asked here, see :mod:`torchrl_pref.training.parts`."""
        return nullcontext()

    def state_dict(self) -> dict[str, Any]:
        """The sessions as they stand."""
        return {**self.hidden, "session": self.session, **self.counts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where :meth:`state_dict` was taken.

        Raises:
            InputError: the state was taken of other sessions.
        """
        now = TensorDict(self.state_dict(), self.env.batch_size, device=self.env.device)
        session = now.select(*self.env.state_spec.keys())
        restore_sessions(now, state, session, len(self.env.features), self.env.n_answers)
        saved = now.to_dict()
        self.hidden = {key: saved[key] for key in self.hidden}
        self.counts = {key: saved[key] for key in self.counts}
        self.session = cast(SessionState, saved["session"])
        self._now = self._seen(self.session, self.hidden)

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
            places = torch.arange(self.env.batch_size.numel(), device=self.env.device)
            self._begin_again((places % self.stages == before).nonzero().squeeze(-1))
            self._now = self._seen(self.session, self.hidden)
        records: list[Tree] = []
        cut_off: list[tuple[int, Tensor, Tensor]] = []
        with set_exploration_type(ExplorationType.RANDOM):
            for t in range(self.steps):
                record, cut = self._step()
                records.append(record)
                cut_off += [] if cut is None else [(t, *cut)]
        steps = {key: torch.stack([one[key] for one in records], 1) for key in records[0]}
        batch = TensorDict(steps, (self.env.batch_size.numel(), self.steps))
        self.policy.value(batch)
        values = torch.cat([batch["state_value"], self._value(self._now).unsqueeze(1)], 1)
        # The state after a step is the one before the next, but where a session was cut off.
        later = values[:, 1:].clone()
        for t, who, value in cut_off:
            later[who, t] = value
        batch["next", "state_value"] = later
        return batch

    def _begin_again(self, who: Tensor) -> None:
        """Put sessions ``who`` at their start."""
        if len(who):
            hidden, session = self.env.fresh()
            now = {**self.hidden, "session": self.session}
            put(now, rows({**hidden, "session": session}, who), who)
            self.session = now.pop("session")
            self.hidden = now
            self.counts = {key: count.index_fill(0, who, 0) for key, count in self.counts.items()}

    def _step(self) -> tuple[Tree, tuple[Tensor, Tensor] | None]:
        """One step of all sessions.

        Returns:
            What is kept of it; and where it cut sessions off, which they are and what the critic
            gives to the states that they ended in.
        """
        seen = self._acted(self._now)
        after = self.env.advance(self.hidden, self.session, seen["action"])
        self.session = after.session
        self.counts = {
            "episode_reward": self.counts["episode_reward"] + after.reward,
            "step_count": self.counts["step_count"] + 1,
        }
        done = after.terminated | after.truncated
        ahead = {
            "reward": after.reward,
            "done": done,
            "terminated": after.terminated,
            "n_asked": after.session["n_asked"],
            "alignment": torch.full_like(after.reward, torch.nan),
            **self.counts,
        }
        record = {**{key: seen[key] for key in self.kept}, **{("next", k): ahead[k] for k in ahead}}
        cut_off = None
        if done.any():
            ended, cut = (of.squeeze(-1).nonzero().squeeze(-1) for of in (done, after.truncated))
            # Of those that go on nobody asks it, and a step would be a tenth slower.
            samples, omega = after.session["samples"][ended], self.hidden["human"]["omega"][ended]
            ahead["alignment"][ended] = alignment(samples, omega)
            if len(cut):
                session = cast(SessionState, rows(after.session, cut))
                cut_off = cut, self._value(self._seen(session, rows(self.hidden, cut)))
            self._begin_again(ended)
        self._now = self._seen(self.session, self.hidden)
        return record, cut_off

    @torch.no_grad()
    def _seen(self, session: SessionState, hidden: Tree) -> TensorDictBase:
        """What the networks read of sessions."""
        state = {**self.env.shown(session, hidden), "session": session}
        read = {key: state[key] for key in self.read & state.keys()}
        seen = TensorDict(read, session["n_asked"].shape[:1], device=self.env.device)
        return seen if self.policy.observe is None else self.policy.observe(seen)

    def _acted(self, seen: TensorDictBase) -> TensorDictBase:
        """With an ``action`` drawn for each session, and what it was drawn by."""
        *networks, head = self.policy.actor.module
        for network in networks:
            seen = network(seen)
        return seen.set("action", head.get_dist(seen).sample())

    def _value(self, seen: TensorDictBase) -> Tensor:
        """What the critic gives to sessions, (B 1)."""
        value: Tensor = self.policy.value(seen)["state_value"]
        return value
