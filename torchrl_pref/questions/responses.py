"""Response models: how likely each answer to a query is, given the returns of its options.

Shapes: K options, R possible answers (here R = K), ``…`` any leading dimensions.

A response model is the one place where a likelihood is written. The belief, the acquisition
functions, the simulated humans and the calibration of ``tau`` all call it.

``tau`` *multiplies* the returns (it is an inverse temperature, also called rationality): a large
``tau`` means a careful human. Other libraries divide by it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, NamedTuple, final

import torch
from torch import Tensor
from torch.nn import functional as F

from torchrl_pref.errors import InputError, check_not_negative, check_positive
from torchrl_pref.tensors import check_finite, check_plain

MAX_TAU = 1e30
"""Larger and a product with a return is beyond float32; 10⁶ is an optimal user already."""


class Prediction(NamedTuple):
    """What M samples of the weights predict of the answer to a query."""

    probs: Tensor
    """(… M R), probability of each answer under each sample."""
    entropy: Tensor
    """(…), entropy of the answer in nats, averaged over the samples."""


class ResponseModel(ABC):
    """The probability of an answer. It sees returns only, so it serves any task and any D."""

    @abstractmethod
    def log_likelihood(self, gaps: Tensor) -> Tensor:
        """Log-probability that an option is chosen.

        Args:
            gaps: (… K-1), by how much the option's return exceeds that of each other option.

        Returns:
            (…), natural logarithm.
        """

    def joint_log_likelihood(self, gaps: Tensor) -> Tensor:
        """Log-probability of a whole history of answers.

        Args:
            gaps: (… H K-1), as in :meth:`log_likelihood`.

        Returns:
            (…), natural logarithm.
        """
        return self.log_likelihood(gaps).sum(-1)

    def agrees(self, gaps: Tensor) -> Tensor:
        """Whether the choice of an option is possible, other than as a tie of options that differ.

        Args:
            gaps: (… K-1), as in :meth:`log_likelihood`.

        Returns:
            (…) bool.
        """
        return self.log_likelihood(gaps) > -math.inf

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

    def __call__(self, returns: Tensor) -> Tensor:
        """Log-probability of each answer.

        Args:
            returns: (… K), the return of each option.

        Returns:
            (… R), natural logarithm; each row's exponentials sum to one.
        """
        columns = returns.unbind(-1)
        log_probs = []
        for k, chosen in enumerate(columns):
            others = [chosen - other for j, other in enumerate(columns) if j != k]
            log_probs.append(self.log_likelihood(torch.stack(others, -1)))
        # Answers outermost in memory: what follows reduces over samples, one answer at a time.
        return torch.stack(log_probs).movedim(0, -1)

    def predict(self, leads: Tensor) -> Prediction:
        """What M samples of the weights predict of the answer.

        Args:
            leads: (… M K-1), by how much the return of each option exceeds that of the last one,
                under each sample.
        """
        columns = leads.unbind(-1)
        log_probs = self(torch.stack([*columns, torch.zeros_like(columns[0])]).movedim(0, -1))
        probs = log_probs.exp()
        # The clamp keeps 0 · log 0 from being NaN; it changes no product that float32 can hold.
        entropy = -(probs * log_probs.clamp(min=-1e4)).mean(-2).sum(-1)
        return Prediction(probs, entropy)


@final
class Boltzmann(ResponseModel):
    r"""The paper's noisily rational human (section 3.2).

    .. math:: P(q = \xi_i \mid Q, \omega) =
        \frac{\exp \tau R(\xi_i)}{\sum_{\xi \in Q} \exp \tau R(\xi)}

    Args:
        tau: what the returns are multiplied by; above 0. Larger is less noisy.

    Raises:
        InputError: ``tau`` is not a finite number above zero, or beyond float32.
    """

    def __init_subclass__(cls, **_: Any) -> None:
        _refuse_subclass(cls, Boltzmann)

    def __init__(self, tau: float) -> None:
        self.tau = check_positive("tau", tau)
        if self.tau > MAX_TAU:
            raise InputError(f"tau={tau!r}: expected at most {MAX_TAU:g}; use Optimal() instead")

    def log_likelihood(self, gaps: Tensor) -> Tensor:
        """See :meth:`ResponseModel.log_likelihood`."""
        if gaps.shape[-1] == 1:
            return F.logsigmoid(self.tau * gaps.squeeze(-1))
        return -torch.logsumexp(F.pad(-self.tau * gaps, (1, 0)), -1)

    def joint_log_likelihood(self, gaps: Tensor) -> Tensor:
        """See :meth:`ResponseModel.joint_log_likelihood`."""
        if gaps.shape[-1] > 1:
            return super().joint_log_likelihood(gaps)
        # log σ(z) = min(z, 0) + log σ(|z|)
        logit = self.tau * gaps.squeeze(-1)
        return logit.clamp(max=0).sum(-1) + sum_of_logs(logit.abs().sigmoid_())

    def __call__(self, returns: Tensor) -> Tensor:
        """See :meth:`ResponseModel.__call__`."""
        if returns.shape[-1] == 2:
            return super().__call__(returns)
        # The same for all K options at once, in K exponentials and not K².
        return torch.log_softmax(self.tau * returns.movedim(-1, 0), 0).movedim(0, -1)

    def predict(self, leads: Tensor) -> Prediction:
        """See :meth:`ResponseModel.predict`."""
        if leads.shape[-1] > 1:
            return super().predict(leads)
        # With q the probability of the less likely answer and z the logit, the entropy is
        # |z| q - log(1 - q): no logarithm of each sample, and no term that can cancel another.
        logit = self.tau * leads.squeeze(-1)
        first = torch.sigmoid(logit)
        second = 1 - first
        probs = torch.stack([first, second]).movedim(0, -1)
        unlikely, likely = torch.minimum(first, second), torch.maximum(first, second)
        entropy = logit.abs_().mul_(unlikely).mean(-1) - sum_of_logs(likely) / logit.shape[-1]
        return Prediction(probs, entropy)

    def __repr__(self) -> str:
        return f"Boltzmann(tau={self.tau:g})"


@final
class Optimal(ResponseModel):
    """The paper's optimal user, the limit of ``Boltzmann`` as tau grows: argmax, ties uniform.

    Args:
        tolerance: gaps this small count as ties. It absorbs the rounding of float32 returns, so a
            belief never excludes the very human who answered. In the units of the return.

    Raises:
        InputError: ``tolerance`` is not a finite number of at least zero.
    """

    def __init_subclass__(cls, **_: Any) -> None:
        _refuse_subclass(cls, Optimal)

    def __init__(self, tolerance: float = 1e-6) -> None:
        self.tolerance = check_not_negative("tolerance", tolerance)

    def log_likelihood(self, gaps: Tensor) -> Tensor:
        """See :meth:`ResponseModel.log_likelihood`."""
        ties = 1 + (gaps.abs() <= self.tolerance).sum(-1)
        beaten = (gaps < -self.tolerance).any(-1)
        return torch.where(beaten, -math.inf, -ties.to(gaps.dtype).log())

    def agrees(self, gaps: Tensor) -> Tensor:
        """See :meth:`ResponseModel.agrees`: two that differ are never quite equal."""
        return (gaps > self.tolerance).all(-1)

    def possible_arc(self, cosine: Tensor, sine: Tensor, raised: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`ResponseModel.possible_arc`."""
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
        if leads.shape[-1] > 1:
            return super().predict(leads)
        winner = F.hardshrink(leads.squeeze(-1), self.tolerance).sign()  # 1, -1, or 0 for a tie
        entropy = math.log(2) * (1 - winner.abs().mean(-1))
        return Prediction(torch.stack([winner + 1, 1 - winner]).movedim(0, -1) / 2, entropy)

    def __repr__(self) -> str:
        return "Optimal()"


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


