"""Strategies that choose n questions to be asked at once.

Shapes: B sessions, C candidates, P of them that are worth most, M belief samples, K options per
query, D features, n questions asked at once.
"""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from torchrl_pref.acquisition.batch import Select, Shortlist, joint
from torchrl_pref.acquisition.functions import Acquisition, information_gain
from torchrl_pref.acquisition.scoring import predict_answers, score_queries
from torchrl_pref.errors import check_count
from torchrl_pref.questions.response_model import ResponseModel


class BatchOf(TensorDictModuleBase):
    """Ask n allowed candidates that are worth much, chosen so that they ask different things.

    Nothing is drawn: the same session is asked the same.

    Args:
        response_model: how the belief thinks the human answers.
        batch: n; as many candidates are expected to be allowed.
        select: chooses n of the best candidates, see ``acquisition.batch.BATCHES``.
        acquisition: what a candidate is worth by itself; information gain by default.
        shortlist: P/n, how many of the best candidates are chosen from for each that is asked. 20
            is that of the literature.
    """

    in_keys = ["samples", "queries", "action_mask"]
    out_keys = ["action"]

    def __init__(
        self,
        response_model: ResponseModel,
        batch: int,
        select: Select = joint,
        acquisition: Acquisition = information_gain,
        shortlist: int = 20,
    ) -> None:
        super().__init__()
        self.response_model = response_model
        self.batch = check_count("batch", batch, 1)
        self.select, self.acquisition = select, acquisition
        self.shortlist = check_count("shortlist", shortlist, 1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B n)."""
        samples, queries, mask = (tensordict[key] for key in self.in_keys)
        values = score_queries(samples, queries, self.response_model, self.acquisition)
        values, order = values.masked_fill(~mask, -math.inf).sort(
            dim=-1, descending=True, stable=True
        )
        threshold = threshold_of(self.response_model) if queries.shape[2] == 1 else 0.0
        length = min(self.shortlist * self.batch, order.shape[1])
        actions = []
        # One session at a time: what is chosen next depends on what was chosen before.
        for b, allowed in enumerate(mask.sum(-1).tolist()):
            best = order[b, : min(length, allowed)]
            shown = queries[b, best]
            predicted = predict_answers(samples[b : b + 1], shown.unsqueeze(0), self.response_model)
            told = values[b, : len(best)], shown, predicted.probs[0], threshold
            actions.append(best[self.select(Shortlist(*told), self.batch)])
        return tensordict.set("action", torch.stack(actions))


def threshold_of(response_model: ResponseModel) -> float:
    """The return that one option has to exceed, of a question whether it is good."""
    (_, offsets, _), _ = response_model.tables(1, torch.device("cpu"))
    return float(offsets[offsets.isfinite()].abs().max()) / response_model.scale
