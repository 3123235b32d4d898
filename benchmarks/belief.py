"""Effective samples of the posterior per CPU second, ours beside Metropolis and emcee.

``python benchmarks/belief.py``. Every sampler sees the same human, queries and answers, many times
over. The effective sample size is measured and not estimated: the posterior's variance over the
variance of the sampler's mean between repetitions, both summed over features. The error is the
distance of the mean over all repetitions from the posterior mean by quadrature, so that speed is
never bought with a wrong posterior. Metropolis is APReL's, in NumPy, at its settings; APReL itself
is timed where it is importable (see ``peers.py``): the same chain, so its effective sample size is
that of the twin.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder's select.py hides Python's

import importlib.util
import math
import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Generator, Tensor

from benchmarks import common, peers
from benchmarks.common import told
from torchrl_pref.acquisition.functions import information_gain
from torchrl_pref.acquisition.scoring import score_queries
from torchrl_pref.beliefs.sampled import Belief, uniform_sphere
from torchrl_pref.questions.choice import feature_gaps
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann, Optimal

ANSWERS = (1, 5, 10, 20)
REPETITIONS = 200
"""Of ours, as one batch; the other samplers have a quarter of it."""


class Measured(NamedTuple):
    """What one sampler did after so many answers."""

    means: Tensor
    """(R D), mean of the samples in each repetition."""
    seconds: float
    """CPU seconds of one update of one session."""


def main() -> None:
    """Print the table."""
    options = common.start(common.arguments(__doc__))
    rows = []
    for model in (Boltzmann(common.TAU), Optimal()):
        queries, answers = _conversation(model)
        gaps = feature_gaps(queries, answers)
        ours = _run_ours(model, gaps, options.repeats)
        for count in ANSWERS:
            mean, variance = _quadrature(model, gaps[:count])
            samplers = {"ours, B=200": ours[count]}
            rest = gaps[:count, 0].double().numpy()
            tau = getattr(model, "tau", math.inf)
            starts = _starts(rest, tau)
            samplers["Metropolis, NumPy"] = _repeat(_metropolis(rest, tau), starts)
            if importlib.util.find_spec("emcee") is not None:
                samplers["emcee, 32 walkers"] = _repeat(_emcee(rest, tau), starts)
            sizes = {
                name: float(variance / measured.means.var(0).sum())
                for name, measured in samplers.items()
            }
            aprel = peers.import_aprel()
            if aprel is not None and isinstance(model, Boltzmann):
                shown, picked = queries[:count].double().numpy(), answers[:count].numpy()
                samplers["APReL"] = Measured(
                    samplers["Metropolis, NumPy"].means,
                    _cpu(partial(peers.aprel_belief, aprel, shown, picked, common.TAU)),
                )
                sizes["APReL"] = sizes["Metropolis, NumPy"]
            speed = {name: sizes[name] / samplers[name].seconds for name in samplers}
            for name, measured in samplers.items():
                rows.append(
                    {
                        "human": "soft" if isinstance(model, Boltzmann) else "hard",
                        "answers": count,
                        "sampler": name,
                        "CPU ms": 1000 * measured.seconds,
                        "ESS": round(sizes[name]),
                        "ESS / CPU s": round(speed[name], 1),
                        "x Metropolis": round(speed[name] / speed["Metropolis, NumPy"], 1),
                        "x APReL": round(speed[name] / speed["APReL"]) if "APReL" in speed else "",
                        "error of mean": float((measured.means.mean(0) - mean).norm()),
                        "its standard error": math.sqrt(
                            float(variance) / sizes[name] / len(measured.means)
                        ),
                    }
                )
    title = (
        "Posterior after so many answers to random queries, D=4; ESS of 100 samples (emcee: 3200)"
    )
    common.report(title, rows, options.json)
    common.report("Ours after every one of 20 answers, 1000 repetitions", _every_answer(), None)


def _every_answer() -> list[common.Row]:
    """The least and the mean effective sample size over 20 answers, measured and as reported."""
    rows = []
    for model in (Boltzmann(common.TAU), Optimal()):
        for asks in ("random", "greedy"):
            measured, reported = _follow(model, asks == "greedy")
            rows.append(
                {
                    "human": "soft" if isinstance(model, Boltzmann) else "hard",
                    "queries": asks,
                    "least ESS": round(min(measured)),
                    "mean ESS": round(sum(measured) / len(measured)),
                    "least reported": round(min(reported)),
                    "mean reported": round(sum(reported) / len(reported)),
                }
            )
    return rows


def _follow(model: ResponseModel, greedy: bool) -> tuple[list[float], list[float]]:
    """Effective sample size after each answer of one human, over 1000 beliefs: true, reported."""
    pool = common.normalised_pool()

    def question(samples: Tensor, generator: Generator) -> Tensor:
        index = torch.randint(len(pool), (1,), generator=generator)
        if greedy:
            values = score_queries(samples, pool.features[None], model, information_gain)
            index = values.argmax(1)
        return pool.features[int(index)]

    followed = common.follow(model, pool.n_features, 1000, [question] * max(ANSWERS))
    return followed.measured, followed.reported


def _conversation(model: ResponseModel) -> tuple[Tensor, Tensor]:
    """Random queries of the default pool (H 2 D) and a human's answers (H)."""
    generator = Generator().manual_seed(0)
    pool = common.normalised_pool().features
    queries = pool[torch.randint(len(pool), (max(ANSWERS),), generator=generator)]
    omega = uniform_sphere((pool.shape[-1],), generator)
    answers = model(queries @ omega).exp().multinomial(1, generator=generator).squeeze(-1)
    return queries, answers


