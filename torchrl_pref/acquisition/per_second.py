"""What a query is worth for each second of a person's time.

Shapes: B sessions, C candidate queries, M belief samples, R possible answers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

from torchrl_pref.acquisition.functions import Acquisition
from torchrl_pref.errors import check_positive
from torchrl_pref.questions.response_model import Prediction


@dataclass(frozen=True)
class Cost:
    r"""How many seconds a question takes: to watch what is shown, and to decide.

    .. math:: s = watch + decide \cdot (1 + E[H(q \mid \omega)] / \ln R)

    The last term is how undecided the person is, from 0, who is sure, to 1, to whom all answers are
    alike: the nearer options are in value, the longer people take (Konovalov and Krajbich,
    *Revealed strength of preference: inference from response times*, 2019). That it grows as the
    entropy does, and doubles the time at most, is a model of ours and no measurement.

    Args:
        watch: seconds to watch all options of a question; two of five seconds each by default.
        decide: seconds to decide where the answer is clear.

    Raises:
        InputError: one is not above 0.
    """

    watch: float = 10.0
    decide: float = 2.0

    def __post_init__(self) -> None:
        check_positive("watch", self.watch)
        check_positive("decide", self.decide)

    def __call__(self, predicted: Prediction) -> Tensor:
        """Seconds that each question is expected to take (… C)."""
        undecided = predicted.entropy / math.log(predicted.probs.shape[-1])
        return self.watch + self.decide * (1 + undecided.clamp(0, 1))


@dataclass(frozen=True)
class PerSecond:
    """An acquisition function divided by the seconds that a question is expected to take.

    Args:
        acquisition: what a question is worth.
        cost: what it takes.
    """

    acquisition: Acquisition
    cost: Cost = Cost()

    def __call__(self, predicted: Prediction, samples: Tensor) -> Tensor:
        """Its value for each second (… C)."""
        return self.acquisition(predicted, samples) / self.cost(predicted)
