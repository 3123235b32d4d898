"""Response models: how likely each answer to a query is, given the returns of its options.

Shapes: K options, R possible answers, H answers given, F factors of an answer, J rows of a factor,
D features, ``…`` any leading dimensions.

A response model is the one place where a likelihood is written. The belief, the acquisition
functions, the simulated humans and the calibration of ``tau`` all call it.

``tau`` *multiplies* the returns (it is an inverse temperature, also called rationality): a large
``tau`` means a careful human. Other libraries divide by it.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, final

import torch
from torch import Tensor
from torch.nn import functional as F

from torchrl_pref.errors import (
    InputError,
    check_not_negative,
    check_positive,
    check_share,
    check_type,
)
from torchrl_pref.questions.base import Answers, Question, answers_on
from torchrl_pref.questions.choice import Choice
from torchrl_pref.questions.response_model import Prediction, ResponseModel

TOLERANCE = 1e-6
"""Of answers without error, by default."""

MAX_TAU = 1e30
"""Larger and a product with a return is beyond float32; 10⁶ is an optimal human already."""


@final
class Boltzmann(ResponseModel):
    r"""The paper's noisily rational human (section 3.2).

    .. math:: P(q = \xi_i \mid Q, \omega) =
        \frac{\exp \tau R(\xi_i)}{\sum_{\xi \in Q} \exp \tau R(\xi)}

    Args:
        tau: what the returns are multiplied by; above 0. Larger is less noisy.
        question: the kind of question; by default a choice of one option.
        lapse: probability of an answer at random, from 0 to below 1.

    Raises:
        InputError: ``tau`` is not a finite number above zero, or beyond float32, or the lapse rate
            is no such probability.
    """

    def __init_subclass__(cls, **_: Any) -> None:
        _refuse_subclass(cls, Boltzmann)

    def __init__(self, tau: float, question: Question | None = None, lapse: float = 0.0) -> None:
        self.tau = self.scale = check_positive("tau", tau)
        if self.tau > MAX_TAU:
            raise InputError(f"tau={tau!r}: expected at most {MAX_TAU:g}; use Optimal() instead")
        self.question = _check_question(question)
        self.lapse = _check_lapse(lapse)

    def log_likelihood(self, gaps: Tensor) -> Tensor:
        """See :meth:`ResponseModel.log_likelihood`."""
        if gaps.shape[-1] == 1:
            return F.logsigmoid(self.tau * gaps.squeeze(-1))
        return -torch.logsumexp(F.pad(-self.tau * gaps, (1, 0)), -1)

    def joint_log_likelihood(self, gaps: Tensor, floor: Tensor) -> Tensor:
        """See :meth:`ResponseModel.joint_log_likelihood`."""
        if gaps.shape[-1] > 1 or self.lapse:
            return super().joint_log_likelihood(gaps, floor)
        # log σ(z) = min(z, 0) + log σ(|z|)
        logit = self.tau * gaps.flatten(-3)
        return logit.clamp(max=0).sum(-1) + sum_of_logs(logit.abs().sigmoid_())

    def __call__(self, returns: Tensor) -> Tensor:
        """See :meth:`ResponseModel.__call__`."""
        if not self.is_plain:
            return super().__call__(returns)
        # The same as in general, in K exponentials and not K².
        if returns.shape[-1] == 2:
            lead = returns[..., 0] - returns[..., 1]
            return F.logsigmoid(self.tau * torch.stack([lead, -lead])).movedim(0, -1)
        return torch.log_softmax(self.tau * returns.movedim(-1, 0), 0).movedim(0, -1)

    def predict(self, leads: Tensor) -> Prediction:
        """See :meth:`ResponseModel.predict`."""
        if leads.shape[-1] > 1 or not self.is_plain:
            return super().predict(leads)
        # With q the probability of the less likely answer and z the logit, the entropy is
        # |z| q - log(1 - q): no logarithm of each sample, and no term that can cancel another.
        logit = self.tau * leads.squeeze(-1)
        first = torch.sigmoid(logit)
        second = 1 - first
        probs = torch.stack([first, second]).movedim(0, -1)
        unlikely, likely = torch.minimum(first, second), torch.maximum(first, second)
        entropy = logit.abs_().mul_(unlikely).mean(-1) - sum_of_logs(likely) / logit.shape[-1]
        return Prediction(probs, entropy, leads)

    def mean_answer(self, leads: Tensor) -> Tensor:
        """See :meth:`ResponseModel.mean_answer`."""
        if leads.shape[-1] > 1 or not self.is_plain:
            return super().mean_answer(leads)
        first = torch.sigmoid(self.tau * leads.squeeze(-1)).mean(-1)
        return torch.stack([first, 1 - first], -1)

    def __repr__(self) -> str:
        return f"Boltzmann(tau={shown(self.tau)}{_beside(self)})"


@final
class Optimal(ResponseModel):
    """The paper's optimal user, the limit of ``Boltzmann`` as tau grows: argmax, ties uniform.

    Args:
        tolerance: gaps this small count as ties. It absorbs the rounding of float32 returns, so a
            belief never excludes the very human who answered. In the units of the return.
        lapse: probability of an answer at random, from 0 to below 1.
        question: the kind of question; by default a choice of one option. Each factor of an answer
            is then an argmax. A question about options whose answers have thresholds is refused
            when it is asked.

    Raises:
        InputError: ``tolerance`` is not a finite number of at least zero, or the lapse rate is no
            such probability.
    """

    def __init_subclass__(cls, **_: Any) -> None:
        _refuse_subclass(cls, Optimal)

    def __init__(
        self, tolerance: float = TOLERANCE, lapse: float = 0.0, question: Question | None = None
    ) -> None:
        self.tolerance = check_not_negative("tolerance", tolerance)
        self.question = _check_question(question)
        self.lapse = _check_lapse(lapse)

    @property
    def is_soft(self) -> bool:
        """See :meth:`ResponseModel.is_soft`."""
        return bool(self.lapse)

    def log_likelihood(self, gaps: Tensor) -> Tensor:
        """See :meth:`ResponseModel.log_likelihood`."""
        ties = 1 + (gaps.abs() <= self.tolerance).sum(-1)
        beaten = (gaps < -self.tolerance).any(-1)
        return torch.where(beaten, -math.inf, -ties.to(gaps.dtype).log())

    def agrees(self, gaps: Tensor) -> Tensor:
        """See :meth:`ResponseModel.agrees`: two that differ are never quite equal."""
        return (gaps > self.tolerance).all(-1).all(-1) | bool(self.lapse)

    def possible_arc(self, cosine: Tensor, sine: Tensor, raised: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`ResponseModel.possible_arc`."""
        if self.lapse:
            return super().possible_arc(cosine, sine, raised)
        raised = raised + self.tolerance
        # p cos θ + q sin θ + c is zero where tan(θ/2) = (p + c) / (± √(q² + p² - c²) - q).
        square = sine.square() + cosine.square() - raised.square()
        root, room = square.clamp(min=0).sqrt(), (cosine + raised).clamp(min=1e-30)
        cotangents = ((root + sign * sine) / room for sign in (1, -1))
        one = torch.ones_like(cosine[0])
        below, above = (
            2 * torch.atan2(one, cotangent.masked_fill(square <= 0, -math.inf).amax(0))
            for cotangent in cotangents
        )
        return -below, above

    def predict(self, leads: Tensor) -> Prediction:
        """See :meth:`ResponseModel.predict`."""
        if leads.shape[-1] > 1 or not self.is_plain:
            return super().predict(leads)
        winner = F.hardshrink(leads.squeeze(-1), self.tolerance).sign()  # 1, -1, or 0 for a tie
        entropy = math.log(2) * (1 - winner.abs().mean(-1))
        probs = torch.stack([winner + 1, 1 - winner]).movedim(0, -1) / 2
        return Prediction(probs, entropy, leads)

    def mean_answer(self, leads: Tensor) -> Tensor:
        """See :meth:`ResponseModel.mean_answer`."""
        if leads.shape[-1] > 1 or not self.is_plain:
            return super().mean_answer(leads)
        winner = F.hardshrink(leads.squeeze(-1), self.tolerance).sign().mean(-1)
        return torch.stack([1 + winner, 1 - winner], -1) / 2

    def __repr__(self) -> str:
        tolerance = "" if self.tolerance == TOLERANCE else f", tolerance={shown(self.tolerance)}"
        return f"Optimal({(tolerance + _beside(self))[2:]})"

    def _answers(self, n_options: int, device: torch.device) -> Answers:
        table = super()._answers(n_options, device)
        _check_even(self.question, n_options)
        return table


