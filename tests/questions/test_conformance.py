"""What every entry of QUESTIONS keeps to, by formulas that read nothing but an answer's label."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from reference import Array, chance
from scipy.stats import chi2
from torch import Generator, Tensor

from torchrl_pref.acquisition.functions import alignment_gain, information_gain
from torchrl_pref.acquisition.scoring import score_in_tensors, score_queries, together
from torchrl_pref.beliefs.sampled import Belief, uniform_sphere
from torchrl_pref.errors import InputError
from torchrl_pref.questions import QUESTIONS
from torchrl_pref.questions.approve import Approve
from torchrl_pref.questions.base import Answers, Question, answers_on, reordered
from torchrl_pref.questions.best_worst import BestWorst
from torchrl_pref.questions.choice import Choice
from torchrl_pref.questions.ranking import Ranking
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann, Optimal
from torchrl_pref.questions.weak import Weak

CASES: list[tuple[Question, int]] = [
    (Choice(), 2),
    (Choice(), 4),
    (Weak(0.7), 2),
    (Ranking(), 2),
    (Ranking(), 3),
    (Ranking(), 4),
    (BestWorst(), 2),
    (BestWorst(), 4),
    (Approve(), 1),
    (Approve(0.8), 1),
]
# Of what is in the table and not above.
TRIED = {type(question) for question, _ in CASES}
CASES += [(kind(), 3) for kind in QUESTIONS.values() if kind not in TRIED]
OF_ALL = pytest.mark.parametrize(("question", "n_options"), CASES, ids=str)
ONCE = [case for case in CASES if case[1] != 2 or type(case[0]) is Weak or case[0] == Choice()]
"""Of what is alike about two options, one."""

TAUS = (1e-3, 4.5, 1e3)


def with_taus(cases: list[tuple[Question, int]], *taus: float | None) -> pytest.MarkDecorator:
    """Cases with each tau; those who never err (None) are asked nothing with a threshold."""
    each = [
        (tau, *case)
        for tau in taus
        for case in cases
        if tau is not None or not threshold_of(case[0])
    ]
    return pytest.mark.parametrize(("tau", "question", "n_options"), each, ids=str)


def threshold_of(question: Question) -> float:
    return float(getattr(question, "threshold", 0.0))


def model_for(question: Question, tau: float | None, lapse: float = 0.0) -> ResponseModel:
    """Who answers by a tau, or never errs."""
    return Optimal(0, lapse, question) if tau is None else Boltzmann(tau, question, lapse)


def labels_of(question: Question, n_options: int) -> tuple[str, ...]:
    return answers_on(question, n_options, torch.device("cpu")).labels


def chances(question: Question, returns: Array, tau: float | None, lapse: float = 0.0) -> Array:
    """(N R), of all answers."""
    count = len(labels_of(question, returns.shape[1]))
    each = [chance_of(answer, question, returns, tau) for answer in range(count)]
    return (1 - lapse) * np.stack(each, 1) + lapse / count


def chance_of(answer: int, question: Question, returns: Array, tau: float | None) -> Array:
    """(N), of one answer, where nobody answers at random: by the formula of its kind, or, of a kind
    that is not known here, the product of its factors, as its question's table says."""
    if type(question) in TRIED:
        label = labels_of(question, returns.shape[1])[answer]
        return chance(label, returns, tau, threshold_of(question))
    table = question.answers(returns.shape[1])
    contrasts, offsets = table.contrasts[answer].double().numpy(), table.offsets[answer].numpy()
    gaps = (1e9 if tau is None else tau) * np.einsum("fjk,nk->nfj", contrasts, returns) + offsets
    lost = np.concatenate([np.zeros_like(gaps[..., :1]), -gaps], -1)
    likelihood: Array = np.exp(
        table.log_weights[answer].item() - np.logaddexp.reduce(lost, -1).sum(-1)
    )
    return likelihood


@pytest.mark.parametrize("lapse", [0.0, 0.1])
@with_taus(CASES, *TAUS, None)
def test_probabilities_are_those_of_the_formula(
    tau: float | None, lapse: float, question: Question, n_options: int, generator: Generator
) -> None:
    model = model_for(question, tau, lapse)
    returns = torch.randn(30, n_options, generator=generator)
    returns[:5] = returns[:5, :1]  # all alike
    if tau is None and n_options == 1:
        returns[0] = 0  # the average itself: a yes and a no are as likely
    probs = model(returns).exp()
    assert torch.allclose(probs.sum(-1), torch.ones(30), atol=1e-5)
    assert np.allclose(probs, chances(question, returns.double().numpy(), tau, lapse), atol=2e-5)
    assert torch.allclose(model(returns[3]), model(returns)[3], atol=1e-6)


