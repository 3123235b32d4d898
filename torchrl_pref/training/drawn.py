"""Training over many problems: each update asks about another one, drawn at random.

A policy that is trained so has seen neither one task nor one kind of human, and is meant for all.
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext
from typing import Any, cast

import torch
from tensordict import TensorDict
from torch import Generator

from torchrl_pref.build import (
    USUAL_HUMAN,
    make_policy,
    make_pools,
    make_task,
    make_training_env,
)
from torchrl_pref.config.sections import Settings
from torchrl_pref.policies.base import Policy
from torchrl_pref.training.sessions import Sessions

DIMENSIONS = 2, 16
SKEWS = 1.0, 1000.0
"""The largest variance of the features over the smallest; the Gridworld's is about 50."""

TAUS = 0.2, 20.0
"""With features in units of their spread: from one answer in twenty above chance to hardly any
error."""

BUDGETS = 5, 60
OFFERS = 1.5, 10.0
"""In units of the budget."""

SIZES = 50, 20_000
NEVER_ERR, UNKNOWN = 0.1, 0.2
"""Share of the problems whose humans never err, and of those whose tau the belief has to infer."""

SPREAD = 3.0
"""Where tau is not known, each human's own is within this factor of what is believed."""

QUESTIONS = {"choice": (2, 5), "weak": (2, 2), "ranking": (3, 3)}
"""What is asked, and of how few and how many options."""

LARGEST_SEED = 2**29


class DrawnSessions:
    """Sessions of another problem in each batch, from the first question to the last.

    The policy's networks are the same in all; what it sees of a problem is made anew with it. A
    batch holds about as many steps whatever the budget: sessions are fewer where they are longer.

    Args:
        settings: of the run: ``setup`` and ``training`` say which sessions, and how many at the
            largest common budget of 20; the task, the human and the belief are drawn.
        policy: who asks.
        seed: fixes the problems and all luck in them.

    Attributes:
        env: the present problem's; at first that of the run's own settings.
        frames: about how many steps a batch holds.
        generator: draws the problems.
    """

    def __init__(self, settings: Settings, policy: Policy, env: Any, seed: int) -> None:
        self.settings, self.policy, self.env = settings, policy, env
        self.frames = settings["training"]["sessions"] * env.max_steps
        self.generator = Generator().manual_seed(seed)

    def apart(self) -> AbstractContextManager[None]:
        """Nothing: all sessions are asked here."""
        return nullcontext()

    def state_dict(self) -> dict[str, Any]:
        """Nothing: no session outlives its batch."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing, see :meth:`state_dict`."""

    def collect(self, before: int = 0) -> TensorDict:
        """All steps of the sessions of another problem, however many batches came ``before``: see
        :meth:`Sessions.collect`."""
        settings = draw_problem(self.settings, self.generator)
        task = make_task(*make_pools(settings), settings["tau"], settings)
        setup = settings["setup"]
        steps = setup.get("offers") or setup["budget"]
        count = max(2, round(self.frames / steps))
        seed = _whole(self.generator, 0, LARGEST_SEED)
        self.env = make_training_env(settings, task, task.train, count, seed)
        here = make_policy(settings, self.env)
        policy = Policy(here.observe, self.policy.actor, self.policy.critic)
        return Sessions(self.env, policy, steps).collect()


def draw_problem(settings: Settings, luck: Generator) -> Settings:
    """The settings of a run with task, pool, question, human, belief and budget drawn."""
    names = list(QUESTIONS)
    question = names[_whole(luck, 0, len(names) - 1)]
    options = _whole(luck, *QUESTIONS[question])
    tau = _log_uniform(luck, *TAUS)
    kind = _share(luck)
    task = {
        "name": "gaussian",
        "dimension": round(_log_uniform(luck, *DIMENSIONS)),
        "skew": _log_uniform(luck, *SKEWS),
        "axes": _whole(luck, 0, LARGEST_SEED),
    }
    size = round(_log_uniform(luck, *SIZES))
    budget = round(_log_uniform(luck, *BUDGETS))
    setup: dict[str, Any] = {**settings["setup"], "budget": budget}
    if setup["name"] == "feed":
        setup["offers"] = round(budget * _log_uniform(luck, *OFFERS))
    else:
        setup["candidates"] = min(setup["candidates"] or size, size)
    samples = settings["belief"]["samples"]
    known = {"name": "sampled", "samples": samples, "moves": None, "lapse": 0.0}
    unsure = kind >= 1 - UNKNOWN
    drawn = {
        "task": task,
        "question": {"name": question, **({"threshold": 1.0} if question == "weak" else {})},
        # To somebody who never errs nothing is about equal.
        "tau": "optimal" if kind < NEVER_ERR and question != "weak" else tau,
        "pool": {
            **settings["pool"],
            "size": size,
            "options": options,
            "seed": _whole(luck, 0, LARGEST_SEED - 1),
        },
        "human": {**USUAL_HUMAN, "spread": SPREAD if unsure else 1},
        "belief": {**known, "name": "rationality", "spread": SPREAD} if unsure else known,
        "setup": setup,
    }
    return cast(Settings, {**settings, **drawn})


def _share(luck: Generator) -> float:
    return torch.rand((), generator=luck).item()


def _whole(luck: Generator, low: int, high: int) -> int:
    return int(torch.randint(low, high + 1, (), generator=luck))


def _log_uniform(luck: Generator, low: float, high: float) -> float:
    return low * math.exp(_share(luck) * math.log(high / low))
