"""Many strategies in one environment, with the same humans.

Shapes: B humans.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.evaluation.metrics import Exam
from torchrl_pref.evaluation.run import Evaluation, evaluate

MakeEnv = Callable[[int], QueryEnv | FeedEnv]
"""From a number of sessions to an environment for as many."""


class Entrant(NamedTuple):
    """A strategy to be run; a key that comes again is another run, or another training seed."""

    key: str
    strategy: TensorDictModuleBase
    sample: bool = False
    """Whether a stochastic policy draws its actions or takes the most likely one."""


class Chorus(TensorDictModuleBase):
    """Strategies side by side in one environment: each decides for its own share of the sessions.

    One large batch is much faster than a small one for each strategy.

    Attributes:
        seconds: spent by each strategy on its decisions.
    """

    in_keys: list[str] = []
    out_keys = ["action"]

    def __init__(self, entrants: Sequence[Entrant]) -> None:
        super().__init__()
        self.strategies = nn.ModuleList([entrant.strategy for entrant in entrants])
        self.modes = [
            ExplorationType.RANDOM if entrant.sample else ExplorationType.DETERMINISTIC
            for entrant in entrants
        ]
        self.seconds = [0.0] * len(entrants)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B)."""
        actions = []
        shares = tensordict.chunk(len(self.strategies))
        lineup = zip(self.strategies, self.modes, shares, strict=True)
        for number, (strategy, mode, share) in enumerate(lineup):
            start = time.perf_counter()
            with set_exploration_type(mode):
                actions.append(strategy(share)["action"])
            self.seconds[number] += time.perf_counter() - start
        return tensordict.set("action", torch.cat(actions))


def run_side_by_side(
    make_env: MakeEnv,
    humans: TensorDictBase,
    entrants: Sequence[Entrant],
    exam: Exam | None = None,
) -> dict[str, list[Evaluation]]:
    """Every strategy with the same humans (B), in one batch; a list holds the runs of a key.

    ``seconds_per_query`` is the time to choose alone: the belief is updated for all together.
    """
    count, chorus = len(humans), Chorus(entrants)
    env = make_env(count * len(entrants))
    whole = evaluate(env, chorus, torch.cat([humans] * len(entrants)), exam=exam)
    results: dict[str, list[Evaluation]] = {}
    for number, entrant in enumerate(entrants):
        rows = slice(number * count, (number + 1) * count)
        own: dict[str, Any] = {
            key: value[rows] for key, value in vars(whole).items() if isinstance(value, Tensor)
        }
        examined = {name: values[rows] for name, values in whole.examined.items()}
        seconds = chorus.seconds[number] / max(1, int(own["asked"].sum()))
        result = replace(whole, **own, examined=examined, seconds_per_query=seconds)
        results.setdefault(entrant.key, []).append(result)
    return results
