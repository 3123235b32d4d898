"""The Gaussian belief beside the samples, and what an update costs with hundreds of features.

``python benchmarks/laplace.py [--humans 300] [--json FILE]``. Humans answer random questions about
independent normal features, and both beliefs get the same answers. *Coverage* is how often the
human's return of a random trajectory lies in the central interval that holds 80% of the belief;
*expected* and *found* are the alignment that a belief expects of itself, and has.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder's select.py hides Python's

from functools import partial

import torch
from torch import Generator, Tensor

from benchmarks import common
from torchrl_pref.beliefs.base import BeliefBase
from torchrl_pref.beliefs.laplace import LaplaceBelief
from torchrl_pref.beliefs.sampled import Belief, uniform_sphere
from torchrl_pref.questions.base import Evidence
from torchrl_pref.questions.responses import Boltzmann

TAU = 2.0
CASES = ((4, 5), (4, 20), (8, 5), (8, 20), (16, 20), (16, 40))
"""Features and answers."""

LARGE = ((128, 50), (512, 50), (512, 200), (2048, 200))
"""The same, where only the Gaussian belief goes."""


def main() -> None:
    """Print both tables."""
    parser = common.arguments(__doc__)
    parser.add_argument("--humans", type=int, default=300, help="of each case (default 300)")
    options = common.start(parser)
    model, rows = Boltzmann(TAU), []
    for n_features, n_answers in CASES:
        omega, evidence = asked(model, options.humans, n_features, n_answers)
        for belief in (Belief(model), LaplaceBelief(model)):
            samples = after(belief, evidence, n_features)
            kind = "laplace" if isinstance(belief, LaplaceBelief) else "sampled"
            row = {"D": n_features, "answers": n_answers, "belief": kind}
            rows.append({**row, **judged(samples, omega)})
    common.report(f"Random questions, tau {TAU}, {options.humans} humans", rows, options.json)
    costs = []
    for n_features, n_answers in LARGE:
        omega, evidence = asked(model, 1, n_features, n_answers)
        belief = LaplaceBelief(model)
        update = partial(after, belief, evidence, n_features)
        seconds = common.paired({"update": update}, options.repeats)["update"]
        cosine = torch.cosine_similarity(update().mean(1), omega).mean()
        cost = {"D": n_features, "answers": n_answers, "ms an update": 1e3 * seconds}
        costs.append({**cost, "cosine of the mean": float(cosine)})
    title = "The Gaussian belief, one session"
    common.report(title, costs, common.second(options.json, "cost"))


def asked(
    model: Boltzmann, humans: int, n_features: int, n_answers: int
) -> tuple[Tensor, Evidence]:
    """Weights (S D), and what answers (S H) to random questions say of them."""
    generator = Generator().manual_seed(0)
    omega = uniform_sphere((humans, n_features), generator)
    options = torch.randn(humans, n_answers, 2, n_features, generator=generator)
    chances = model((options @ omega[:, None, :, None]).squeeze(-1)).exp().flatten(0, 1)
    answers = chances.multinomial(1, generator=generator).view(humans, n_answers)
    return omega, model.evidence(options, answers)


def after(belief: BeliefBase, evidence: Evidence, n_features: int) -> Tensor:
    """Samples (S M D) after the evidence (S H): of samples answer by answer."""
    generator = Generator().manual_seed(1)
    size, n_answers = evidence.floor.shape
    samples = belief.prior(size, n_features, generator)
    ess = torch.full((size,), float(belief.n_samples))
    first = n_answers if isinstance(belief, LaplaceBelief) else 1
    for h in range(first, n_answers + 1):
        samples, ess, _ = belief.update(samples, ess, evidence[:, :h], generator)
    return samples


def judged(samples: Tensor, omega: Tensor) -> common.Row:
    """How samples (S M D) do for humans (S D)."""
    mean = samples.mean(1)
    shown = torch.randn(*omega.shape, 20, generator=Generator().manual_seed(2))
    low, high = torch.quantile(samples @ shown, torch.tensor([0.1, 0.9]), dim=1)
    true = (omega.unsqueeze(1) @ shown).squeeze(1)
    return {
        "cosine of the mean": float(torch.cosine_similarity(mean, omega).mean()),
        "expected": float(mean.square().sum(-1).mean()),
        "found": float((mean * omega).sum(-1).mean()),
        "coverage of 80%": float(((low < true) & (true < high)).double().mean()),
    }


if __name__ == "__main__":
    main()
