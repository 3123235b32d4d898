"""Acquisition functions: what a query is expected to teach, from what the belief predicts.

Shapes: B sessions, C candidate queries, M belief samples, R possible answers, D features, ``…`` any
leading dimensions.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchrl_pref.questions.response_model import Prediction
from torchrl_pref.tensors import directions

Acquisition = Callable[[Prediction, Tensor], Tensor]
"""From what M belief samples (B M D) predict of the answers to C candidates to values (B C …)."""


def information_gain(predicted: Prediction, samples: Tensor) -> Tensor:
    r"""Mutual information between the answer and ω, in bits (the paper's section 3.3).

    .. math:: r = \frac{1}{M} \sum_{q_i \in Q} \sum_{\omega \in \Omega} P(q_i \mid Q, \omega)
        \log_2 \frac{M \, P(q_i \mid Q, \omega)}{\sum_{\omega'} P(q_i \mid Q, \omega')}

    It is computed as the entropy of the mean answer less the mean entropy of the answer, which is
    the same sum without a quotient of probabilities that may both underflow.

    Args:
        predicted: of the answers to C candidates, under M samples.
        samples: (… M D), the belief samples; not needed here.

    Returns:
        (… C), between 0 (all samples agree) and log2 R.
    """
    of_mean = torch.special.entr(predicted.probs.mean(-2)).sum(-1)
    highest = math.log2(predicted.probs.shape[-1])
    return ((of_mean - predicted.entropy) / math.log(2)).clamp(0, highest)


def volume_removal(predicted: Prediction, samples: Tensor) -> Tensor:
    r"""Expected share of the belief that the answer removes, :math:`1 - \sum_q \bar p_q^2`.

    Sadigh, Dragan, Sastry and Seshia, *Active preference-based learning of reward functions*,
    2017.

    Args:
        predicted: of the answers to C candidates, under M samples.
        samples: (… M D), the belief samples; not needed here.

    Returns:
        (… C), between 0 and 1 - 1/R. It is not 0 where options are alike, and even greatest there:
        it is about how uncertain the answer is, be it for want of knowledge or by chance.
    """
    return 1 - predicted.probs.mean(-2).square().sum(-1)


def least_confidence(predicted: Prediction, samples: Tensor) -> Tensor:
    r"""How likely the likeliest answer is not to be given, :math:`1 - \max_q \bar p_q`.

    Lewis and Gale, *A sequential algorithm for training text classifiers*, 1994; Culotta and
    McCallum, *Reducing labeling effort for structured prediction tasks*, 2005.

    Args:
        predicted: of the answers to C candidates, under M samples.
        samples: (… M D), the belief samples; not needed here.

    Returns:
        (… C), between 0 and 1 - 1/R. As volume removal, it is not 0 where options are alike, and
        even greatest there.
    """
    return 1 - predicted.probs.mean(-2).amax(-1)


def alignment_gain(predicted: Prediction, samples: Tensor) -> Tensor:
    r"""How much an answer is expected to add to the squared length of the mean belief.

    .. math:: \sum_q P(q) \, \lVert E[\omega \mid q] \rVert^2 - \lVert E[\omega] \rVert^2
        = \sum_q P(q) \, \lVert E[\omega \mid q] - E[\omega] \rVert^2

    ω is the direction of a sample. :math:`\lVert E[\omega] \rVert^2` is what the belief itself
    expects of its alignment (the mean cosine between its samples and the human's ω).

    Args:
        predicted: of the answers to C candidates, under M samples.
        samples: (… M D), the belief samples.

    Returns:
        (… C), from 0 to 1 - ‖E[ω]‖².
    """
    samples = directions(samples)
    # About the mean: a small gain would drown in the rounding of two squares near 1.
    centred = samples - samples.mean(-2, keepdim=True)
    moved = torch.einsum("...md,...cmr->...cdr", centred, predicted.probs) / samples.shape[-2]
    return (moved.square().sum(-2) / predicted.probs.mean(-2).clamp(min=1e-30)).sum(-1)
