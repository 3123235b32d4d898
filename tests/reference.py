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


def chance(label: str, returns: Array, tau: float | None, threshold: float = 0.0) -> Array:
    """How likely an answer of this label is, (N), from the returns (N K) of the options.

    It is told by its label alone: option 2; B > A > C; best A, worst C; no, yes; the first, the
    second, about equal.
    """
    letters = [ord(word) - ord("A") for word in label.replace(",", "").split() if word.isupper()]
    if label in ("no", "yes"):
        logit = returns[:, 0] * (1e9 if tau is None else tau) - threshold
        return 1 / (1 + np.exp(np.clip(-logit if label == "yes" else logit, -700, 700)))
    if label in ("the first", "the second", "about equal"):
        logit = np.clip(tau * (returns[:, 0] - returns[:, 1]), -300, 300)
        first, second = (1 / (1 + np.exp(threshold - way * logit)) for way in (1, -1))
        equal = (math.exp(2 * threshold) - 1) * first * second
        return {"the first": first, "the second": second, "about equal": equal}[label]
    if label.startswith("option"):
        return _picks(returns, int(label.split()[1]) - 1, tau)
    if label.startswith("best"):
        best, worst = letters
        others = [k for k in range(returns.shape[1]) if k != best]
        worse = _picks(-returns[:, others], others.index(worst), tau)
        return _picks(returns, best, tau) * worse
    likely = np.ones(len(returns))
    for place in range(len(letters) - 1):
        likely *= _picks(returns[:, letters[place:]], 0, tau)
    return likely


def _picks(returns: Array, one: int, tau: float | None) -> Array:
    """(N), how likely one of the options with returns (N K) is picked."""
    best = returns.max(1, keepdims=True)
    if tau is None:
        weights = np.isclose(returns, best, atol=1e-6, rtol=0).astype(float)
    else:
        weights = np.exp(tau * (returns - best))
    return weights[:, one] / weights.sum(1)
