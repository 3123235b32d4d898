"""The belief as features become many: effective size and time after each of 100 greedy questions.

``python benchmarks/dimension.py [--features 2,4,8,16,32] [--questions 100]``. Many beliefs follow
one human with isotropic features, who is asked the question of highest information gain of 1000
drawn anew each time. The effective size is measured, as the variance of the samples over that of
their mean between beliefs, and told beside what the belief reports of itself.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder's select.py hides Python's

import torch
from torch import Generator, Tensor
from tqdm import tqdm

from benchmarks import common
from torchrl_pref.acquisition.functions import information_gain
from torchrl_pref.acquisition.scoring import score_queries
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann, Optimal


def main() -> None:
    """Print the table."""
    parser = common.arguments(__doc__)
    parser.add_argument("--features", default="2,4,8,16,32", help="numbers of features D")
    parser.add_argument("--questions", type=int, default=100)
    parser.add_argument("--beliefs", type=int, default=100, help="that the size is measured over")
    options = common.start(parser)
    rows = []
    for size in map(int, options.features.split(",")):
        for model in (Boltzmann(common.TAU), Optimal()):
            rows.append(follow(size, model, options.questions, options.beliefs))
    common.report("Effective size of 100 samples, greedy questions", rows, options.json)


def follow(n_features: int, model: ResponseModel, questions: int, beliefs: int) -> common.Row:
    """One human's answers, many beliefs."""

    def greedy(samples: Tensor, generator: Generator) -> Tensor:
        pool = torch.randn(1000, 2, n_features, generator=generator)
        values = score_queries(samples, pool[None], model, information_gain)
        return pool[int(values.argmax())]

    bar = tqdm([greedy] * questions, desc=f"D={n_features}, {model}", unit="question")
    measured, reported, seconds, alignment = common.follow(model, n_features, beliefs, bar)
    return {
        "D": n_features,
        "human": "soft" if isinstance(model, Boltzmann) else "hard",
        "questions": questions,
        "least ESS": round(min(measured)),
        "mean ESS": round(sum(measured) / len(measured)),
        "least reported": round(min(reported)),
        "mean reported": round(sum(reported) / len(reported)),
        "reported over measured, largest": max(
            told / true for told, true in zip(reported, measured, strict=True) if true < 95
        )
        if min(measured) < 95
        else 1.0,
        "ms an update": 1000 * seconds / questions / beliefs,
        "alignment": alignment,
    }


if __name__ == "__main__":
    main()
