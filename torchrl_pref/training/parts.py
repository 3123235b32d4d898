"""Sessions in equal parts, each asked in a process of its own where there are cores for it.

Nearly all the time of a training goes into asking, and nearly all of that is many small steps that
threads of one process cannot share. So the first part is asked by the process that learns, and each
other by one that it starts, which gets the weights before every batch and gives its part of the
batch back. A part has its own humans and its own luck: the numbers are the same where there are no
cores for it, and all parts are asked in turn.

Shapes: B sessions side by side, T steps of each in a batch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_pref.build import make_policy, make_training_env
from torchrl_pref.checkpoints.restore import restore_generator
from torchrl_pref.compiled import n_threads, share_out
from torchrl_pref.config.sections import Settings
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.errors import InputError
from torchrl_pref.policies.base import Policy
from torchrl_pref.problem import Problem
from torchrl_pref.training.sessions import Sessions
from torchrl_pref.training.worker import Message, Worker


def seeds_of_part(seed: int, part: int) -> tuple[int, int]:
    """Of the humans of a part and of the actions there; the first part has the run's own.

    A generator of torch on the CPU knows 32 bits of its seed, so the parts' are mixed and not
    added. The upper half of them is for evaluations during a training.
    """
    if part == 0:
        return seed, seed
    env, actions = np.random.SeedSequence((seed, part)).generate_state(2) >> 1
    return int(env), int(actions)


class Part:
    """The sessions of one part, but the first, with their own luck.

    Args:
        sessions: of this part.
        seed: of the actions.
    """

    def __init__(self, sessions: Sessions, seed: int) -> None:
        self.sessions = sessions
        self.luck: Tensor = Generator().manual_seed(seed).get_state()

    def collect(self, before: int) -> TensorDict:
        """As :meth:`Sessions.collect`; the global generator is left as it was."""
        with torch.random.fork_rng(devices=[]):
            torch.set_rng_state(self.luck)
            batch = self.sessions.collect(before)
            self.luck = torch.get_rng_state()
        return batch

    def state_dict(self) -> Message:
        """The sessions as they stand, and all luck to come."""
        generators = {"env_generator": self.sessions.generator.get_state(), "actions": self.luck}
        return {"sessions": self.sessions.state_dict(), **generators}

    def load_state_dict(self, state: Any) -> None:
        """Go on where :meth:`state_dict` was taken.

        Raises:
            InputError: the state was taken of other sessions.
        """
        names = ("sessions", "env_generator", "actions")
        if not isinstance(state, dict) or not all(name in state for name in names):
            raise InputError("the checkpoint's training state (sessions) lacks one of its parts")
        self.sessions.load_state_dict(state["sessions"])
        restore_generator(self.sessions.generator, state["env_generator"])
        luck = Generator()
        restore_generator(luck, state["actions"])
        self.luck = luck.get_state()


class SessionParts:
    """B sessions in parts; to a trainer they are as :class:`Sessions` of one.

    Args:
        first: the sessions of the first part, and who asks in all of them.
        makes: for each other part, what makes it; it can be pickled, for another process.
    """

    def __init__(self, first: Sessions, makes: Sequence[Callable[..., Part]]) -> None:
        self.first, self.makes = first, makes
        self.others = [make(first.policy) for make in makes]
        self.workers: list[Worker] = []

    @property
    def env(self) -> QueryEnv | FeedEnv:
        """Of the first part."""
        return self.first.env

    @property
    def frames(self) -> int:
        """B · T, steps in a batch."""
        return self.first.frames + sum(part.sessions.frames for part in self.others)

    @property
    def generator(self) -> Generator:
        """Of all luck in the first part but that of the actions."""
        return self.first.generator

    @contextmanager
    def apart(self) -> Iterator[None]:
        """Until the end of the block each part has its own process, if there are cores for all.

        They are spawned, so a script that comes here needs ``if __name__ == "__main__":``. Where
        the block ends in an error, the parts here are as they were before it.
        """
        threads, parts = n_threads(), 1 + len(self.others)
        if threads < parts:
            yield
            return
        each = threads // parts
        with ExitStack() as stack:
            stack.callback(share_out, threads)
            share_out(each)
            stack.callback(self.workers.clear)
            for make, part in zip(self.makes, self.others, strict=True):
                worker = Worker(make, each, part.state_dict())
                stack.callback(worker.close)
                self.workers.append(worker)
            yield
            for state, part in zip(self._states(), self.others, strict=True):
                part.load_state_dict(state)

    def collect(self, before: int = 0) -> TensorDict:
        """As :meth:`Sessions.collect`, of all parts (B T)."""
        for worker in self.workers:
            worker.tell({"before": before, "weights": self.first.policy.weights.state_dict()})
        batches = [self.first.collect(before)]
        if self.workers:
            answers = [worker.answer()["batch"] for worker in self.workers]
            batches += [TensorDict(one, one["action"].shape[:2]) for one in answers]
        else:
            batches += [part.collect(before) for part in self.others]
        return torch.cat(batches)

    def state_dict(self) -> Message:
        """The first part's sessions as they stand, and under ``others`` all about the others."""
        return {**self.first.state_dict(), "others": dict(enumerate(self._states()))}

    def load_state_dict(self, state: Message) -> None:
        """Go on where :meth:`state_dict` was taken.

        Raises:
            InputError: the state was taken of other sessions.
        """
        self.first.load_state_dict(state)
        others = state.get("others")
        for number, part in enumerate(self.others):
            part.load_state_dict(others.get(number) if isinstance(others, dict) else None)

    def _states(self) -> list[Message]:
        """Of all parts but the first."""
        for worker in self.workers:
            worker.tell({})
        if self.workers:
            return [worker.answer()["state"] for worker in self.workers]
        return [part.state_dict() for part in self.others]


def make_part(
    settings: Settings,
    task: Problem,
    steps: int,
    stages: int,
    size: int,
    seeds: tuple[int, int],
    policy: Policy | None = None,
) -> Part:
    """A part's sessions at their start; without a policy they get one whose weights are to come."""
    env = make_training_env(settings, task, task.train, size, seeds[0])
    asks = make_policy(settings, env) if policy is None else policy
    return Part(Sessions(env, asks, steps, stages), seeds[1])
