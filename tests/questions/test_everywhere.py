"""Each kind of question works wherever one can be asked, and so does refusing to answer it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from config.test_settings import composed
from helpers import settings_of, trainer_of
from tensordict import TensorDictBase
from torch import Generator, Tensor

from torchrl_pref import Session
from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.build import make_pools, make_task
from torchrl_pref.config.settings import check_train_settings
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.objectives import OBJECTIVES, alignment
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.envs.transition import OPEN, REFUSED
from torchrl_pref.errors import InputError
from torchrl_pref.evaluation.comparison import evaluate_task, policy_key
from torchrl_pref.evaluation.reports import write_report
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.policies import POLICIES
from torchrl_pref.pool import QueryPool
from torchrl_pref.pretrained import pretrained_policy
from torchrl_pref.questions import QUESTIONS
from torchrl_pref.questions.calibrate import calibrate_tau
from torchrl_pref.questions.responses import Boltzmann
from torchrl_pref.strategies import STRATEGIES
from torchrl_pref.training.start import make_checkpoint
from torchrl_pref.trial import check_groups

OPTIONS = {"choice": 2, "weak": 2, "ranking": 3, "best_worst": 4, "approve": 1}
KINDS = pytest.mark.parametrize("name", QUESTIONS)
ENVS = pytest.mark.parametrize("kind", [QueryEnv, FeedEnv])


class Silent(SimulatedHuman):
    """Says nothing of every second question."""

    def respond(self, queries: Tensor, human: Any, turn: Tensor) -> Tensor:
        return torch.where(turn % 2 == 1, REFUSED, super().respond(queries, human, turn))


def env_of(
    kind: type, name: str, generator: Generator, human: type = SimulatedHuman, **options: Any
) -> QueryEnv | FeedEnv:
    model = Boltzmann(4.0, QUESTIONS[name]())
    pool = QueryPool(torch.randn(40, OPTIONS[name], 4, generator=generator))
    if kind is FeedEnv:
        options = {"skip": "free", **options}
    made = {"budget": 6, "batch_size": (30,), "seed": 0, "objective": "alignment", **options}
    return kind(pool, human(model), Belief(model, 60), **made)  # type: ignore[no-any-return]


def reached(data: TensorDictBase) -> float:
    last = data[:, -1]
    return float(alignment(last["next", "samples"], last["human", "omega"]).mean())


@KINDS
def test_strategies(name: str, generator: Generator) -> None:
    env, found = env_of(QueryEnv, name, generator), {}
    for strategy, make in STRATEGIES.items():
        env.set_seed(0)
        found[strategy] = reached(env.rollout(6, make(env)))
        assert found[strategy] > 0.3
    assert found["alignment_gain"] > found["random"]


@KINDS
@ENVS
def test_policies(kind: type, name: str, generator: Generator) -> None:
    """The package's, untrained and trained on choices of two."""
    env = env_of(kind, name, generator)
    for policy in [
        *(each.make(env) for each in POLICIES.values()),
        pretrained_policy(env),
    ]:
        data = env.rollout(env.max_steps, policy.strategy, break_when_any_done=False)
        assert data["logits"].isfinite().all()
        assert policy.critic(data)["state_value"].isfinite().all()
    last = data["next", "session", "samples"], data["human", "omega"]
    assert alignment(*last)[data["next", "n_asked"] == env.budget].mean() > 0.3


@KINDS
@pytest.mark.parametrize("objective", OBJECTIVES)
def test_objectives(objective: str, name: str, generator: Generator) -> None:
    env = env_of(FeedEnv, name, generator, objective=objective, skip="regret")
    reward = env.rollout(12)["next", "reward"]
    assert reward.isfinite().all()
    assert reward.abs().sum() > 0


@KINDS
@ENVS
def test_who_would_not_say_was_asked_and_teaches_nothing(
    kind: type, name: str, generator: Generator
) -> None:
    env = env_of(kind, name, generator, Silent, objective="information_gain")
    data = env.rollout(40, break_when_any_done=False)["next"]
    before, after = data["session"][:, :-1], data["session"][:, 1:]
    n_asked = after["n_asked"].squeeze(-1)
    asked = n_asked == before["n_asked"].squeeze(-1) + 1
    silent = asked & (n_asked % 2 == 0)
    assert silent.any()
    for key in ("samples", "ess", "information"):
        assert torch.equal(after[key][silent], before[key][silent])
    assert (data["reward"][:, 1:][silent] == 0).all()
    assert (after["information"] - before["information"])[asked & ~silent].sum() > 0
    given = data["session", "history", "answers"]
    assert set(given[..., 1::2].unique().tolist()) == {OPEN, REFUSED}
    assert (given[..., ::2] != REFUSED).all()


@KINDS
def test_ask_and_tell(name: str, generator: Generator) -> None:
    """By labels, and not saying."""
    model = Boltzmann(4.0, QUESTIONS[name]())
    session = Session(torch.randn(60, OPTIONS[name], 4, generator=generator), model, budget=12)
    omega = torch.tensor([0.5, -0.5, 0.5, 0.5])
    assert len(session.answers) == model.n_answers(OPTIONS[name])
    for _ in range(11):
        likely = model(session.ask().features @ omega).argmax()
        session.tell(session.answers.index(session.answers[int(likely)]))
    assert torch.cosine_similarity(session.weights.mean, omega, dim=0) > 0.8
    before = session.samples
    session.ask()
    session.tell(None)
    assert torch.equal(session.samples, before)
    with pytest.raises(InputError, match="answer"):
        session.tell(len(session.answers))


@KINDS
@pytest.mark.parametrize("setup", ["query", "feed"])
def test_training_and_evaluation(setup: str, name: str, tmp_path: Path) -> None:
    settings = settings_of(setup, updates=2)
    settings["question"] = {"name": name, **vars(QUESTIONS[name]())}
    settings["pool"]["options"] = OPTIONS[name]
    check_groups(settings)
    trainer, task = trainer_of(settings)
    trainer.run(tmp_path, lambda: None, logger=[])
    learned = {policy_key(settings): make_checkpoint(settings, task, trainer)}
    records = evaluate_task(settings, task, learned)
    assert records.entries
    if setup == "query":  # a report is drawn from the records alone, slowly
        write_report(tmp_path, records)
        assert list(tmp_path.glob("*.png"))


@pytest.mark.parametrize("name", ["ranking", "best_worst", "approve"])
def test_those_who_never_err_can_be_asked(name: str) -> None:
    settings = settings_of("query")
    settings["tau"], settings["question"] = "optimal", {"name": name, **vars(QUESTIONS[name]())}
    settings["pool"]["options"] = OPTIONS[name]
    task = make_task(*make_pools(settings), "optimal", settings)
    records = evaluate_task(settings, task, {})
    assert records.entries


@pytest.mark.parametrize("name", ["choice", "weak", "ranking", "best_worst"])
def test_a_comparison_is_of_two_at_least(name: str) -> None:
    settings = composed("train", f"question={name}", "pool.options=1")
    with pytest.raises(InputError, match=r"pool.options=1: expected .* at least 2"):
        check_train_settings(settings)


def test_tau_of_an_approval_is_that_of_the_sign(generator: Generator) -> None:
    """90% of the answers say on which side of the average a trajectory is."""
    returns = torch.randn(500, 1, generator=generator)
    tau = calibrate_tau(returns, 0.9)
    right = torch.sigmoid(tau * returns.double().abs()).mean()
    assert float(right) == pytest.approx(0.9, abs=1e-4)