@OF_ALL
def test_who_is_listed_where_makes_no_difference(
    question: Question, n_options: int, generator: Generator
) -> None:
    """Each order of the options has the same answers, under other numbers."""
    returns = torch.randn(20, n_options, generator=generator)
    order = torch.randperm(n_options, generator=generator)
    probs, other = (Boltzmann(2.0, question)(each).exp() for each in (returns, returns[:, order]))
    before, after = (
        chances(question, each.double().numpy(), 2.0) for each in (returns, returns[:, order])
    )
    apart = np.abs(before[:, :, None] - after[:, None]).max(0)
    number = torch.tensor(apart.argmin(1))
    assert sorted(number.tolist()) == list(range(len(number)))
    assert torch.allclose(probs, other[:, number], atol=1e-6)


@OF_ALL
def test_what_was_said_of_options_in_another_order(
    question: Question, n_options: int, generator: Generator
) -> None:
    """The answer that was meant is as likely as the one that was said of what was seen."""
    returns = torch.randn(20, n_options, generator=generator)
    for _ in range(3):
        order = tuple(torch.randperm(n_options, generator=generator).tolist())
        seen = chances(question, returns[:, order].double().numpy(), 2.0)
        meant = reordered(question, order)
        assert meant is not None
        assert sorted(meant) == list(range(len(meant)))
        there = chances(question, returns.double().numpy(), 2.0)
        assert np.allclose(seen, there[:, meant], atol=1e-6)


@OF_ALL
def test_what_a_person_points_at_tells_the_answers_apart(
    question: Question, n_options: int, generator: Generator
) -> None:
    """And it is what the formula calls likely: who points at the best first says the likeliest."""
    places = question.places(n_options)
    if type(question) not in TRIED:  # it may have none, or others
        return
    assert places is not None
    assert len(set(places)) == len(places) == len(labels_of(question, n_options))
    returns = np.linspace(3.0, -3.0, n_options)[None] if n_options > 1 else np.array([[3.0]])
    likeliest = chances(question, returns, 2.0)[0].argmax()
    firsts = {"BestWorst": (0, n_options - 1), "Ranking": tuple(range(n_options))}
    assert places[likeliest] == firsts.get(type(question).__name__, (0,))
    assert question.prompt.strip() != Question.prompt


def test_questions_that_are_not_alike_for_all_options_are_not_reordered() -> None:
    class Better(Question):
        """Is the first better than the second? Yes, no, or surely not."""

        def answers(self, n_options: int) -> Answers:
            table = answers_on(Choice(), 2, torch.device("cpu"))
            which = torch.tensor([0, 1, 1])
            half = torch.tensor([0.0, -math.log(2), -math.log(2)])
            return Answers(("a", "b", "c"), table.contrasts[which], table.offsets[which], half)

    assert reordered(Better(), (1, 0)) is None
    assert Better().places(2) is None


@pytest.mark.parametrize("lapse", [0.0, 0.1])
@with_taus(CASES, *TAUS)
def test_evidence_says_what_the_formula_says(
    tau: float, lapse: float, question: Question, n_options: int, generator: Generator
) -> None:
    """Of a history with a gap, up to a number that does not depend on ω."""
    model, count = model_for(question, tau, lapse), len(labels_of(question, n_options))
    omega = uniform_sphere((40, 3), generator)
    options = 0.02 * torch.randn(4, n_options, 3, generator=generator)  # far from underflow
    answers = torch.tensor([0, -1, count - 1, 0])
    evidence = model.evidence(options, answers)
    gaps = evidence.double()[None].gaps(omega[None].double())[0]
    found = model.joint_log_likelihood(gaps, evidence.floor.double()).numpy()
    expected = np.zeros(40)
    for query, answer in zip(options.double().numpy(), answers.tolist(), strict=True):
        if answer >= 0:
            returns = omega.double().numpy() @ query.T
            expected += np.log(chances(question, returns, tau, lapse)[:, answer])
    apart = found - expected
    assert np.ptp(apart) < 1e-5 * max(1.0, np.abs(expected).max())


