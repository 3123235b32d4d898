"""What every response model is: how likely each answer is, given the returns of the options.

Shapes: K options, R possible answers, H answers given, F factors of an answer, J rows of a factor,
D features, ``…`` any leading dimensions.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrl_pref.questions.base import (
    Answers,
    Evidence,
    Factors,
    Question,
    answers_on,
    factors_on,
    rows_of,
)
from torchrl_pref.questions.choice import Choice


class Prediction(NamedTuple):
    """What M samples of the weights predict of the answer to a query."""

    probs: Tensor
    """(… M R), probability of each answer under each sample."""
    entropy: Tensor
    """(…), entropy of the answer in nats, averaged over the samples."""
    leads: Tensor
    """(… M K-1), by how much the return of each option exceeds that of the last one, under each
    sample; of a single option (… M 1), its return."""

    @property
    def returns(self) -> Tensor:
        """(… M K) under each sample, the last option's set to 0; a single option has beside it what
        would have a return of 0, (… M 2)."""
        return F.pad(self.leads, (0, 1))


class ResponseModel(ABC):
    """How a person answers: the kind of question, and how likely each answer is.

    It sees returns only, so it serves any task and any D. Whoever derives from it says by
    ``log_likelihood`` how the noise works.

    Attributes:
        question: what can be answered; a choice of one option where nothing else is said.
        lapse: probability of an answer at random, whatever the returns are.
        scale: what a return of 1 is in logits, the unit of a question's offsets.
    """

    question: Question = Choice()
    lapse: float = 0.0
    scale: float = 1.0

    @abstractmethod
    def log_likelihood(self, gaps: Tensor) -> Tensor:
        """Log-probability of one factor of an answer: that something is preferred to J others.

        Args:
            gaps: (… J), by how much its return exceeds each of theirs.

        Returns:
            (…), natural logarithm.
        """

    def evidence(self, options: Tensor, answers: Tensor) -> Evidence:
        """What answers say of ω.

        Args:
            options: (… K D), features of the options of each query.
            answers: (…), index of the answer among the R of the question, -1 where there is none.

        Raises:
            InputError: an answer is no whole number from -1 to R-1.
        """
        rows, offsets, answers = rows_of(self.question, options, answers)
        floor = torch.zeros_like(answers, dtype=rows.dtype)
        if self.lapse:
            table = self._answers(options.shape[-2], options.device)
            share = self.lapse / (1 - self.lapse) / len(table.labels)
            floor = share * (-table.log_weights[answers.clamp(min=0)]).exp()
            floor = floor * (answers >= 0)  # no answer is none by mistake either
        return Evidence(rows, offsets / self.scale, floor)

    def answer_log_likelihood(self, gaps: Tensor, floor: Tensor) -> Tensor:
        """Log-probability of an answer, up to a number that does not depend on ω.

        Args:
            gaps: (… F J), of its factors, raised by their offsets.
            floor: (…), see :class:`Evidence`.

        Returns:
            (…), natural logarithm.
        """
        product = self.log_likelihood(gaps).sum(-1)
        return torch.logaddexp(product, floor.log()) if self.lapse else product

    def joint_log_likelihood(self, gaps: Tensor, floor: Tensor) -> Tensor:
        """Log-probability of a whole history of answers, up to a number that does not depend on ω.

        Args:
            gaps: (… H F J), of the factors of the answers, raised by their offsets.
            floor: (… H), see :class:`Evidence`.

        Returns:
            (…), natural logarithm.
        """
        return self.answer_log_likelihood(gaps, floor).sum(-1)

    def agrees(self, gaps: Tensor) -> Tensor:
        """Whether an answer is possible, other than as a tie of options that differ.

        Args:
            gaps: (… F J), of its factors.

        Returns:
            (…) bool.
        """
        return (self.log_likelihood(gaps) > -math.inf).all(-1)

    def possible_arc(self, cosine: Tensor, sine: Tensor, raised: Tensor) -> tuple[Tensor, Tensor]:
        """Ends of the arc around the angle 0 outside of which some answer is impossible.

        Args:
            cosine, sine, raised: (G …); at the angle θ the gaps of all answers are
                cosine · cos θ + sine · sin θ + raised, and at 0 each answer is possible.

        Returns:
            (…) and (…), infinite where no answer is impossible.
        """
        end = torch.full_like(cosine[0], math.inf)
        return -end, end

    def n_answers(self, n_options: int) -> int:
        """R, how many answers there are to a query of K options."""
        return len(self._answers(n_options, torch.device("cpu")).labels)

    @property
    def is_soft(self) -> bool:
        """Whether every answer is possible, however bad."""
        return True

    @property
    def is_plain(self) -> bool:
        """Whether the question is a choice, answered without lapses: closed forms are for this."""
        return not self.lapse and type(self.question) is Choice

    def __repr__(self) -> str:
        numbers = ", ".join(f"{name}={value}" for name, value in vars(self).items())
        return f"{type(self).__name__}({numbers})"

    def __call__(self, returns: Tensor) -> Tensor:
        """Log-probability of each answer.

        Args:
            returns: (… K), the return of each option.

        Returns:
            (… R), natural logarithm; each row's exponentials sum to one.
        """
        n_options, device = returns.shape[-1], returns.device
        (contrasts, offsets, of_answer), log_weights = self.tables(n_options, device)
        rows = (returns @ contrasts.flatten(0, 1).mT.to(returns)).unflatten(-1, offsets.shape)
        # Answers outermost in memory: what follows reduces over samples, one answer at a time.
        factors = self.log_likelihood(rows + offsets / self.scale).movedim(-1, 0).contiguous()
        likely = factors[of_answer[:, 0]]
        for factor in of_answer.unbind(1)[1:]:
            likely += factors[factor]
        likely += log_weights.view(-1, *(1,) * (likely.ndim - 1)).to(likely)
        if self.lapse:
            at_random = torch.full_like(likely, math.log(self.lapse / len(likely)))
            likely = torch.logaddexp(likely + math.log1p(-self.lapse), at_random)
        return likely.movedim(0, -1)

    def predict(self, leads: Tensor) -> Prediction:
        """What M samples of the weights predict of the answer to a query of K ≥ 2 options.

        Args:
            leads: (… M K-1), by how much the return of each option exceeds that of the last one,
                under each sample.
        """
        columns = leads.unbind(-1)
        returns = torch.stack([*columns, torch.zeros_like(columns[0])]).movedim(0, -1)
        return self.predict_of_returns(returns)

    def mean_answer(self, leads: Tensor) -> Tensor:
        """How likely each answer to a query of K ≥ 2 options is to M samples as a whole, (… R): the
        mean of the probabilities that :meth:`predict` gives, without their entropy.

        Args:
            leads: (… M K-1), see :meth:`predict`.
        """
        return self.predict(leads).probs.mean(-2)

    def predict_of_returns(self, returns: Tensor) -> Prediction:
        """What M samples of the weights predict of the answer.

        Args:
            returns: (… M K), of each option under each sample.
        """
        log_probs = self(returns)
        probs = log_probs.exp()
        # The clamp keeps 0 · log 0 from being NaN; it changes no product that float32 can hold.
        entropy = -(probs * log_probs.clamp(min=-1e4)).mean(-2).sum(-1)
        leads = returns[..., :-1] - returns[..., -1:] if returns.shape[-1] > 1 else returns
        return Prediction(probs, entropy, leads)

    def tables(self, n_options: int, device: torch.device) -> tuple[Factors, Tensor]:
        """The factors of the answers to a query of K options, and their log-weights (R)."""
        log_weights = self._answers(n_options, device).log_weights
        return factors_on(self.question, n_options, device), log_weights

    def _answers(self, n_options: int, device: torch.device) -> Answers:
        return answers_on(self.question, n_options, device)
