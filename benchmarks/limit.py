"""The kernels against the machine's own ceiling: a bare exp and log over as many elements.

``python benchmarks/limit.py``. Scoring N queries under M samples takes a model of each of N·M
answers; the ceiling is one ``exp`` and one ``log`` over N·M numbers that lie in the cache, timed in
the same run. A move of the belief evaluates H answers for each of S·M samples a few times over;
its ceiling is one ``exp`` and one ``log`` for each evaluation: as many in all moves as in the
first. ``--compile`` adds ``torch.compile``.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder's select.py hides Python's

import time
from collections.abc import Callable

import torch
from torch import Generator, Tensor

from benchmarks import common
from benchmarks.common import told
from torchrl_pref.acquisition.functions import information_gain
from torchrl_pref.acquisition.scoring import predict_answers, score_queries
from torchrl_pref.beliefs.resampling import FRAMES, poles_of
from torchrl_pref.beliefs.sampled import Belief, uniform_sphere
from torchrl_pref.beliefs.slice import ARC, MAX_SHRINKS, compiled_moves
from torchrl_pref.questions.choice import feature_gaps
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann, Optimal, compiled_constants

SESSIONS, MOVES = 100, 4


def main() -> None:
    """Print the table."""
    parser = common.arguments(__doc__)
    parser.add_argument(
        "--compile", action="store_true", help="also torch.compile (a C++ compiler)"
    )
    options = common.start(parser)
    rows = [
        row
        for device in common.devices()
        for row in _scoring(device, options.repeats, options.compile)
    ]
    for model in (Boltzmann(common.TAU), Optimal()):
        rows += [_moving(model, count, options.repeats) for count in (5, 20)]
    common.report("Seconds over those of a bare exp and log", rows, options.json)


def _ceiling(elements: int, device: str) -> Callable[[], None]:
    """One exp and one log over so many numbers, 100,000 at a time."""
    numbers = torch.rand(min(elements, 100_000), device=device) + 0.5
    out, passes = torch.empty_like(numbers), max(1, round(elements / len(numbers)))

    def run() -> None:
        for _ in range(passes):
            torch.exp(numbers, out=out)
            torch.log(numbers, out=out)

    return run


def _scoring(device: str, repeats: int, compile_too: bool) -> list[common.Row]:
    """Information gain of 1000 queries under 100 samples, one session and many."""
    pool, model = common.normalised_pool().features.to(device), Boltzmann(common.TAU)
    rows = []
    for size in (1, SESSIONS):
        samples = common.belief_samples(size).to(device)
        queries = pool.expand(size, *pool.shape)
        elements = size * len(pool) * samples.shape[1]

        def score(samples: Tensor = samples, queries: Tensor = queries) -> Tensor:
            return score_queries(samples, queries, model, information_gain)

        mark = f", {device}" if device != "cpu" else ""
        cases = {f"ceiling{mark}": _ceiling(elements, device), f"score{mark}": score}
        note = ""
        if compile_too and size == 1:
            compiled, warm_up = _compiled(samples, queries, model)
            cases[f"compiled{mark}"] = compiled
            error = float((compiled() - score()).abs().max())
            note = f"warm-up {warm_up:.1f} s, differs by {error:.0e} bits"
        seconds = common.paired(cases, repeats)
        for name in list(cases)[1:]:
            rows.append(
                {
                    "kernel": f"{name}, B={size}",
                    "elements": elements,
                    "CPU ms": 1000 * seconds[name],
                    "ceiling ms": 1000 * seconds[f"ceiling{mark}"],
                    "ratio": seconds[name] / seconds[f"ceiling{mark}"],
                    "note": note if "compiled" in name else "",
                }
            )
    return rows


def _compiled(
    samples: Tensor, queries: Tensor, model: ResponseModel
) -> tuple[Callable[[], Tensor], float]:
    """The same kernel through torch.compile, and the seconds of its first call."""

    @torch.compile
    def kernel(samples: Tensor, queries: Tensor) -> Tensor:
        return information_gain(predict_answers(samples, queries, model), samples)

    start = time.perf_counter()
    kernel(samples, queries)
    return lambda: kernel(samples, queries), time.perf_counter() - start


def _moving(model: ResponseModel, n_answers: int, repeats: int) -> common.Row:
    """A round of moves of the belief after so many answers, and all that belongs to it."""
    generator = Generator().manual_seed(0)
    pool = common.normalised_pool().features
    omega = uniform_sphere((SESSIONS, pool.shape[-1]), generator)
    belief = Belief(model)
    samples, ess = belief.prior(SESSIONS, pool.shape[-1], generator), torch.full((SESSIONS,), 100.0)
    gaps = torch.zeros(SESSIONS, 0, 1, pool.shape[-1])
    for _ in range(n_answers):
        queries = pool[torch.randint(len(pool), (SESSIONS,), generator=generator)]
        returns = (queries @ omega.unsqueeze(-1)).squeeze(-1)
        answers = model(returns).exp().multinomial(1, generator=generator).squeeze(-1)
        newest = feature_gaps(queries, answers)
        samples, ess, _ = belief.update(samples, ess, told(gaps, newest), generator)
        gaps = torch.cat([gaps, newest.unsqueeze(1)], 1)
    normal = torch.randn((SESSIONS, FRAMES, MOVES, pool.shape[-1]), generator=generator)
    slack, power = torch.zeros(SESSIONS), torch.ones(SESSIONS)
    scales = torch.ones(SESSIONS, 2, samples.shape[1])
    uniform = torch.rand((MOVES, *samples.shape[:2], 2 + MAX_SHRINKS), generator=generator)
    constants = compiled_constants(model)
    assert constants is not None

    def step(shrinks: int = MAX_SHRINKS, moves: int = MOVES) -> Tensor:
        poles = poles_of(samples, normal[:, :, :moves])
        luck = uniform[:moves, ..., : 2 + shrinks]
        evidence = told(gaps[:, :-1], gaps[:, -1])
        given = evidence.rows, evidence.offsets, evidence.floor, scales, slack, power
        return compiled_moves(samples, poles, luck, *given, ARC, *constants)

    # A sample that has not moved after so many shrinks needs one more evaluation.
    unmoved = sum((step(n, 1) - samples).norm(dim=-1) < 1e-6 for n in range(MAX_SHRINKS))
    evaluated = MOVES * n_answers * int((1 + unmoved).sum())
    seconds = common.paired({"ceiling": _ceiling(evaluated, "cpu"), "step": step}, repeats)
    kind = "soft" if isinstance(model, Boltzmann) else "hard"
    return {
        "kernel": f"belief, {MOVES} moves, {kind}, H={n_answers}, S={SESSIONS}",
        "elements": evaluated,
        "CPU ms": 1000 * seconds["step"],
        "ceiling ms": 1000 * seconds["ceiling"],
        "ratio": seconds["step"] / seconds["ceiling"],
        "note": "",
    }


if __name__ == "__main__":
    main()