@pytest.mark.parametrize("lapse", [0.0, 0.1])
@with_taus(CASES, *TAUS, None)
def test_gains_are_those_of_the_formula(
    tau: float | None, lapse: float, question: Question, n_options: int, generator: Generator
) -> None:
    """Compiled and in tensors."""
    model = model_for(question, tau, lapse)
    samples = uniform_sphere((2, 60, 3), generator)
    queries = torch.randn(2, 3, n_options, 3, generator=generator)
    both = together(information_gain, alignment_gain)
    found = score_queries(samples, queries, model, both)
    assert torch.allclose(score_in_tensors(samples, queries, model, both), found, atol=2e-5)
    for b in range(2):
        omegas = samples[b].double().numpy()
        for c in range(3):
            returns = omegas @ queries[b, c].double().numpy().T
            probs = np.maximum(chances(question, returns, tau, lapse), 1e-300)
            mean = probs.mean(0)
            gain = (probs * np.log2(probs / mean)).sum(1).mean()
            after = probs.T @ omegas / len(omegas) / mean[:, None]
            longer = mean @ np.square(after).sum(1) - np.square(omegas.mean(0)).sum()
            assert found[b, c].tolist() == pytest.approx([gain, longer], abs=3e-5)


class InTensors(ResponseModel):
    """The same model, in a way that no compiled loop knows."""

    def __init__(self, model: Boltzmann | Optimal) -> None:
        self.model, self.question = model, model.question
        self.lapse, self.scale = model.lapse, model.scale

    @property
    def is_soft(self) -> bool:
        return self.model.is_soft

    def log_likelihood(self, gaps: Tensor) -> Tensor:
        return self.model.log_likelihood(gaps)

    def agrees(self, gaps: Tensor) -> Tensor:
        return self.model.agrees(gaps)

    def possible_arc(self, cosine: Tensor, sine: Tensor, raised: Tensor) -> tuple[Tensor, Tensor]:
        return self.model.possible_arc(cosine, sine, raised)


@with_taus(ONCE, 3.0, None)
@pytest.mark.parametrize("n_features", [2, 4])
@pytest.mark.parametrize("in_tensors", [False, True], ids=["compiled", "tensors"])
def test_the_posterior_is_that_of_the_formula(
    in_tensors: bool,
    tau: float | None,
    n_features: int,
    question: Question,
    n_options: int,
    generator: Generator,
) -> None:
    """After answers with a gap, and soft ones with a contradiction, by 200,000 prior draws."""
    model = model_for(question, tau)
    options = torch.randn(4, n_options, n_features, generator=generator)
    options[3] = options[0]
    count, likely = len(labels_of(question, n_options)), uniform_sphere((n_features,), generator)
    answers = model(options @ likely).argmax(-1)
    answers[1] = -1
    if tau is not None:
        answers[3] = (answers[0] + 1) % count  # the same question, another answer
    assert isinstance(model, (Boltzmann, Optimal))
    told = InTensors(model) if in_tensors else model
    sessions = 40 if in_tensors else 200
    samples, ess = Belief(told).prior(sessions, n_features, generator), torch.full((sessions,), 1e2)
    for h in (1, 3, 4):
        evidence = told.evidence(options[:h], answers[:h]).expand(sessions, h)
        samples, ess, used = Belief(told).update(samples, ess, evidence, generator)
        assert used.all()
    omega = np.random.default_rng(1).standard_normal((200_000, n_features))
    omega /= np.linalg.norm(omega, axis=1, keepdims=True)
    weights = np.ones(len(omega))
    for query, answer in zip(options.double().numpy(), answers.tolist(), strict=True):
        if answer >= 0:
            weights *= chance_of(answer, question, omega @ query.T, tau)
    weights /= weights.sum()
    mean = weights @ omega
    variance = weights @ np.square(omega - mean).sum(1)
    # Both are estimates; M is finite, for which a hundredth of the spread is allowed.
    found, within = samples.double(), 0.01 * math.sqrt(variance)
    means, sharp = found.mean(1), np.square(weights).sum()
    error = math.hypot(means.std(0).norm() / math.sqrt(sessions), math.sqrt(variance * sharp))
    assert np.linalg.norm(means.mean(0).numpy() - mean) < 4 * error + within
    spread = (found - torch.tensor(mean)).square().sum(-1).mean(1)
    distance = np.square(omega - mean).sum(1) - variance
    error = math.hypot(
        spread.std() / math.sqrt(sessions), math.sqrt(np.square(weights * distance).sum())
    )
    assert abs(float(spread.mean()) - variance) < 4 * error + 0.02 * variance