def _check_question(question: Any) -> Question:
    """A choice where there is none.

    Raises:
        InputError: it is no kind of question.
    """
    if question is None:
        return Choice()
    check_type("question", question, Question, "Choice() or Weak(1.0)")
    assert isinstance(question, Question)
    return question


def _check_lapse(lapse: Any) -> float:
    """The lapse rate.

    Raises:
        InputError: it is no number from 0 to below 1.
    """
    if check_share("lapse", lapse) == 1:
        raise InputError("lapse=1: expected below 1, or the answers would say nothing of ω")
    return float(lapse)


def shown(number: float) -> str:
    """A number in as few digits as tell it from every other."""
    short = f"{number:g}"
    return short if float(short) == number else repr(number)


def _beside(model: ResponseModel) -> str:
    """What a model's name says beside its tau."""
    question = "" if type(model.question) is Choice else f", {model.question!r}"
    return question + (f", lapse={shown(model.lapse)}" if model.lapse else "")


def model_of(tau: float | None, question: Question, lapse: float) -> ResponseModel:
    """How someone answers; tau is None for one who never errs.

    Raises:
        InputError: a number is out of range.
    """
    return (
        Optimal(lapse=lapse, question=question) if tau is None else Boltzmann(tau, question, lapse)
    )


@lru_cache(maxsize=64)
def _check_even(question: Question, n_options: int) -> None:
    """Refuse to ask what has thresholds of those who never err.

    Raises:
        InputError: an answer is harder or easier to give than between equals.
    """
    _, _, offsets, log_weights = answers_on(question, n_options, torch.device("cpu"))
    if ((offsets != 0) & offsets.isfinite()).any() or (log_weights != 0).any():
        raise InputError(
            f"tau=optimal with {question!r}: to a human who never errs no threshold counts, and "
            "nothing is about equal; expected a question without thresholds, or another tau"
        )


def compiled_constants(response_model: ResponseModel) -> tuple[float, float] | None:
    """What the compiled loops know a model by: tau and tolerance; None for others than ours."""
    if isinstance(response_model, Boltzmann):
        return response_model.tau, 0.0
    if isinstance(response_model, Optimal):
        return math.inf, response_model.tolerance
    return None


def _refuse_subclass(cls: type, parent: type) -> None:
    """Closed forms of its own likelihood make a model unfit to be derived from.

    Raises:
        TypeError: always.
    """
    raise TypeError(
        f"{cls.__name__} derives from {parent.__name__}, whose closed forms it would inherit with "
        "another likelihood; derive from ResponseModel and define log_likelihood"
    )


def sum_of_logs(probs: Tensor) -> Tensor:
    """Sum over the last dimension of the logs of numbers between ½ and 1.

    64 of them can be multiplied before float32 underflows, and one logarithm is taken where there
    would be 64. The rounding of the product is that of a sum of 64 numbers.

    Args:
        probs: (… n).

    Returns:
        (…).
    """
    whole = probs.shape[-1] // 64 * 64
    products = probs[..., :whole].unflatten(-1, (-1, 64)).prod(-1)
    return products.log().sum(-1) + probs[..., whole:].prod(-1).log()
