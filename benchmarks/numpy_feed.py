"""``FeedEnv`` for one human, in NumPy, as a Gymnasium environment: what Stable-Baselines3 runs.

The same maths with the same constants: resample-move with great-circle slice sampling, see
``belief.py`` and ``sampler.py``. All M samples move at once. Left out, to its advantage: the
effective sample size, which no policy reads, and letting an answer in by stages, which one of 80
Boltzmann answers takes. float32 was no faster.

A logit is -tau · gap: an answer has the likelihood 1 / (1 + exp(logit)).

Shapes: M belief samples, N queries, K = 2 options, D features, H budget, O offers, h answers yet.
"""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np

from torchrl_pref.beliefs.slice import ARC, MAX_SHRINKS

Array = np.ndarray[Any, np.dtype[np.float64]]


class NumpyFeed(gymnasium.Env[np.ndarray, np.int64]):
    """Ask (1) or skip (0) the offered query; sees the belief mean and the offer, (D + K D).

    At the end ``info`` holds ``length`` and ``alignment``. Made from a pool (N K D), tau, the
    number of samples M, the moves after each answer, and the budget H.
    """

    def __init__(self, pool: Array, tau: float, samples: int, moves: int, budget: int) -> None:
        self.pool, self.tau, self.moves, self.budget = pool, tau, moves, budget
        self.shape = (samples, pool.shape[2])
        size = pool.shape[2] + pool[0].size
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(2)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A new human, or one whose ``omega`` (D), ``noise`` (H K) and ``offers`` (O) are given."""
        super().reset(seed=seed)
        rng, given = self.np_random, options or {}
        offers = rng.integers(len(self.pool), size=2 * self.budget)
        self.offers = given.get("offers", offers)
        self.omega = given.get("omega", unit(rng.standard_normal(self.shape[1])))
        self.noise = given.get("noise", rng.gumbel(size=(self.budget, 2)))
        self.samples = unit(rng.standard_normal(self.shape))
        self.mean = self.samples.mean(0)
        self.rows = np.empty((self.budget, self.shape[1]))
        self.n_asked = self.n_offered = 0
        return self._observe(), {}

    def step(self, action: np.int64 | int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Ask or skip; the reward is the information gain in bits, negative for a skip."""
        first, second = self.pool[self.offers[self.n_offered]]
        row = self.tau * (second - first)
        gain = information_gain(self.samples @ row)
        self.n_offered += 1
        if action == 1:
            noise = self.noise[self.n_asked]
            self.rows[self.n_asked] = row if row @ self.omega < noise[0] - noise[1] else -row
            self.n_asked += 1
            rows = self.rows[: self.n_asked]
            self.samples = update(self.samples, rows, self.moves, self.np_random)
            self.mean = self.samples.mean(0)
        ended = self.n_asked == self.budget
        out = not ended and self.n_offered == len(self.offers)
        info = {}
        if ended or out:
            info = {"length": self.n_offered, "alignment": float(self.mean @ self.omega)}
        return self._observe(), gain if action == 1 else -gain, ended, out, info

    def _observe(self) -> np.ndarray:
        """(D + K D); after the last offer, the last one again."""
        offer = self.pool[self.offers[min(self.n_offered, len(self.offers) - 1)]]
        return np.concatenate((self.mean, offer.ravel())).astype(np.float32)


def unit(vectors: Array) -> Array:
    """Vectors (… D) at length one."""
    return vectors / np.sqrt((vectors * vectors).sum(-1, keepdims=True))


def information_gain(logits: Array) -> float:
    """Mutual information of the answer and ω in bits, from the logits (M) of an answer."""
    size = np.abs(logits)
    unlikely = 1 / (1 + np.exp(size))
    entropy = float((size * unlikely - np.log1p(-unlikely)).mean())
    mean = float(np.where(logits > 0, unlikely, 1 - unlikely).mean())
    of_mean = -sum(p * math.log(p) for p in (mean, 1 - mean) if p > 0)
    return max(0.0, of_mean - entropy) / math.log(2)


def update(samples: Array, rows: Array, moves: int, rng: np.random.Generator) -> Array:
    """Samples (M D) after the last of the answers ``rows`` (h D), whose logits are ``rows @ ω``."""
    n_samples = len(samples)
    cumulative = (1 / (1 + np.exp(samples @ rows[-1]))).cumsum()
    points = (np.arange(n_samples) + rng.random()) * (cumulative[-1] / n_samples)
    samples = samples[np.searchsorted(cumulative, points).clip(max=n_samples - 1)]
    centred = samples - samples.mean(0)
    covariance = centred.T @ centred / n_samples + 1e-6 * np.eye(rows.shape[1])
    scale = np.linalg.cholesky(covariance)
    for directions in orthonormal(moves, samples.shape, rng):
        samples = great_circle_step(samples, directions @ scale.T, rows, rng)
    return samples


def orthonormal(n: int, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Unit vectors (n M D) for a shape (M D), in frames of D at right angles."""
    vectors = rng.standard_normal((n, *shape))
    for i in range(n):
        for j in range(i - i % shape[-1], i):
            vectors[i] -= np.einsum("md,md->m", vectors[i], vectors[j])[:, None] * vectors[j]
        vectors[i] = unit(vectors[i])
    return vectors


def great_circle_step(samples: Array, poles: Array, rows: Array, rng: np.random.Generator) -> Array:
    """Move every sample (M D) along the circle through it and its pole (M D)."""
    along = np.einsum("md,md->m", poles, samples)
    across = poles - along[:, None] * samples
    height = np.sqrt(np.einsum("md,md->m", across, across))
    tangents = across / height[:, None]
    length = np.sqrt(along * along + height * height)
    # The logits, and in the last row the sine of the angle to the pole, are circle[0] cos(angle) +
    # circle[1] sin(angle). They are one array so that one take thins them out.
    circle = np.empty((2, len(rows) + 1, len(samples)))
    np.matmul(rows, samples.T, out=circle[0, :-1])
    np.matmul(rows, tangents.T, out=circle[1, :-1])
    circle[0, -1], circle[1, -1] = height / length, -along / length

    power = samples.shape[1] - 2
    threshold = density(circle[0].copy(), power) * rng.random(len(samples))
    arc = np.minimum(ARC * length, 2 * math.pi)
    high = rng.random(len(samples)) * arc
    low = high - arc
    angle, todo = np.zeros(len(samples)), np.arange(len(samples))
    for _ in range(MAX_SHRINKS):
        proposal = low + (high - low) * rng.random(len(todo))
        points = circle[0] * np.cos(proposal)
        points += circle[1] * np.sin(proposal)
        left = (density(points, power) < threshold).nonzero()[0]
        angle[todo] = proposal  # those left are overwritten at the next shrink
        if len(left) == 0:
            break
        positive = proposal > 0
        high = np.where(positive, proposal, high).take(left)
        low = np.where(positive, low, proposal).take(left)
        todo, threshold, circle = todo.take(left), threshold.take(left), circle.take(left, 2)
    else:
        angle[todo] = 0.0
    return unit(samples * np.cos(angle)[:, None] + tangents * np.sin(angle)[:, None])


def density(points: Array, power: int) -> Array:
    """(m), of points (h+1 m) as in :func:`great_circle_step`, which are overwritten."""
    logits = points[:-1]
    np.exp(logits, out=logits)
    logits += 1
    return np.abs(points[-1]) ** power / np.multiply.reduce(logits, 0)
