"""Strategies compared on the same humans: curves, paired differences and intervals.

Shapes: B humans, H query budget. Curves are (B H+1): column j is the state after j answers.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from torchrl_pref.envs.objectives import alignment, alignment_of_mean
from torchrl_pref.evaluation.metrics import Exam, Standing, calibration, measure

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
            asked of all B humans; measuring what was asked for beside alignment is not in it.
        examined: (B H+1 …), the metrics that were asked for, as they were measured.
        batch: how many queries were asked at once.

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
    examined: Mapping[str, Tensor] = field(default_factory=dict)
    batch: int = 1

    @property
    def metrics(self) -> dict[str, Tensor]:
        """The metrics that were asked for beside alignment, by name (B H+1); of what is told of all
        humans together (1 H+1)."""
        return {
            name: calibration(values)[None] if name == "calibration" else values.squeeze(-1)
            for name, values in self.examined.items()
        }


class Examiner:
    """Measures the beliefs of sessions, and again only those that an answer has changed.

    Args:
        exam: what by; None measures nothing.
        env: whose humans and beliefs they are.
        session: as it begins.
    """

    def __init__(self, exam: Exam | None, env: EnvBase, session: TensorDictBase) -> None:
        self.exam, self.seconds = exam, 0.0
        self.n_asked = torch.full_like(session["session", "n_asked"], -1)
        self.values: dict[str, Tensor] = {}
        if exam is not None:
            human = session["human"]
            self.model, self.omega = env.belief.response_model, human["omega"]
            self.exam = exam = exam.to(self.omega.device)
            seen, self.ranks = exam.seen.to(self.omega), exam.ranks(self.omega)
            self.answers = env.human.log_probs(seen.expand(len(human), *seen.shape), human).exp()

    def __call__(self, session: TensorDictBase) -> dict[str, Tensor]:
        """The metrics of the sessions as they stand, (B …) by name."""
        if self.exam is None:
            return {}
        kept = session["session"]
        who = (kept["n_asked"] != self.n_asked).squeeze(-1).nonzero().squeeze(-1)
        if not len(who):
            return self.values
        start = time.perf_counter()
        ranks = None if self.ranks is None else self.ranks[who]
        of_them = kept["samples"][who], self.omega[who], self.answers[who]
        standing = Standing(*of_them, self.exam, self.model, ranks)
        for name, values in measure(self.exam.metrics, standing).items():
            before = self.values.get(name, values)
            self.values[name] = before.index_copy(0, who, values)
        self.n_asked = kept["n_asked"].clone()
        self.seconds += time.perf_counter() - start
        return self.values


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
    exam: Exam | None = None,
) -> Evaluation:
    """Run one session with each human.

    Args:
        env: its batch size is B. Seed it alike for every strategy that is to be compared.
        strategy: writes ``action``.
        humans: as drawn by :func:`draw_humans`.
        sample: whether a stochastic policy draws its actions or takes the most likely one.
        exam: what to measure beside alignment, and by what questions.
    """
    mode = ExplorationType.RANDOM if sample else ExplorationType.DETERMINISTIC
    session = env.reset(humans.clone(), set_state=True)
    omega = session["human", "omega"]
    examiner = Examiner(exam, env, session)
    before = _measured(session, omega, examiner).cpu()
    examiner.seconds = 0.0
    start = time.perf_counter()
    steps: list[TensorDictBase] = []
    with torch.no_grad(), set_exploration_type(mode):
        # Not a rollout: that would keep what is on the table, a copy of the pool for each session.
        while len(steps) < env.max_steps and not session["done"].all():
            session = step_mdp(env.step(strategy(session)))
            steps.append(_measured(session, omega, examiner))
    steps_taken = TensorDict.stack(steps, 1).to("cpu")
    seconds = time.perf_counter() - start - examiner.seconds
    n_asked = steps_taken["n_asked"].squeeze(-1)
    curves = {
        name: _by_answers(before[name], steps_taken[name], n_asked, env.budget)
        for name in (*CURVES, *examiner.values)
    }
    asked = n_asked[:, -1]
    offered = steps_taken.get("n_offered", steps_taken["n_asked"])[:, -1, 0]
    history = session["session", "history", "index"].cpu()
    return Evaluation(
        **{name: curves[name].squeeze(-1) for name in CURVES},
        examined={name: curves[name] for name in examiner.values},
        asked=asked,
        offered=offered,
        repeated=_count_repeats(history),
        seconds_per_query=seconds / max(1, int(asked.sum())),
        batch=env.batch,
    )


def _measured(session: TensorDictBase, omega: Tensor, examiner: Examiner) -> TensorDict:
    """What an evaluation reads of sessions as they stand, with humans of weights ω (B D)."""
    kept = session["session"]
    measured = {
        "alignment": alignment(kept["samples"], omega),
        "alignment_of_mean": alignment_of_mean(kept["samples"], omega),
        **{key: kept[key] for key in ("information", "ess", *COUNTS) if key in kept},
        **examiner(session),
    }
    return TensorDict(measured, session.batch_size, device=session.device)


def _by_answers(before: Tensor, values: Tensor, n_asked: Tensor, budget: int) -> Tensor:
    """Curve (B H+1 …) by number of answers, from values (B T …) by step and their start (B …).

    A count never falls from one step (B T) to the next.
    """
    last = (n_asked.unsqueeze(-1) <= torch.arange(budget + 1)).sum(1)
    rows = torch.arange(len(last)).unsqueeze(-1)
    return torch.cat([before.unsqueeze(1), values], 1)[rows, last]


def _count_repeats(history: Tensor) -> Tensor:
    """(B), how many of the asked queries (B H), -1 where none, had been asked before."""
    same = history.unsqueeze(-1) == history.unsqueeze(-2)
    earlier = same.tril(-1).any(-1) & (history >= 0)
    return earlier.sum(-1)
