"""APReL beside ours: the same answers, the same posterior; its tutorial, in seconds of each.

APReL has to be importable: `pip install gym "moviepy<2" scipy`, and its clone on ``PYTHONPATH``.

The posterior is held against importance sampling. Each of the beliefs is made several times;
*error* is how far the mean of all their means is from the right one, and *expected* the error that
their own scatter makes: of a right sampler the two are alike.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)  # and not this folder, whose select.py would hide Python's own

import itertools
import time
from collections.abc import Callable
from functools import partial
from types import ModuleType

import numpy as np
import torch
from torch import Generator, Tensor

from benchmarks import common, peers
from torchrl_pref.beliefs.sampled import Belief, uniform_sphere
from torchrl_pref.questions.choice import feature_gaps
from torchrl_pref.questions.responses import Boltzmann
from torchrl_pref.session import Session
from torchrl_pref.tasks.gymnasium import GymnasiumTask

DRAWS = 2_000_000
"""Of the prior, for the right mean."""

TRAJECTORIES, QUESTIONS = 10, 10
"""Of APReL's tutorial, ``examples/simple.py`` at commit 13a1e7f."""


def right_mean(queries: Tensor, answers: Tensor, tau: float) -> Tensor:
    """The mean (D) of the posterior, by importance sampling from the prior."""
    omega = uniform_sphere((DRAWS, queries.shape[-1]), Generator().manual_seed(1)).double()
    weights = torch.zeros(DRAWS, dtype=torch.double)
    for query, answer in zip(queries.double(), answers.tolist(), strict=True):
        weights += (tau * omega @ query.T).log_softmax(-1)[:, answer]
    return (weights - weights.max()).softmax(0) @ omega


def timed(make: Callable[[int], Tensor], repetitions: int) -> tuple[Tensor, float]:
    """Means (R D) of repetitions, and CPU seconds of one."""
    make(0)
    start = time.process_time()
    means = torch.stack([make(number) for number in range(repetitions)])
    return means, (time.process_time() - start) / repetitions


def posterior(aprel: ModuleType, repetitions: int) -> list[common.Row]:
    """The belief after 1, 5 and 10 answers to random questions of three options, of either."""
    model, generator = Boltzmann(2.0), Generator().manual_seed(0)
    queries = torch.randn(10, 3, 4, generator=generator)
    omega = uniform_sphere((4,), generator)
    answers = model(queries @ omega).exp().multinomial(1, generator=generator).squeeze(-1)
    belief, rows = Belief(model), []
    for count in (1, 5, 10):
        right = right_mean(queries[:count], answers[:count], model.tau)

        def ours(seed: int, count: int = count) -> Tensor:
            luck = Generator().manual_seed(seed)
            samples, ess = belief.prior(1, 4, luck), torch.full((1,), 100.0)
            gaps = feature_gaps(queries[:count], answers[:count]).unsqueeze(0)
            for turn in range(count):
                evidence = common.told(gaps[:, :turn], gaps[:, turn])
                samples, ess, _ = belief.update(samples, ess, evidence, luck)
            return samples[0].mean(0).double()

        def theirs(seed: int, count: int = count) -> Tensor:
            np.random.seed(seed)  # noqa: NPY002, the one that APReL draws from
            shown, picked = queries[:count].double().numpy(), answers[:count].numpy()
            made = peers.aprel_belief(aprel, shown, picked, model.tau)
            return torch.tensor(np.mean([one["weights"] for one in made.samples], 0))

        runs = {"ours": (ours, 50 * repetitions), "APReL": (theirs, repetitions)}
        for name, (make, number) in runs.items():
            means, seconds = timed(make, number)
            rows.append(
                {
                    "answers": count,
                    "belief": name,
                    "made": number,
                    "error": float((means.mean(0) - right).norm()),
                    "expected": float((means.var(0).sum() / number).sqrt()),
                    "scatter of one": float(means.var(0).sum().sqrt()),
                    "CPU ms, all answers": 1000 * seconds,
                }
            )
    return rows


def tutorial(aprel: ModuleType, people: int) -> list[common.Row]:
    """Ten questions about ten trajectories of MountainCar to simulated people, of either."""
    task = GymnasiumTask("MountainCarContinuous-v0")
    features = task.features(task.trajectories(TRAJECTORIES, seed=0))
    omegas = uniform_sphere((people, features.shape[-1]), Generator().manual_seed(0))
    runs = {"ours": tutorial_by_ours, "APReL": partial(tutorial_by_aprel, aprel)}
    rows = []
    for name, run in runs.items():
        start = time.process_time()
        means = torch.stack([run(features, omega, luck) for luck, omega in enumerate(omegas)])
        seconds = (time.process_time() - start) / people
        aligned = float(torch.cosine_similarity(means, omegas).mean())
        rows.append(
            {
                "tutorial by": name,
                "people": people,
                "CPU s of one": seconds,
                "cosine of the mean": aligned,
            }
        )
    return rows


def tutorial_by_ours(features: Tensor, omega: Tensor, luck: int) -> Tensor:
    """The mean (D) in the end, from the features (N D) of trajectories."""
    model, generator = Boltzmann(1.0), Generator().manual_seed(luck)
    pairs = torch.tensor([*itertools.combinations(range(len(features)), 2)])
    session = Session(features[pairs], model, "information_gain", budget=QUESTIONS, seed=luck)
    for _ in range(QUESTIONS):
        chances = model(session.ask().features @ omega).exp()
        session.tell(int(chances.multinomial(1, generator=generator)))
    return session.weights.mean


def tutorial_by_aprel(aprel: ModuleType, features: Tensor, omega: Tensor, luck: int) -> Tensor:
    """The mean (D) in the end."""
    np.random.seed(luck)  # noqa: NPY002, the one that APReL draws from
    shown = peers.aprel_trajectories(aprel, features.double().numpy())
    optimizer = aprel.QueryOptimizerDiscreteTrajectorySet(shown)
    person = aprel.SoftmaxUser({"weights": omega.double().numpy()})
    params = {"weights": aprel.util_funs.get_random_normalized_vector(len(omega))}
    belief = aprel.SamplingBasedBelief(aprel.SoftmaxUser(params), [], params)
    query = aprel.PreferenceQuery(shown[[0, 1]])
    for _ in range(QUESTIONS):
        queries, _ = optimizer.optimize("mutual_information", belief, query)
        answers = person.respond(queries[0])
        belief.update(aprel.Preference(queries[0], answers[0]))
    return torch.tensor(belief.mean["weights"], dtype=omega.dtype)


def main() -> None:
    """Print a table."""
    parser = common.arguments(__doc__)
    parser.add_argument("what", choices=["posterior", "tutorial"], help="which table")
    parser.add_argument("--made", type=int, default=8, help="beliefs of APReL's (default 8)")
    parser.add_argument("--people", type=int, default=5, help="in the tutorial (default 5)")
    typed = common.start(parser)
    aprel = peers.import_aprel()
    if aprel is None:
        parser.error(
            'APReL is not there; pip install gym "moviepy<2" scipy, and put its clone on PYTHONPATH'
        )
    if typed.what == "posterior":
        title = "The same answers, of three options, tau = 2, D = 4, 100 samples"
        rows = posterior(aprel, typed.made)
    else:
        title = f"{TRAJECTORIES} trajectories of MountainCar, {QUESTIONS} questions"
        rows = tutorial(aprel, typed.people)
    common.report(title, rows, typed.json)


if __name__ == "__main__":
    main()