@with_taus(ONCE, 4.5, None)
def test_ranks_are_uniform(
    tau: float | None, question: Question, n_options: int, generator: Generator
) -> None:
    """Simulation-based calibration: of who answers as the belief thinks, the place of a random
    direction's return among the samples' is any (Talts et al., 2018)."""
    model, sessions, budget = model_for(question, tau), 300, 5
    belief = Belief(model)
    omega = uniform_sphere((sessions, 4), generator)
    options = torch.randn(sessions, budget, n_options, 4, generator=generator)
    log_probs = model(torch.einsum("shkd,sd->shk", options, omega))
    answers = log_probs.exp().flatten(0, 1).multinomial(1, generator=generator).view(sessions, -1)
    samples, ess = belief.prior(sessions, 4, generator), torch.full((sessions,), 100.0)
    for h in range(1, budget + 1):
        evidence = model.evidence(options[:, :h], answers[:, :h])
        samples, ess, used = belief.update(samples, ess, evidence, generator)
        assert used.all()
    direction = uniform_sphere((sessions, 4), generator)
    of_samples = torch.einsum("smd,sd->sm", samples, direction)
    rank = (of_samples < (omega * direction).sum(-1, keepdim=True)).sum(1)
    counts = (rank * 10 // 101).bincount(minlength=10)
    distance = float((counts - sessions / 10).square().sum() / (sessions / 10))
    assert distance < chi2.ppf(0.999, 9)


def test_kinds_that_are_one(generator: Generator) -> None:
    """Two options leave one question, whatever it is called; of three the rest has an order."""
    two, three = (torch.randn(20, k, generator=generator) for k in (2, 3))
    choice = Boltzmann(2.0)(two)
    assert torch.allclose(Boltzmann(2.0, Ranking())(two), choice, atol=1e-6)
    assert torch.allclose(Boltzmann(2.0, BestWorst())(two), choice, atol=1e-6)
    best_worst, ranking = (Boltzmann(2.0, kind())(three) for kind in (BestWorst, Ranking))
    assert torch.allclose(best_worst.sort(-1).values, ranking.sort(-1).values, atol=1e-5)
    # The best of a ranking is a choice.
    first = Boltzmann(2.0, Ranking())(three).exp().unflatten(-1, (3, 2)).sum(-1)
    assert torch.allclose(first, Boltzmann(2.0)(three).exp(), atol=1e-6)


def test_labels() -> None:
    assert labels_of(Ranking(), 3)[:3] == ("A > B > C", "A > C > B", "B > A > C")
    assert labels_of(BestWorst(), 3)[1] == "best A, worst C"
    assert labels_of(Approve(), 1) == ("no", "yes")
    assert len(labels_of(Ranking(), 6)) == 720


@pytest.mark.parametrize(
    ("model", "n_options", "words"),
    [
        (Boltzmann(1.0, Ranking()), 7, "ranking of 7 options: expected at most 6"),
        (Boltzmann(1.0, Ranking()), 1, "options=1"),
        (Boltzmann(1.0, BestWorst()), 27, "worst of 27 options: expected at most 26"),
        (Boltzmann(1.0, BestWorst()), 1, "options=1"),
        (Boltzmann(1.0, Approve()), 2, "a yes or no about 2 options: expected 1"),
        (Optimal(question=Weak()), 2, "no threshold counts"),
        (Optimal(question=Approve(0.5)), 1, "no threshold counts"),
    ],
    ids=str,
)
def test_what_cannot_be_asked(model: ResponseModel, n_options: int, words: str) -> None:
    with pytest.raises(InputError, match=words):
        model.n_answers(n_options)


@pytest.mark.parametrize("threshold", [math.nan, 101, "0", True])
def test_a_threshold_is_a_number(threshold: object) -> None:
    with pytest.raises(InputError, match="expected a number from -100 to 100"):
        Approve(threshold)  # type: ignore[arg-type]
