"""The paper in plain NumPy: one human at a time, loops and float64, no code of the package."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def answer_probs(returns: Array, tau: float | None) -> Array:
    """P(q | Q, ω) of each option; ``tau`` None is argmax with uniform ties."""
    if tau is None:
        best = np.isclose(returns, returns.max(), atol=1e-6, rtol=0)
        return best / best.sum()
    exponents = np.exp(tau * (returns - returns.max()))
    return exponents / exponents.sum()


def information_gain(samples: Array, options: Array, tau: float | None) -> float:
    """The paper's sum, term by term: (1/M) Σ_q Σ_ω P(q|ω) log2 (M P(q|ω) / Σ_ω' P(q|ω'))."""
    n_samples = len(samples)
    table = [answer_probs(options @ omega, tau) for omega in samples]
    total = 0.0
    for q in range(len(options)):
        column = sum(row[q] for row in table)
        for row in table:
            if row[q] > 0:
                total += row[q] * math.log2(n_samples * row[q] / column)
    return total / n_samples


def alignment(samples: Array, omega: Array) -> float:
    """The paper's metric: mean over samples of the cosine with the true ω."""
    cosines = [
        sample @ omega / np.linalg.norm(sample) / np.linalg.norm(omega) for sample in samples
    ]
    return float(np.mean(cosines))


def respond(options: Array, omega: Array, noise: Array, tau: float | None) -> int:
    """The human's choice, by the Gumbel-max trick with given noise."""
    probs = answer_probs(options @ omega, tau)
    with np.errstate(divide="ignore"):
        return int(np.argmax(np.log(probs) + noise))


class Session:
    """One human and a budget. The belief's samples are told from outside, as they are random."""

    def __init__(
        self, pool: Array, omega: Array, noise: Array, tau: float | None, budget: int
    ) -> None:
        self.pool, self.omega, self.noise, self.tau = pool, omega, noise, tau
        self.budget = budget
        self.queries: list[int] = []
        self.answers: list[int] = []
        self.information = 0.0

    def ask(self, query: int, samples: Array) -> float:
        """Ask a query of the pool under the present belief; returns the information gain."""
        gain = information_gain(samples, self.pool[query], self.tau)
        noise = self.noise[len(self.queries)]
        self.answers.append(respond(self.pool[query], self.omega, noise, self.tau))
        self.queries.append(query)
        self.information += gain
        return gain

    @property
    def done(self) -> bool:
        return len(self.queries) == self.budget


class FeedSession(Session):
    """The same with a stream of offers."""

    def __init__(self, *args: object, offers: list[int], on_skip: str) -> None:
        super().__init__(*args)  # type: ignore[arg-type]
        self.offers, self.on_skip, self.n_offered = offers, on_skip, 0

    @property
    def offered(self) -> int:
        place = self.n_offered if self.on_skip == "new" else len(self.queries)
        return self.offers[place]

    def decide(self, ask: bool, samples: Array) -> float:
        """Ask or skip; returns the reward."""
        query = self.offered
        reward = (
            self.ask(query, samples)
            if ask
            else -information_gain(samples, self.pool[query], self.tau)
        )
        self.n_offered += 1
        return reward

    @property
    def truncated(self) -> bool:
        return not self.done and self.n_offered == len(self.offers)
