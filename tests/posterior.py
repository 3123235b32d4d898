"""The posterior of ω in plain NumPy and float64, by importance sampling; no code of the package.

Shapes: H answers, K options per query, D features, N draws, C components of the proposal.

The proposal is adapted to a tempered posterior step by step (population Monte Carlo; Cappé,
Guillin, Marin and Robert, 2004): a mixture of the uniform distribution and of Student t
distributions on planes that touch the sphere. Whatever it adapts to, the weights correct; a share
of the draws is uniform, so that in few dimensions a mode that it missed shows as a small effective
number of draws.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

UNIFORM = 0.1
"""Share of the draws that are uniform on the sphere."""

COMPONENTS = 6

ADAPTING = 20_000
"""Draws of each step of the adaptation."""


class Posterior(NamedTuple):
    """Moments of a posterior on the sphere."""

    mean: Array
    """(D)."""
    covariance: Array
    """(D D)."""
    draws: float
    """How many independent draws are as good for the mean, by Kish: its error is sd/√draws."""
    error: float
    """Standard error of the trace of the covariance, as a share of it."""


def log_likelihood(omega: Array, gaps: Array, tau: float | None, tolerance: float = 1e-6) -> Array:
    """(N), of all answers: gaps (H K-1 D) of the chosen options; ``tau`` None never errs."""
    returns = np.einsum("nd,hkd->hkn", omega, gaps)
    if tau is None:
        beaten = (returns < -tolerance).any((0, 1))
        ties = 1 + (np.abs(returns) <= tolerance).sum(1)
        return np.where(beaten, -np.inf, -np.log(ties).sum(0))
    total = np.zeros(len(omega))
    for rows in returns:
        exponents = np.concatenate([np.zeros((1, len(omega))), -tau * rows])
        highest = exponents.max(0)
        total -= highest + np.log(np.exp(exponents - highest).sum(0))
    return total


def posterior(
    gaps: Array, tau: float | None, draws: int = 400_000, seed: int = 0, tolerance: float = 1e-6
) -> Posterior:
    """Moments of the posterior after answers with gaps (H K-1 D), the prior being uniform."""
    rng = np.random.default_rng(seed)
    if tau is None and gaps.shape[2] > 6:
        return _walk(gaps, rng, chains=1000, steps=9 * draws // 400)
    proposal = _adapt(gaps, tau, tolerance, rng)
    parts = [proposal.draw(50_000, rng) for _ in range(max(1, draws // 50_000))]
    logs = np.concatenate(
        [log_likelihood(p, gaps, tau, tolerance) - proposal.log_density(p) for p in parts]
    )
    omega, weights = np.concatenate(parts), np.exp(logs - logs.max())
    weights /= weights.sum()
    mean = weights @ omega
    covariance = (omega * weights[:, None]).T @ omega - np.outer(mean, mean)
    distance = np.square(omega - mean).sum(1) / np.trace(covariance)
    error = math.sqrt(np.square(weights * (distance - 1)).sum())
    return Posterior(mean, covariance, float(1 / np.square(weights).sum()), error)


class _Component(NamedTuple):
    """A Student t distribution on the plane that touches the sphere at a centre, seen from 0."""

    centre: Array
    """(D), of unit length; only the points of its hemisphere are reached."""
    basis: Array
    """(D D-1), of the plane."""
    place: Array
    """(D-1), where on the plane the distribution lies."""
    factor: Array
    """(D-1 D-1), Cholesky factor of its scale."""
    freedom: float

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Points (N D)."""
        normal = rng.standard_normal((count, len(self.place))) @ self.factor.T
        chi = rng.chisquare(self.freedom, (count, 1)) / self.freedom
        points = self.centre + (self.place + normal / np.sqrt(chi)) @ self.basis.T
        return points / np.linalg.norm(points, axis=1, keepdims=True)

    def log_density(self, omega: Array) -> Array:
        """(N), with respect to the uniform distribution on the sphere."""
        n, v = len(self.place), self.freedom
        ahead = omega @ self.centre
        plane = omega @ self.basis / np.where(ahead > 0, ahead, 1.0)[:, None]
        white = (plane - self.place) @ np.linalg.inv(self.factor).T
        log = math.lgamma((v + n) / 2) - math.lgamma(v / 2) - n / 2 * math.log(v * math.pi)
        log -= np.log(np.diag(self.factor)).sum()
        log = log - (v + n) / 2 * np.log1p(np.einsum("np,np->n", white, white) / v)
        # What a piece of the plane is on the sphere, whose whole area counts as one.
        area = math.log(2) + (n + 1) / 2 * math.log(math.pi) - math.lgamma((n + 1) / 2)
        log = log + area - (n + 1) * np.log(np.where(ahead > 0, ahead, 1.0))
        return np.where(ahead > 0, log, -np.inf)


