"""What beliefs are examined by, against brute force, SciPy and closed forms."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.stats
import torch
from config.test_settings import composed
from conftest import RESPONSE_MODELS
from helpers import coin, make, settings_of
from torch import Generator, Tensor

from torchrl_pref.acquisition.scoring import mean_answers
from torchrl_pref.beliefs.sampled import uniform_sphere
from torchrl_pref.build import make_pools, make_query_env, make_task
from torchrl_pref.config.settings import METRICS as NAMES
from torchrl_pref.config.settings import check_evaluate_settings
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.objectives import alignment, alignment_of_mean
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.errors import InputError
from torchrl_pref.evaluation import metrics, views
from torchrl_pref.evaluation.comparison import compare, evaluate_task
from torchrl_pref.evaluation.metrics import (
    ALWAYS,
    BINS,
    METRICS,
    Exam,
    Standing,
    accuracy,
    calibration,
    log_likelihood,
    make_exam,
    measure,
    rank_correlation,
    regret,
    reliability,
)
from torchrl_pref.evaluation.records import CSV, RELIABILITY, read_records
from torchrl_pref.evaluation.reports import write_report
from torchrl_pref.evaluation.run import draw_humans, evaluate
from torchrl_pref.evaluation.side_by_side import Entrant, run_side_by_side
from torchrl_pref.evaluation.views import reliability as reliability_of
from torchrl_pref.humans import HUMANS
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions.approve import Approve
from torchrl_pref.questions.choice import Choice
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann, Optimal
from torchrl_pref.questions.weak import Weak
from torchrl_pref.strategies import Greedy, RandomQuery

ASKED = tuple(name for name in METRICS if name not in ALWAYS)

MODELS = [*RESPONSE_MODELS, Boltzmann(2.0, Weak(1.0)), Boltzmann(4.4, lapse=0.1)]


def standing_of(
    samples: Tensor,
    omega: Tensor,
    model: ResponseModel,
    human: ResponseModel | None = None,
    n_options: int = 2,
    n_queries: int = 30,
) -> Standing:
    """Beliefs and humans, on questions with normal features."""
    size = (n_queries, n_options, omega.shape[-1])
    queries = torch.randn(size, generator=Generator().manual_seed(7))
    exam = Exam(queries, queries, queries.flatten(0, 1), ASKED)
    answers = (human or model)(torch.einsum("nkd,bd->bnk", queries, omega)).exp()
    return Standing(samples, omega, answers, exam, model)


def some(model: ResponseModel, n_options: int = 2, n_samples: int = 12) -> Standing:
    """Three humans, and beliefs around them."""
    rng = Generator().manual_seed(1)
    omega = uniform_sphere((3, 4), rng)
    samples = omega.unsqueeze(1) + 0.7 * uniform_sphere((3, n_samples, 4), rng)
    return standing_of(samples / samples.norm(dim=-1, keepdim=True), omega, model, None, n_options)


def test_names_are_those_that_may_be_typed() -> None:
    assert tuple(METRICS) == NAMES
    standing = some(RESPONSE_MODELS[0])
    found = measure(NAMES, standing)
    assert torch.equal(found["alignment"], alignment(standing.samples, standing.omega))
    assert torch.equal(
        found["alignment_of_mean"], alignment_of_mean(standing.samples, standing.omega)
    )
    for name, values in found.items():
        assert values.shape == (3, 3 * BINS if name == "calibration" else 1), name


@pytest.mark.parametrize("model", MODELS, ids=str)
@pytest.mark.parametrize("n_options", [2, 3])
def test_metrics_of_answers_are_those_of_explicit_sums(
    model: ResponseModel, n_options: int
) -> None:
    if n_options == 3 and isinstance(model.question, Weak):
        pytest.skip("a weak question is about two")
    standing = some(model, n_options)
    right, likely = accuracy(standing), log_likelihood(standing)
    n_samples, n_queries = standing.samples.shape[1], len(standing.exam.queries)
    for b, (samples, omega) in enumerate(zip(standing.samples, standing.omega, strict=True)):
        hits, bits = 0.0, 0.0
        for query in standing.exam.queries:
            truth = model(query @ omega).exp()
            predicted = sum(model(query @ sample).exp() for sample in samples) / n_samples
            best = [r for r, p in enumerate(predicted) if p >= max(predicted) - 1e-6]
            hits += sum(float(truth[r]) for r in best) / len(best)
            for q, p in zip(truth.tolist(), predicted.tolist(), strict=True):
                bits += q * math.log2((n_samples * p + 1 / len(truth)) / (n_samples + 1))
        assert float(right[b]) == pytest.approx(hits / n_queries, abs=1e-5)
        assert float(likely[b]) == pytest.approx(bits / n_queries, abs=1e-5)


def test_rank_correlation_is_spearmans_with_ties() -> None:
    standing = some(RESPONSE_MODELS[0])
    grid = torch.randint(-1, 2, (40, 4), generator=Generator().manual_seed(3)).float()
    exam = replace(standing.exam, trajectories=torch.cat([grid, grid[:7]]))
    whole = torch.tensor([[1.0, -1, 0, 0], [0, 0, 1, 0], [0.5, 0.5, 0.5, 0.5]])
    tied = Standing(whole.unsqueeze(1), whole.roll(1, 0), standing.answers, exam, standing.answers)  # type: ignore[arg-type]
    for case in (standing, tied):
        true, learned = (rewards.numpy() for rewards in case.rewards)
        expected = [
            scipy.stats.spearmanr(*pair).statistic for pair in zip(true, learned, strict=True)
        ]
        assert np.allclose(rank_correlation(case), expected, atol=1e-6)
    alike = replace(exam, trajectories=torch.ones(5, 4))
    assert (rank_correlation(replace(tied, exam=alike)) == 0).all()


def test_regret_is_what_the_best_has_over_the_one_that_is_taken() -> None:
    standing = some(RESPONSE_MODELS[0], n_samples=2)
    found = regret(standing)
    for b in range(3):
        true = [float(standing.omega[b] @ phi) for phi in standing.exam.trajectories]
        learned = [float(standing.samples[b].mean(0) @ phi) for phi in standing.exam.trajectories]
        lost = max(true) - true[learned.index(max(learned))]
        assert float(found[b]) == pytest.approx(
            lost / (max(true) - sum(true) / len(true)), abs=1e-5
        )
    assert (found >= 0).all()
    assert found.max() > 0
    known = replace(standing, samples=3 * standing.omega.unsqueeze(1))  # of any length
    assert torch.allclose(regret(known), torch.zeros(3), atol=1e-6)
    assert torch.allclose(rank_correlation(known), torch.ones(3, dtype=torch.double))
    assert torch.allclose(
        rank_correlation(replace(known, samples=-known.samples)), -torch.ones(3, dtype=torch.double)
    )


def test_calibration_is_the_error_of_all_humans_together() -> None:
    standing = some(Boltzmann(4.4), n_options=3)
    predicted, given = standing.predicted.flatten(), standing.answers.flatten()
    place = np.minimum((predicted * BINS).numpy().astype(int), BINS - 1)
    gaps = [float((predicted - given)[place == one].sum()) for one in range(BINS)]
    found = reliability(standing)
    assert float(calibration(found)) == pytest.approx(sum(map(abs, gaps)) / len(place), abs=1e-6)
    assert float(found[:, :BINS].sum()) == len(place)  # every answer is in a bin
    curve = torch.stack([found, found.flip(0)], 1)  # the order of humans makes no difference
    assert torch.allclose(calibration(curve), calibration(found).expand(2))


@pytest.mark.parametrize(("n_samples", "most"), [(100, 0.02), (400, 0.003)])
def test_who_knows_nothing_is_calibrated_but_for_the_luck_of_the_samples(
    n_samples: int, most: float
) -> None:
    """Predictions scatter about ½ by .045, or half of it: a third, or none, leave its bin."""
    rng = Generator().manual_seed(0)
    omega, samples = uniform_sphere((100, 4), rng), uniform_sphere((100, n_samples, 4), rng)
    prior = standing_of(samples, omega, Boltzmann(4.4))
    of_nobody = replace(prior, answers=torch.full_like(prior.answers, 0.5))
    assert float(calibration(reliability(of_nobody))) < most


def test_a_belief_of_the_population_is_calibrated_and_one_of_a_wrong_tau_is_not() -> None:
    """Humans are among the samples, each once: what is predicted is what the humans do."""
    omega = uniform_sphere((400, 4), Generator().manual_seed(0))
    known = omega[:, 0] > 0.5  # a belief that has learned something
    humans, model = omega[known], Boltzmann(4.4)
    samples = humans.expand(len(humans), *humans.shape)

    def error(assumed: ResponseModel, truth: ResponseModel) -> float:
        return float(calibration(reliability(standing_of(samples, humans, assumed, truth))))

    assert error(model, model) == pytest.approx(0, abs=1e-5)
    assert error(Optimal(), Optimal()) == pytest.approx(0, abs=1e-5)
    assert error(Boltzmann(4.4), Boltzmann(1.1)) > 0.08
    assert error(Boltzmann(4.4), Boltzmann(17.6)) > 0.02


@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_metrics_keep_their_bounds_and_see_no_order_of_options(model: ResponseModel) -> None:
    standing = some(model, n_options=3)
    found = measure(ASKED, standing)
    assert (found["accuracy"] <= standing.answers.amax(-1).mean(-1, keepdim=True) + 1e-6).all()
    least = -math.log2(3 * (standing.samples.shape[1] + 1))
    assert ((found["log_likelihood"] <= 0) & (found["log_likelihood"] >= least)).all()
    assert (found["rank_correlation"].abs() <= 1).all()
    turned = standing.exam.queries.roll(1, 1)
    exam = replace(standing.exam, queries=turned, trajectories=turned.flatten(0, 1))
    other = replace(standing, answers=standing.answers.roll(1, -1), exam=exam)
    for name, values in measure(ASKED, other).items():
        assert torch.allclose(values, found[name], atol=1e-5), name


@pytest.mark.parametrize("name", HUMANS)
def test_humans_answer_as_likely_as_they_say(name: str) -> None:
    """Who will answer at all does so with these probabilities: counted over 4,000 alike."""
    question = Weak(1.0) if name == "undecided" else Choice()
    human = HUMANS[name](Boltzmann(2.0, question, 0.1))
    n_answers = human.response_model.n_answers(2)
    rng = Generator().manual_seed(0)
    drawn = human.draw(4000, 3, n_answers, 4, rng)
    drawn["omega"][:] = drawn["omega"][0].clone()
    if isinstance(human, SimulatedHuman):
        drawn["care"].fill_(0.5)
    queries = torch.randn(5, 2, 4, generator=rng)
    likely = human.log_probs(queries.expand(4000, 5, 2, 4), drawn).exp()
    assert torch.allclose(likely.sum(-1), torch.ones(4000, 5), atol=1e-5)
    if name == "simulated":  # half as careful is half of tau
        expected = Boltzmann(1.0, question, 0.1)(queries @ drawn["omega"][0]).exp()
        assert torch.allclose(likely[0], expected, atol=1e-5)
    for place, query in enumerate(queries):
        given = human.respond(query.expand(4000, 2, 4), drawn, torch.full((4000,), 2))
        given = given[given >= 0]
        shares = torch.bincount(given, minlength=n_answers) / max(1, len(given))
        if len(given):
            assert torch.allclose(shares, likely[0, place], atol=0.03), place


def exam_on(pool: QueryPool) -> Exam:
    queries = pool.features[:20]
    return Exam(queries, queries, pool.features.flatten(0, 1), ASKED)


@pytest.mark.parametrize("kind", [QueryEnv, FeedEnv])
def test_curves_are_those_of_the_states_and_measuring_changes_nothing(
    kind: type[QueryEnv] | type[FeedEnv], pool: QueryPool
) -> None:
    env, exam = make(kind, pool, batch=6), exam_on(pool)
    humans = draw_humans(env)
    env.set_seed(5)
    plain = evaluate(env, coin(env, 3), humans)
    env.set_seed(5)
    result = evaluate(env, coin(env, 3), humans, exam=exam)
    assert torch.equal(plain.alignment, result.alignment)
    assert torch.equal(plain.ess, result.ess)
    assert plain.metrics == {}
    assert set(result.metrics) == set(ASKED)
    for name, values in result.metrics.items():
        assert values.shape == (1 if name == "calibration" else 6, 6)
    env.set_seed(5)
    session = env.reset(humans.clone(), set_state=True)
    again = coin(env, 3)
    omega = session["human", "omega"]
    answers = env.human.log_probs(exam.seen.expand(6, *exam.seen.shape), session["human"]).exp()
    for _ in range(env.max_steps + 1):
        kept = session["session"]
        standing = Standing(kept["samples"], omega, answers, exam, env.belief.response_model)
        expected = measure(ASKED, standing)
        for human, count in enumerate(kept["n_asked"].squeeze(-1).tolist()):
            for name, values in expected.items():
                found = result.examined[name][human, count]
                assert torch.allclose(found, values[human], atol=1e-5), (name, count)
        if session["done"].all():
            break
        session = env.step_mdp(env.step(again(session)))


def test_only_the_time_of_the_sessions_is_told(
    pool: QueryPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = make(QueryEnv, pool, batch=8)
    humans = draw_humans(env)
    # Once before the first question; then each of five answers is measured for a second.
    times = [0.0, 7.0, 10.0, *(10.0 + t for t in range(1, 11)), 27.0]
    clock = SimpleNamespace(perf_counter=iter(times).__next__)
    monkeypatch.setattr("torchrl_pref.evaluation.run.time", clock)
    result = evaluate(env, RandomQuery(), humans, exam=exam_on(pool))
    assert result.seconds_per_query == pytest.approx((27 - 10 - 5) / 40)


def test_what_the_humans_want_is_ranked_once(
    pool: QueryPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    env, ranked = make(QueryEnv, pool, batch=2), []
    monkeypatch.setattr(metrics, "_centred_ranks", lambda values: ranked.append(0) or values)
    evaluate(env, RandomQuery(), draw_humans(env), exam=exam_on(pool))
    assert len(ranked) == 1 + 6  # and what is learned before and after each of five answers


def test_strategies_side_by_side_have_a_calibration_each(pool: QueryPool) -> None:
    humans = draw_humans(make(QueryEnv, pool, batch=6))
    exam = exam_on(pool)

    def make_env(count: int) -> QueryEnv | FeedEnv:
        return make(QueryEnv, pool, batch=count)

    model = RESPONSE_MODELS[0]
    entrants = [Entrant("random", RandomQuery(2)), Entrant("greedy_information", Greedy(model))]
    found = run_side_by_side(make_env, humans, entrants, exam)
    for (result,) in found.values():
        assert result.examined["calibration"].shape == (6, 6, 3 * BINS)
        together = calibration(result.examined["calibration"])
        assert torch.equal(result.metrics["calibration"], together.unsqueeze(0))


def test_questions_are_of_the_pool_that_nothing_asks_from() -> None:
    settings = {**settings_of("query"), "pool": {**settings_of()["pool"], "size": 150}}
    task = make_task(*make_pools(settings), "noisy", settings)
    for pool, other in ((task.test, task.train), (task.train, task.test)):
        exam = make_exam(settings, task, pool)
        assert exam is not None
        assert exam.queries.shape == (100, 2, 4)
        assert torch.equal(exam.queries[[0, -1]], other.features[[0, -1]])
        assert len(exam.queries.unique(dim=0)) == 100
        assert torch.equal(exam.trajectories, other.features.flatten(0, 1))
        assert torch.equal(exam.seen, exam.queries)
    settings["human"] = {"name": "myopic", "discount": 0.9, "tau": None, "lapse": 0.0}
    exam = make_exam(settings, task, task.test)
    assert exam is not None
    assert not torch.isclose(exam.seen, exam.queries).all()
    env = make_query_env(settings, task, task.train, 2, 0)
    assert torch.equal(exam.seen[0], env.seen[0])  # the same walk in the same eyes
    settings["evaluation"] = {**settings["evaluation"], "metrics": list(ALWAYS)}
    assert make_exam(settings, task, task.test) is None


def test_report_shows_what_was_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = settings_of("query")
    settings["evaluation"] = {"humans": 5, "seed": 1, "metrics": ["calibration", "regret"]}
    task = make_task(*make_pools(settings), "noisy", settings)
    records = evaluate_task(settings, task, {})
    write_report(tmp_path, records)
    names = {path.name for path in tmp_path.glob("*.png")}
    assert names == {"figure_1.png", "regret.png", "calibration.png", "reliability.png"}
    again = read_records(tmp_path / CSV)
    result = compare(settings, task, task.test, {})["random"]
    for name in ("calibration", "regret"):
        assert torch.equal(again.values("random", name)[0, 0], result.metrics[name])
    assert set(RELIABILITY) < set(again.metrics)
    counts = [int(again.values("random", name)) for name in RELIABILITY[:BINS]]
    assert sum(counts) == 5 * 30 * 2
    monkeypatch.setattr(views, "FEWEST", sorted(counts)[-2])  # the second largest is enough
    predicted, given = reliability_of(again, "random")
    assert len(predicted) == len([one for one in counts if one >= views.FEWEST])
    assert ((predicted >= 0) & (predicted <= 1) & (given >= 0) & (given <= 1)).all()
    assert (predicted.diff() > 0).all()
    with (tmp_path / "curves.csv").open() as file:
        bands = {row["metric"] for row in csv.DictReader(file) if row["low"]}
    assert {"alignment", "regret"} <= bands  # of all humans together there is no interval
    assert "calibration" not in bands
    head = (tmp_path / "tables.txt").read_text()
    assert "regret" in head
    assert "calibration" in head
    assert "rank" not in head


def test_metrics_that_may_be_typed() -> None:
    for typed in ("[]", "[alignment,calibration]", "[accuracy]"):
        check_evaluate_settings(composed("evaluate", f"evaluation.metrics={typed}"))
    for typed, mend in (
        ("regret", "[regret]"),  # a name alone, and how to write it
        ("[regret,regret]", "[regret]"),
        ("[luck]", "[alignment]"),
        ("5", "[alignment]"),
        ("null", "[alignment]"),
    ):
        with pytest.raises(InputError) as refused:
            check_evaluate_settings(composed("evaluate", f"evaluation.metrics={typed}"))
        told = str(refused.value)
        assert f"as in 'evaluation.metrics={mend}', or 'evaluation.metrics=[]'" in told
        assert "alignment, alignment_of_mean, accuracy" in told


@pytest.mark.parametrize(
    ("model", "n_options"),
    [
        *((model, n_options) for model in RESPONSE_MODELS for n_options in (2, 3)),
        (Boltzmann(2.0, Weak(1.0)), 2),
        (Boltzmann(2.0, Approve(0.0)), 1),
        (Boltzmann(4.4, lapse=0.1), 2),
        (Optimal(lapse=0.1), 2),
    ],
    ids=str,
)
def test_mean_answers_are_the_means_of_what_samples_predict(
    model: ResponseModel, n_options: int
) -> None:
    rng = Generator().manual_seed(5)
    samples = uniform_sphere((2, 3000, 4), rng)  # fifty queries are beyond a chunk
    queries = torch.randn(2, 50, n_options, 4, generator=rng)
    queries[0, 0] = queries[0, 0, :1]  # a tie
    returns = torch.einsum("bckd,bmd->bcmk", queries, samples)
    expected = model(returns).exp().mean(-2)
    assert torch.allclose(mean_answers(samples, queries, model), expected, atol=1e-5)
