"""What others do for the same work: APReL's way in NumPy, and APReL itself where it is installed.

APReL (Bıyık, Talati and Sadigh, *APReL: a library for active preference-based reward learning
algorithms*, 2022, https://github.com/Stanford-ILIAD/APReL) is imported where it is importable: it
needs ``pip install gym "moviepy<2" scipy`` and its clone on ``PYTHONPATH``.

Shapes: N queries, M belief samples, K options, D features, H answers.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import io
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
from scipy.special import expit, logsumexp

Array = np.ndarray[Any, np.dtype[np.float64]]


def choose_by_loop(samples: Array, queries: Array, tau: float) -> int:
    """The query of highest information gain, one logsumexp per query and sample, as APReL does.

    Args:
        samples: (M D).
        queries: (N K D).
        tau: multiplies the return.
    """
    values = []
    for options in queries:
        probs = []
        for omega in samples:
            rewards = tau * (options @ omega)
            probs.append(np.exp(rewards - logsumexp(rewards)))
        table = np.array(probs)
        values.append(np.sum(table * np.log2(len(table) * table / table.sum(0))) / len(table))
    return int(np.argmax(values))


def choose_by_numpy(samples: Array, queries: Array, tau: float) -> int:
    """The same with whole arrays: samples (M D), queries (N 2 D)."""
    first = expit(tau * ((queries[:, 0] - queries[:, 1]) @ samples.T))
    probs = np.stack([first, 1 - first], -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = probs * np.log2(probs / probs.mean(1, keepdims=True))
    return int(np.nansum(terms, axis=(1, 2)).argmax())


def metropolis(
    gaps: Array, start: Array, tau: float, rng: np.random.Generator, samples: int = 100
) -> Array:
    """APReL's sampler in NumPy: burn-in 200, thin 20, Gaussian steps of 0.05 kept on the sphere.

    Args:
        gaps: (H D), features of the chosen option less those of the other; tau inf is hard.
        start: (D), unit vector.
        tau: multiplies the return.
        rng: the source of randomness.
        samples: M.

    Returns:
        (M D).
    """

    def log_likelihood(omega: Array) -> float:
        returns = gaps @ omega
        if np.isinf(tau):
            return 0.0 if (returns >= 0).all() else -np.inf
        return float(-np.logaddexp(0, -tau * returns).sum())

    burn_in, thin = 200, 20
    point, value, chain = start, log_likelihood(start), []
    for _ in range(burn_in + thin * samples):
        proposal = point + 0.05 * rng.standard_normal(len(point))
        proposal /= np.linalg.norm(proposal)
        new = log_likelihood(proposal)
        if np.log(rng.random()) < new - value:
            point, value = proposal, new
        chain.append(point)
    return np.array(chain[burn_in::thin])


def import_aprel() -> ModuleType | None:
    """APReL, or None where it cannot be imported."""
    needed = ("aprel", "gym", "moviepy")
    if any(importlib.util.find_spec(name) is None for name in needed):
        return None
    # Gym prints that nobody maintains it.
    with contextlib.redirect_stderr(io.StringIO()):
        return importlib.import_module("aprel")


def aprel_belief(aprel: ModuleType, queries: Array, answers: Array, tau: float) -> Any:
    """APReL's belief after some answers, at its own settings.

    Args:
        aprel: the module.
        queries: (H K D).
        answers: (H), chosen options.
        tau: APReL's ``beta``; it multiplies the return too.
    """
    start = np.random.default_rng(0).standard_normal(queries.shape[-1])
    params = {"weights": start / np.linalg.norm(start), "beta": tau}
    user = aprel.SoftmaxUser(params)
    data = [
        aprel.Preference(query, int(answer))
        for query, answer in zip(aprel_queries(aprel, queries), answers, strict=True)
    ]
    return aprel.SamplingBasedBelief(user, data, dict(params))


def aprel_queries(aprel: ModuleType, queries: Array) -> list[Any]:
    """APReL's query objects from features (N K D)."""
    return [aprel.PreferenceQuery(aprel_trajectories(aprel, options)) for options in queries]


def aprel_trajectories(aprel: ModuleType, features: Array) -> Any:
    """APReL's set of trajectories from features (N D)."""

    class Features:
        """An APReL environment whose trajectories are their own features."""

        @staticmethod
        def features(trajectory: Array) -> Array:
            return trajectory

    return aprel.TrajectorySet([aprel.Trajectory(Features, each) for each in features])


def choose_by_aprel(aprel: ModuleType, belief: Any, queries: list[Any]) -> Callable[[], int]:
    """A call that picks one of ``queries`` by APReL's mutual information, one at a time."""
    gain = importlib.import_module("aprel.querying.acquisition_functions").mutual_information
    return lambda: int(np.argmax([gain(belief, query) for query in queries]))