class _Proposal:
    """A mixture of the uniform distribution and of components."""

    def __init__(self, n_features: int) -> None:
        self.n_features = n_features
        self.shares = np.ones(1)
        self.components: list[_Component] = []

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Points (N D)."""
        points = rng.standard_normal((count, self.n_features))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        which = rng.choice(len(self.shares), count, p=self.shares)
        for c, component in enumerate(self.components, 1):
            points[which == c] = component.draw(int((which == c).sum()), rng)
        return points

    def log_density(self, omega: Array) -> Array:
        """(N), with respect to the uniform distribution."""
        logs = [np.full(len(omega), np.log(self.shares[0]))]
        for share, component in zip(self.shares[1:], self.components, strict=True):
            logs.append(np.log(share) + component.log_density(omega))
        return np.logaddexp.reduce(logs)

    def fit(self, omega: Array, rng: np.random.Generator) -> None:
        """Fit the components to points (N D): k-means, then place and spread of each cluster.

        Centres start far from each other, and a small cluster gets more than its share: a far mode
        that holds one in a thousand makes up much of the variance.
        """
        centres = omega[:1]
        while len(centres) < COMPONENTS:
            distance = 1 - (omega @ centres.T).max(1)
            centres = np.concatenate([centres, omega[[distance.argmax()]]])
        for _ in range(10):
            nearest = (omega @ centres.T).argmax(1)
            for c in range(COMPONENTS):
                if (nearest == c).any():
                    centre = omega[nearest == c].sum(0)
                    centres[c] = centre / np.linalg.norm(centre)
        shares: list[float] = []
        self.components = []
        clusters = [omega[nearest == c] for c in range(COMPONENTS)]
        if len(omega[0]) > 4:
            clusters = [*clusters, omega]  # in many dimensions few points are in each
        for own in clusters:
            centre = own.sum(0) / max(1, len(own))
            length = np.linalg.norm(centre)
            if len(np.unique(own, axis=0)) < 2 * self.n_features or length < 0.05:
                continue
            centre /= length
            basis = np.linalg.svd(np.eye(self.n_features) - np.outer(centre, centre))[0][:, :-1]
            ahead = own @ centre
            near = ahead > 0.2
            plane = own[near] @ basis / ahead[near, None]
            spread = np.cov(plane.T, ddof=0).reshape(len(basis.T), len(basis.T))
            spread += 1e-9 * (np.trace(spread) + 1e-12) * np.eye(len(spread)) / len(spread)
            for freedom, scale in ((1.0, 0.4), (10.0, 1.1)):
                factor = np.linalg.cholesky(spread * scale)
                self.components.append(_Component(centre, basis, plane.mean(0), factor, freedom))
                shares.append(math.sqrt(len(own)))
        counts = np.array([0.0, *shares])
        if shares:
            counts *= (1 - UNIFORM) / counts.sum()
        counts[0] = 1 - counts[1:].sum()
        self.shares = counts


def _adapt(gaps: Array, tau: float | None, tolerance: float, rng: np.random.Generator) -> _Proposal:
    """A proposal for the posterior, reached through tempered ones."""
    proposal, power = _Proposal(gaps.shape[-1]), 0.0
    enough = ADAPTING / 25
    for _ in range(300):
        omega = proposal.draw(ADAPTING, rng)
        density = proposal.log_density(omega)
        tempered = _tempered(omega, gaps, tau, tolerance)
        low, high = power, 1.0
        if _effective(tempered(1.0) - density) >= enough:
            low = 1.0
        for _ in range(60):
            middle = (low + high) / 2
            fits = _effective(tempered(middle) - density) >= enough
            low, high = (middle, high) if fits else (low, middle)
        reached = power == 1.0
        power = max(power, low)
        logs = tempered(power) - density
        weights = np.exp(logs - logs.max())
        picked = omega[rng.choice(ADAPTING, ADAPTING, p=weights / weights.sum())]
        proposal.fit(picked, rng)
        if reached:
            break
    return proposal


def _tempered(
    omega: Array, gaps: Array, tau: float | None, tolerance: float
) -> Callable[[float], Array]:
    """From a power in [0, 1] to log-likelihoods (N): those of 1 are the posterior's."""
    if tau is not None:
        whole = log_likelihood(omega, gaps, tau, tolerance)
        return lambda power: power * whole
    # Answers without error are let in by a slack that falls to the tolerance.
    returns = np.einsum("nd,hkd->hkn", omega, gaps).min((0, 1))
    longest = np.linalg.norm(gaps, axis=-1).max()
    return lambda power: np.where(returns >= -tolerance - longest * (1 - power), 0.0, -np.inf)


