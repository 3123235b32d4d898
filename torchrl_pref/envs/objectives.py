"""Objectives: what a policy is rewarded for.

Shapes: B sessions, M belief samples, K options per query, D features.

An objective names a quantity of a session, its *potential*, and a step is worth what it adds to it:
the undiscounted sum of the rewards is the potential of the last belief less that of the first.
Its *forecast* is what asking a query is expected to add, before the answer is known.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_pref.acquisition.functions import alignment_gain, information_gain
from torchrl_pref.acquisition.scoring import predict_answers, score_queries
from torchrl_pref.errors import check_choice
from torchrl_pref.questions.responses import ResponseModel

Session: TypeAlias = TensorDictBase | Mapping[str, Any]


class Objective(ABC):
    """A quantity of a session that a policy is to raise."""

    @abstractmethod
    def potential(self, session: Session) -> Tensor:
        """What there is of it in a session, (B 1)."""

    @abstractmethod
    def forecast(
        self, session: TensorDictBase, queries: Tensor, response_model: ResponseModel
    ) -> Tensor:
        """What asking each of the queries (B C K D) is expected to add, (B C)."""


class InformationGain(Objective):
    """The paper's: the sum of the information gains of the asked queries, in bits (section 3.3)."""

    def potential(self, session: Session) -> Tensor:
        """See :meth:`Objective.potential`."""
        return session["metrics"]["information"]

    def forecast(
        self, session: TensorDictBase, queries: Tensor, response_model: ResponseModel
    ) -> Tensor:
        """See :meth:`Objective.forecast`."""
        return score_queries(session["samples"], queries, response_model, information_gain)


class Alignment(Objective):
    """The length of the mean belief squared: the alignment that the belief itself expects.

    For unit ω, E‖ω̄‖² over the humans that a belief describes is their mean alignment, so this has
    its expectation without the noise of the one hidden ω.
    """

    def potential(self, session: Session) -> Tensor:
        """See :meth:`Objective.potential`."""
        return session["mean"].square().sum(-1, keepdim=True)

    def forecast(
        self, session: TensorDictBase, queries: Tensor, response_model: ResponseModel
    ) -> Tensor:
        """See :meth:`Objective.forecast`."""
        return score_queries(session["samples"], queries, response_model, alignment_gain)


class TrueAlignment(Objective):
    """The paper's alignment with the simulated human's own ω, which only a simulator knows."""

    def potential(self, session: Session) -> Tensor:
        """See :meth:`Objective.potential`."""
        return session["metrics"]["alignment"]

    def forecast(
        self, session: TensorDictBase, queries: Tensor, response_model: ResponseModel
    ) -> Tensor:
        """See :meth:`Objective.forecast`."""
        samples, omega = session["samples"], session["human", "omega"].unsqueeze(1)
        cosines = (samples @ omega.mT).unsqueeze(1)
        probs = predict_answers(samples, queries, response_model).probs
        after = (probs * cosines).sum(-2) / probs.sum(-2).clamp(min=1e-30)
        answers = predict_answers(omega, queries, response_model).probs.squeeze(-2)
        return (answers * after).sum(-1) - self.potential(session)


class Entropy(Objective):
    """What the belief has lost of its entropy, in bits, up to a constant.

    By the distance of each sample to its third nearest (Kozachenko and Leonenko, 1987), which needs
    no shape of the belief: on the sphere, D-1 bits for every halving of the distances.
    """

    def potential(self, session: Session) -> Tensor:
        """See :meth:`Objective.potential`."""
        samples = session["samples"]
        nearest = (
            torch.cdist(samples, samples, compute_mode="donot_use_mm_for_euclid_dist")
            .topk(4, largest=False)
            .values[..., -1]
        )
        bits = nearest.clamp(min=1e-7).log2().mean(-1, keepdim=True)
        return -(samples.shape[-1] - 1) * bits

    def forecast(
        self, session: TensorDictBase, queries: Tensor, response_model: ResponseModel
    ) -> Tensor:
        """The expected loss of entropy is the information gain."""
        return score_queries(session["samples"], queries, response_model, information_gain)


OBJECTIVES: dict[str, Objective] = {
    "information_gain": InformationGain(),
    "alignment": Alignment(),
    "true_alignment": TrueAlignment(),
    "entropy": Entropy(),
}


def make_objective(name: str) -> Objective:
    """The objective of that name.

    Raises:
        InputError: there is none.
    """
    return OBJECTIVES[check_choice("objective", name, tuple(OBJECTIVES))]
