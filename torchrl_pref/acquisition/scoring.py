"""Acquisition functions: what a query is expected to teach, from what the belief predicts.

Shapes: B sessions, C candidate queries, M belief samples, K options per query, R possible answers,
D features, ``…`` any leading dimensions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_pref.acquisition.functions import (
    Acquisition,
    alignment_gain,
    information_gain,
    volume_removal,
)
from torchrl_pref.acquisition.scoring_cpu import compiled_scores
from torchrl_pref.acquisition.scoring_table_cpu import compiled_table_scores
from torchrl_pref.questions.response_model import Prediction, ResponseModel
from torchrl_pref.questions.responses import compiled_constants

CHUNK = 100_000
"""Probabilities (B c M R-1) held at once while candidates are scored: bounds memory, fits the
cache."""


def predict_answers(samples: Tensor, queries: Tensor, response_model: ResponseModel) -> Prediction:
    """What the belief predicts of the answer to each candidate.

    Args:
        samples: (B M D), the belief.
        queries: (B C K D), the candidates.
        response_model: how the belief thinks the human answers.
    """
    if queries.shape[2] == 1:  # no other to lead over
        returns = queries.flatten(1, 2) @ samples.mT
        return response_model.predict_of_returns(returns.unsqueeze(-1))
    return response_model.predict(_leads(samples, queries))


def mean_answers(samples: Tensor, queries: Tensor, response_model: ResponseModel) -> Tensor:
    """How likely each answer to each query is to the belief as a whole, (B C R): the mean of
    :func:`predict_answers` over the samples, in chunks."""

    def part(belief: Tensor, shown: Tensor) -> Tensor:
        if shown.shape[2] == 1:
            return predict_answers(belief, shown, response_model).probs.mean(-2)
        return response_model.mean_answer(_leads(belief, shown))

    return _in_chunks(samples, queries, response_model, part)


def _leads(samples: Tensor, queries: Tensor) -> Tensor:
    """By how much each option's return exceeds that of the last one (B C M K-1)."""
    leads = queries[..., :-1, :] - queries[..., -1:, :]
    # M is the innermost axis in memory, as the sums over it are the bulk of the work.
    return (leads.flatten(1, 2) @ samples.mT).unflatten(1, leads.shape[1:3]).mT


COMPILED: tuple[Acquisition, ...] = (information_gain, alignment_gain, volume_removal)
"""What the compiled loops know, in their order."""


@dataclass(frozen=True)
class Together:
    """Acquisition functions as one of several values (…), so that answers are predicted once."""

    functions: tuple[Acquisition, ...]

    def __call__(self, predicted: Prediction, samples: Tensor) -> Tensor:
        """Their values (B C V)."""
        return torch.stack([function(predicted, samples) for function in self.functions], -1)


def together(*functions: Acquisition) -> Acquisition:
    """Acquisition functions as one of several values (…)."""
    return Together(functions)


def score_queries(
    samples: Tensor,
    queries: Tensor,
    response_model: ResponseModel,
    acquisition: Acquisition,
) -> Tensor:
    """Score every candidate: on the CPU compiled, where model and functions are this package's.

    Args:
        samples: (B M D), the belief.
        queries: (B C K D), the candidates.
        response_model: how the belief thinks the human answers.
        acquisition: what makes the score; it may return several numbers, (B c …).

    Returns:
        (B C …).
    """
    constants = compiled_constants(response_model)
    functions = acquisition.functions if isinstance(acquisition, Together) else (acquisition,)
    known = all(each in COMPILED for each in functions)
    if constants is None or not known or not (_is_plain(samples) and _is_plain(queries)):
        return score_in_tensors(samples, queries, response_model, acquisition)
    if response_model.is_plain:
        scores = compiled_scores(samples, queries, *constants)
    else:
        tables = response_model.tables(queries.shape[2], queries.device)
        model = response_model.scale, *constants, response_model.lapse
        scores = compiled_table_scores(samples, queries, *tables, *model)
    if not isinstance(acquisition, Together):
        return scores[..., COMPILED.index(acquisition)]
    if functions == COMPILED:
        return scores
    return scores[..., [COMPILED.index(each) for each in functions]]


def _is_plain(numbers: Tensor) -> bool:
    """Whether they are float32 on the CPU, and no gradient is asked of them."""
    learns = numbers.requires_grad and torch.is_grad_enabled()
    return numbers.is_cpu and numbers.dtype == torch.float32 and not learns


def score_in_tensors(
    samples: Tensor,
    queries: Tensor,
    response_model: ResponseModel,
    acquisition: Acquisition,
) -> Tensor:
    """:func:`score_queries` for any model, function, device and type, and with gradients."""

    def part(belief: Tensor, shown: Tensor) -> Tensor:
        return acquisition(predict_answers(belief, shown, response_model), belief)

    return _in_chunks(samples, queries, response_model, part)


def _in_chunks(
    samples: Tensor,
    queries: Tensor,
    response_model: ResponseModel,
    part: Callable[[Tensor, Tensor], Tensor],
) -> Tensor:
    """What a function makes of beliefs (B M D) and their queries (B C K D), (B C …).

    Memory stays bounded whatever B, C and M are.
    """
    sessions, candidates = queries.shape[:2]
    n_answers = response_model.n_answers(queries.shape[2])
    fits = max(1, CHUNK // (samples.shape[1] * (n_answers - 1)))
    step = min(fits, candidates)
    group = max(1, fits // step)
    rows = []
    for start in range(0, sessions, group):
        belief, shown = samples[start : start + group], queries[start : start + group]
        parts = [
            part(belief, shown[:, first : first + step]) for first in range(0, candidates, step)
        ]
        rows.append(torch.cat(parts, 1))
    return torch.cat(rows)


def moments_among(scores: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation (B 1 V) of scores (B N V), the latter not below 10⁻⁶."""
    mean = scores.mean(-2, keepdim=True)
    return mean, (scores - mean).square().mean(-2, keepdim=True).sqrt().clamp(min=1e-6)


def standardise(scores: Tensor) -> Tensor:
    """Scores (B C V) less their mean over the C of each session, in standard deviations."""
    mean, deviation = moments_among(scores)
    return (scores - mean) / deviation