def _effective(logs: Array) -> float:
    """Kish's effective number of draws with log-weights (N)."""
    if logs.max() == -np.inf:
        return 0.0
    weights = np.exp(logs - logs.max())
    return float(weights.sum() ** 2 / np.square(weights).sum())


def _walk(gaps: Array, rng: np.random.Generator, chains: int, steps: int) -> Posterior:
    """Hit-and-run along great circles in the cone of answers without error.

    In many dimensions it holds too little of any simple proposal. A great circle through a point of
    the cone is inside it on one arc, known in closed form, and uniform on it is invariant. Ties are
    left out: what lies within the tolerance of a border weighs half, on either side of it, which is
    to first order as if there were none.

    Args:
        gaps: (H K-1 D).
        rng: the source of randomness.
        chains: started in the cone by letting in one answer after the other.
        steps: of each chain; the first third is not counted.
    """
    omega = rng.standard_normal((chains, gaps.shape[2]))
    omega /= np.linalg.norm(omega, axis=1, keepdims=True)
    for h in range(len(gaps)):
        inside = omega[(omega @ gaps[h].T >= 0).all(1)]
        omega = inside[rng.integers(len(inside), size=chains)]
        for _ in range(30):
            omega = _hit_and_run(omega, gaps[: h + 1].reshape(-1, gaps.shape[2]), rng)
    first, second, counted = np.zeros_like(omega), np.zeros((gaps.shape[2],) * 2), steps * 2 // 3
    for step in range(steps):
        omega = _hit_and_run(omega, gaps.reshape(-1, gaps.shape[2]), rng)
        if step >= steps - counted:
            first += omega / counted
            second += omega.T @ omega / counted / chains
    mean = first.mean(0)
    covariance = second - np.outer(mean, mean)
    between = np.square(first - mean).sum() / (chains - 1)
    size = float(np.trace(covariance) / between * chains)
    return Posterior(mean, covariance, size, math.sqrt(2 / size))


def _hit_and_run(omega: Array, rows: Array, rng: np.random.Generator) -> Array:
    """Points (C D) on random great circles, where the products with all rows (G D) are positive."""
    ahead = rng.standard_normal(omega.shape)
    ahead -= (ahead * omega).sum(1, keepdims=True) * omega
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    best = np.arctan2(ahead @ rows.T, omega @ rows.T)
    low, high = best.max(1) - np.pi / 2, best.min(1) + np.pi / 2
    angle = rng.uniform(low, np.maximum(low, high))[:, None]
    omega = omega * np.cos(angle) + ahead * np.sin(angle)
    return omega / np.linalg.norm(omega, axis=1, keepdims=True)