def calibrate_tau(returns: Tensor, target: float = 0.9) -> float:
    """The tau at which the best option is picked with probability ``target`` on average.

    This is what "noisy user (90%)" of the paper's Figure 1 is taken to mean.

    Args:
        returns: (… K), returns of the options of the training pool under humans of the prior.
        target: mean probability of the best option, above 1/K and below 1.

    Raises:
        InputError: the returns are no finite numbers of K ≥ 2 options, or no tau up to 10⁶ reaches
            the target (most options tie).
    """
    check_plain("returns", returns)
    if returns.ndim < 1 or returns.shape[-1] < 2 or not returns.numel():
        raise InputError(
            f"returns of shape {tuple(returns.shape)}: expected (… K), at least one row of at "
            "least 2 options"
        )
    check_finite("returns", returns.to(torch.float32))
    gaps = (returns.amax(-1, keepdim=True) - returns).sort(-1).values[..., 1:]

    def accuracy(tau: float) -> float:
        return Boltzmann(tau).log_likelihood(gaps).exp().mean(dtype=torch.float64).item()

    low, high = 1e-6, 1e6
    if not accuracy(low) < target < accuracy(high):
        raise InputError(
            f"an accuracy of {target} cannot be reached: tau between {low:g} and {high:g} gives "
            f"{accuracy(low):.3f} to {accuracy(high):.3f}; give tau as a number"
        )
    while high / low > 1 + 1e-6:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if accuracy(middle) < target else (low, middle)
    return math.sqrt(low * high)