def _run_ours(model: ResponseModel, gaps: Tensor, repeats: int) -> dict[int, Measured]:
    """All the answers (H 1 D) in turn, in a batch of repetitions; by the number of answers."""
    generator, belief = Generator().manual_seed(0), Belief(model)
    shared = gaps.expand(REPETITIONS, *gaps.shape)
    samples = belief.prior(REPETITIONS, gaps.shape[-1], generator)
    ess = torch.full((REPETITIONS,), float(belief.n_samples))
    measured = {}
    for count in range(1, len(gaps) + 1):

        def update(
            samples: Tensor = samples, ess: Tensor = ess, last: int = count - 1
        ) -> tuple[Tensor, Tensor, Tensor]:
            return belief.update(samples, ess, told(shared[:, :last], shared[:, last]), generator)

        samples, ess, _ = update()
        if count in ANSWERS:
            seconds = common.paired({"update": update}, repeats)["update"] / REPETITIONS
            measured[count] = Measured(samples.mean(1).double(), seconds)
    return measured


Sampler = Callable[[peers.Array, np.random.Generator], peers.Array]
"""From 32 starts (32 D) and a source of randomness to samples (M D)."""


def _repeat(sample: Sampler, starts: peers.Array) -> Measured:
    """Means and time of a sampler that is run once per repetition, from starts (R 32 D)."""
    means, seconds = [], 0.0
    for seed, start in enumerate(starts):
        rng = np.random.default_rng(seed)
        begun = time.process_time()
        means.append(sample(start, rng).mean(0))
        seconds += time.process_time() - begun
    return Measured(torch.from_numpy(np.array(means)), seconds / len(starts))


def _metropolis(gaps: peers.Array, tau: float) -> Sampler:
    """APReL's chain."""
    return lambda start, rng: peers.metropolis(gaps, start[0], tau, rng)


def _emcee(gaps: peers.Array, tau: float) -> Sampler:
    """emcee's ensemble of 32 on a Gaussian whose direction is ω: 200 steps, the last half kept."""
    import emcee

    def log_density(weights: peers.Array) -> peers.Array:
        returns = weights @ gaps.T / np.linalg.norm(weights, axis=1, keepdims=True)
        prior = -np.square(weights).sum(1) / 2
        if np.isinf(tau):
            return np.where((returns >= 0).all(1), prior, -np.inf)
        return prior - np.logaddexp(0, -tau * returns).sum(1)

    def sample(start: peers.Array, rng: np.random.Generator) -> peers.Array:
        sampler = emcee.EnsembleSampler(*start.shape, log_density, vectorize=True)
        sampler.random_state = np.random.RandomState(rng.integers(2**31)).get_state()
        sampler.run_mcmc(start * np.sqrt(rng.chisquare(start.shape[1], (len(start), 1))), 200)
        weights = sampler.get_chain(discard=100, flat=True)
        return weights / np.linalg.norm(weights, axis=1, keepdims=True)

    return sample


def _starts(gaps: peers.Array, tau: float) -> peers.Array:
    """Points of the prior (R 32 D), drawn by how well they agree with the answers."""
    rng, shape = np.random.default_rng(0), (REPETITIONS // 4, 32)
    points = rng.standard_normal((100_000, gaps.shape[1]))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    returns = points @ gaps.T
    if np.isinf(tau):
        weights = (returns >= 0).all(1).astype(float)
    else:
        weights = np.exp(-np.logaddexp(0, -tau * returns).sum(1))
    return points[rng.choice(len(points), shape, p=weights / weights.sum())]


def _quadrature(model: ResponseModel, gaps: Tensor) -> tuple[Tensor, Tensor]:
    """Posterior mean (D) and total variance by a grid of 4 million points on the sphere, D=4."""
    count = 128
    half = (torch.arange(count, dtype=torch.float64) + 0.5) * math.pi / count
    full = (torch.arange(2 * count, dtype=torch.float64) + 0.5) * math.pi / count
    total, first, second = 0.0, torch.zeros(4, dtype=torch.float64), 0.0
    theta, phi = (grid.flatten() for grid in torch.meshgrid(half, full, indexing="ij"))
    sphere = torch.stack([theta.cos(), theta.sin() * phi.cos(), theta.sin() * phi.sin()], -1)
    for psi in half:
        points = torch.cat([psi.cos().expand(len(sphere), 1), psi.sin() * sphere], -1)
        returns = (points @ gaps[:, 0].double().T)[..., None, None]
        likelihood = model.joint_log_likelihood(returns, torch.zeros(1))
        weights = likelihood.exp() * psi.sin().square() * theta.sin()
        total += float(weights.sum())
        first += weights @ points
        second += float(weights @ points.square().sum(-1))
    mean = first / total
    return mean, torch.tensor(second / total) - mean.square().sum()


def _cpu(case: Callable[[], object]) -> float:
    """CPU seconds of one call."""
    start = time.process_time()
    case()
    return time.process_time() - start


if __name__ == "__main__":
    main()
