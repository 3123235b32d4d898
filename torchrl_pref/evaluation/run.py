"""Strategies compared on the same humans: curves, paired differences and intervals.

Shapes: B humans, H query budget. Curves are (B H+1): column j is the state after j answers.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from torchrl_pref.envs.objectives import alignment, alignment_of_mean

CURVES = ("alignment", "alignment_of_mean", "information", "ess")

COUNTS = ("n_asked", "n_offered")


@dataclass(frozen=True)
class Evaluation:
    """What one strategy did with B humans.

    Attributes:
        alignment: (B H+1), the paper's: mean over samples of the cosine with the human's ω.
        alignment_of_mean: (B H+1), the cosine of the mean of the samples with the human's ω.
        information: (B H+1), sum of the information gains of the asked queries, bits.
        ess: (B H+1), effective sample size of the belief.
        asked: (B), queries asked.
        offered: (B), queries offered; equal to ``asked`` where the strategy chooses.
        repeated: (B), asked queries that had been asked before.
        seconds_per_query: wall time of the whole session (choice, answer, belief) over the queries
            asked of all B humans.

    Where a session ended before j answers, column j holds its last value.
    """

    alignment: Tensor
    alignment_of_mean: Tensor
    information: Tensor
    ess: Tensor
    asked: Tensor
    offered: Tensor
    repeated: Tensor
    seconds_per_query: float


def draw_humans(env: EnvBase) -> TensorDict:
    """Humans, their luck, what they showed, the belief before the first question and a feed's
    offers, for every strategy to start from."""
    kept = ("session", "samples"), ("session", "ess"), ("session", "given")
    return env.reset().select("human", *kept, "offers", strict=False)


def evaluate(
    env: EnvBase,
    strategy: TensorDictModuleBase,
    humans: TensorDictBase,
    sample: bool = False,
) -> Evaluation:
    """Run one session with each human.

    Args:
        env: its batch size is B. Seed it alike for every strategy that is to be compared.
        strategy: writes ``action``.
        humans: as drawn by :func:`draw_humans`.
        sample: whether a stochastic policy draws its actions or takes the most likely one.
    """
    mode = ExplorationType.RANDOM if sample else ExplorationType.DETERMINISTIC
    session = env.reset(humans.clone(), set_state=True)
    omega = session["human", "omega"]
    before = _measured(session, omega).cpu()
    start = time.perf_counter()
    steps: list[TensorDictBase] = []
    with torch.no_grad(), set_exploration_type(mode):
        # Not a rollout: that would keep what is on the table, a copy of the pool for each session.
        while len(steps) < env.max_steps and not session["done"].all():
            session = step_mdp(env.step(strategy(session)))
            steps.append(_measured(session, omega))
    steps_taken = TensorDict.stack(steps, 1).to("cpu")
    seconds = time.perf_counter() - start
    n_asked = steps_taken["n_asked"].squeeze(-1)
    curves = {
        name: _by_answers(before[name], steps_taken[name].squeeze(-1), n_asked, env.budget)
        for name in CURVES
    }
    asked = n_asked[:, -1]
    offered = steps_taken.get("n_offered", steps_taken["n_asked"])[:, -1, 0]
    history = session["session", "history", "index"].cpu()
    return Evaluation(
        **curves,
        asked=asked,
        offered=offered,
        repeated=_count_repeats(history),
        seconds_per_query=seconds / max(1, int(asked.sum())),
    )


def _measured(session: TensorDictBase, omega: Tensor) -> TensorDict:
    """What an evaluation reads of sessions as they stand, with humans of weights ω (B D)."""
    kept = session["session"]
    measured = {
        "alignment": alignment(kept["samples"], omega),
        "alignment_of_mean": alignment_of_mean(kept["samples"], omega),
        **{key: kept[key] for key in ("information", "ess", *COUNTS) if key in kept},
    }
    return TensorDict(measured, session.batch_size, device=session.device)


def _by_answers(before: Tensor, values: Tensor, n_asked: Tensor, budget: int) -> Tensor:
    """Curve (B H+1) by number of answers, from values (B T) by step and their start (B 1)."""
    curve = before.repeat(1, budget + 1)
    columns = torch.arange(budget + 1)
    for value, count in zip(values.unbind(1), n_asked.unbind(1), strict=True):
        # A skip changes nothing, so later steps with the same count write the same value again.
        curve = torch.where(columns >= count.unsqueeze(1), value.unsqueeze(1), curve)
    return curve


def _count_repeats(history: Tensor) -> Tensor:
    """(B), how many of the asked queries (B H), -1 where none, had been asked before."""
    same = history.unsqueeze(-1) == history.unsqueeze(-2)
    earlier = same.tril(-1).any(-1) & (history >= 0)
    return earlier.sum(-1)
