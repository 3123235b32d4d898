"""Objectives: what a policy is rewarded for.

Shapes: B sessions, M belief samples, K options per query, D features.

An objective names a quantity of a session, its *potential*, and a step is worth what it adds to it:
the undiscounted sum of the rewards is the potential of the last belief less that of the first.
Its *forecast* is what asking a query is expected to add, before the answer is known.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from torchrl_pref.acquisition.functions import Acquisition, alignment_gain, information_gain
from torchrl_pref.acquisition.scoring import predict_answers, score_queries
from torchrl_pref.envs.transition import SessionState
from torchrl_pref.errors import InputError, check_choice
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.tensors import directions


def alignment(samples: Tensor, omega: Tensor) -> Tensor:
    """The paper's alignment (… 1): mean over samples (… M D) of the cosine with weights (… D).

    Only who knows the human can tell it: it is no part of a session, and no observation.
    """
    return F.cosine_similarity(samples, omega.unsqueeze(-2), dim=-1).mean(-1, keepdim=True)


def alignment_of_mean(samples: Tensor, omega: Tensor) -> Tensor:
    """The cosine (… 1) of the mean direction of samples (… M D) with weights (… D)."""
    return F.cosine_similarity(directions(samples).mean(-2), omega, dim=-1).unsqueeze(-1)


class Objective(ABC):
    """A quantity of a session that a policy is to raise.

    A session is what ``tell`` makes of it, and its human has at least ``omega`` (B D).

    Attributes:
        acquisition: what an answer is expected to add to it, where the belief alone can tell.
    """

    acquisition: Acquisition = staticmethod(information_gain)

    @abstractmethod
    def potential(self, session: SessionState, human: Mapping[str, Any]) -> Tensor:
        """What there is of it in a session, (B 1)."""

    def forecast(
        self,
        session: SessionState,
        human: Mapping[str, Any],
        queries: Tensor,
        response_model: ResponseModel,
    ) -> Tensor:
        """What asking each of the queries (B C K D) is expected to add, (B C)."""
        return score_queries(session["samples"], queries, response_model, self.acquisition)

    def gained(self, before: SessionState, after: SessionState, human: Mapping[str, Any]) -> Tensor:
        """What there is more of it after than before, (B 1)."""
        return self.potential(after, human) - self.potential(before, human)


class InformationGain(Objective):
    """The paper's: the sum of the information gains of the asked queries, in bits (section 3.3)."""

    def potential(self, session: SessionState, human: Mapping[str, Any]) -> Tensor:
        """See :meth:`Objective.potential`."""
        return session["information"]


class Alignment(Objective):
    """The length of the mean belief squared: the alignment that the belief itself expects.

    E‖ω̄‖² over the humans that a belief describes is their mean alignment, so this has its
    expectation without the noise of the one hidden ω; but for the luck of M samples, which adds
    (1 - ‖E ω‖²) / M.
    """

    acquisition = staticmethod(alignment_gain)

    def potential(self, session: SessionState, human: Mapping[str, Any]) -> Tensor:
        """See :meth:`Objective.potential`."""
        return session["mean"].square().sum(-1, keepdim=True)


class TrueAlignment(Objective):
    """The paper's alignment with the simulated human's own ω, which only a simulator knows."""

    def potential(self, session: SessionState, human: Mapping[str, Any]) -> Tensor:
        """See :meth:`Objective.potential`."""
        return alignment(session["samples"], human["omega"])

    def forecast(
        self,
        session: SessionState,
        human: Mapping[str, Any],
        queries: Tensor,
        response_model: ResponseModel,
    ) -> Tensor:
        """See :meth:`Objective.forecast`."""
        samples, omega = session["samples"], human["omega"].unsqueeze(1)
        cosines = (directions(samples) @ omega.mT).unsqueeze(1)
        probs = predict_answers(samples, queries, response_model).probs
        after = (probs * cosines).sum(-2) / probs.sum(-2).clamp(min=1e-30)
        answers = predict_answers(omega, queries, response_model).probs.squeeze(-2)
        return (answers * after).sum(-1) - self.potential(session, human)


class Entropy(Objective):
    """What the belief has lost of its entropy, in bits, up to a constant.

    By the distance of each sample to its third nearest (Kozachenko and Leonenko, 1987), which needs
    no shape of the belief: on the sphere, D-1 bits for every halving of the distances. Its expected
    loss is the information gain, where the belief infers ω alone: the gain of one that infers tau
    too (``belief=rationality``) counts what is learned of tau, and the entropy here does not.
    """

    def potential(self, session: SessionState, human: Mapping[str, Any]) -> Tensor:
        """See :meth:`Objective.potential`."""
        samples = directions(session["samples"])
        if samples.shape[1] < 4:  # of a belief of the user's: the package's have more
            raise InputError(
                f"objective=entropy with {samples.shape[1]} samples: expected at least 4, as the "
                "entropy is told by the third nearest sample; raise belief.samples"
            )
        nearest = (
            torch.cdist(samples, samples, compute_mode="donot_use_mm_for_euclid_dist")
            .topk(4, largest=False)
            .values[..., -1]
        )
        bits = nearest.clamp(min=1e-7).log2().mean(-1, keepdim=True)
        return -(samples.shape[-1] - 1) * bits


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
