"""About how much memory a run takes, so that one which cannot fit is refused before it starts.

Letters as everywhere: B sessions, H budget, O offers, M samples, N queries, C candidates, K options
per query, D features, T steps (of a pool: cells of a walk). The bytes of each term were measured,
as the peak of a process with one of the sizes raised: they are right to about a half, which is
enough to tell what fits from what does not.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from torchrl_pref.config.sections import Settings
from torchrl_pref.errors import InputError

N_FEATURES = 4
"""D of the Gridworld."""

HELD_OUT = 2000
"""Sessions that the held-out protocol runs at once in each worker: strategies times humans."""

MOVED = 2**20
"""Moves of samples that a belief makes at once, see ``beliefs.sampled``."""

LAPLACE_HELD = 2**22
"""Numbers of the matrices that ``beliefs.laplace`` makes at once, see :func:`laplace_numbers`."""

LAPLACE_COPIES = 6
"""How many matrices of each size it holds at its peak."""

UNIFORMS = 18
"""Random numbers of a move, see ``beliefs.slice.MAX_SHRINKS``."""

SHORTLIST = 20
"""Candidates for each question of a batch, see ``strategies.batches``."""

PROCESS = 5.2e8
"""Of a process that asks sessions: torch, TorchRL and Numba."""

FEWEST = 64
"""Sessions that a part has at least: with fewer, what is saved hardly pays for the processes."""

SHOWN = ("demonstrations.count", "demonstrations.alternatives")

LIMIT_FILES = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
"""Where Linux writes what a container may use."""


SIZES: dict[str, Callable[[int], tuple[int, int, int]]] = {
    "weak": lambda n_options: (3, 2, 1),
    "ranking": lambda n_options: (
        math.factorial(min(n_options, 6)),
        n_options - 1,
        n_options - 1,
    ),
    "best_worst": lambda n_options: (n_options * (n_options - 1), 2, n_options - 1),
    "approve": lambda n_options: (2, 1, 1),
}
"""From K to the number of answers R, the factors F of each and the rows J of a factor, by kind of
question; of the others they are those of a choice, K, 1 and K-1."""


class Part(NamedTuple):
    """One thing that a run keeps in memory."""

    what: str
    size: float
    """Bytes."""
    keys: tuple[str, ...]
    """Settings that it grows with."""


def check_memory(settings: Settings, *pool_shape: int) -> None:
    """Refuse sizes that cannot fit into this machine's memory.

    Args:
        settings: of a training or of an evaluation, each in its range.
        pool_shape: N, K and D; by default those that the settings ask for, with the Gridworld's D.

    Raises:
        InputError: the largest part of the run is estimated at more than there is.
    """
    part = max(parts_of(settings, *pool_shape), key=lambda part: part.size)
    limit = machine_memory()
    if part.size > limit:
        named = ", ".join(f"{key}={_value_of(settings, key)}" for key in part.keys)
        raise InputError(
            f"{named}: {part.what} would take about {_readable(part.size)} of memory; expected at "
            f"most the {_readable(limit)} of this machine; lower the largest of these"
        )


def parts_of(settings: Settings, *pool_shape: int) -> Iterator[Part]:
    """What a run keeps in memory, estimated."""
    pool, task, setup = settings["pool"], settings["task"], settings["setup"]
    n_queries, n_options, n_features = pool_shape or (pool["size"], pool["options"], N_FEATURES)
    of_task = pool["train"] is None
    sizes = ("pool.size", "pool.options") if of_task else ()
    if of_task:
        length = task.get("length", 1)
        # What is no number is refused later, by the task.
        walks = 150.0 * pool["size"] * pool["options"] * (length if type(length) is int else 1)
        yield Part("the pools", walks, (*sizes, "task.length"))
    samples = settings["belief"].get("samples", 100)
    budget, offers = setup["budget"], _offers(settings)
    beliefs = ("belief.samples", "setup.budget")
    if "training" in settings:
        training = settings["training"]
        stages = training["stages"] if training["problems"] == "one" else 1
        steps, _ = steps_and_stages(training["steps"], stages, offers or budget)
        frames = training["sessions"] * steps
        kept = 36.0 * samples * n_features
        n_answers, _, _ = sizes_of(settings, n_options)
        kept += 5.0 * (budget * (16 + 4 * n_answers) + 8 * offers + 100)
        kept += 20.0 * _rows_shown(settings) * (n_features + 1)
        kept += _shown(settings, n_queries, n_options, n_features)
        own = "setup.offers" if setup["name"] == "feed" else "setup.candidates"
        keys = ("training.sessions", "training.steps", "training.stages", *beliefs, *sizes, own)
        yield Part("training", frames * kept, keys)
        yield Part("the processes", PROCESS * n_processes(settings), ("training.processes",))
    humans = settings["evaluation"]["humans"]
    if settings.get("protocol") is not None:
        humans = HELD_OUT * settings["workers"]
    each = 64.0 * samples * n_features + 220.0 * n_queries
    each += 2.5 * max(offers, budget) * (16 * budget + 50)
    counts = "evaluation.humans" if settings.get("protocol") is None else "workers"
    yield Part("the evaluation", humans * each, (counts, *beliefs, *sizes))
    batch = setup.get("batch", 1)
    if batch > 1:
        probs = min(n_queries, SHORTLIST * batch) * samples * sizes_of(settings, n_options)[0]
        yield Part("choosing a batch", 24.0 * probs, ("setup.batch", "belief.samples", *sizes))
    yield from _belief_parts(settings, n_options, n_features)


def sizes_of_parts(sessions: int, processes: int) -> list[int]:
    """B, in as many parts as there are to be processes, or as many as are worth it."""
    count = max(1, min(processes, sessions // FEWEST))
    return [sessions // count + (part < sessions % count) for part in range(count)]


def steps_and_stages(steps: int | None, stages: int, longest: int) -> tuple[int, int]:
    """T, and how many stages there are: one where a batch has whole sessions anyway.

    Args:
        steps, stages: as in the settings.
        longest: steps that a session may take.
    """
    steps = steps or -(-longest // stages)
    return steps, min(stages, -(-longest // steps))


def session_parts(settings: Settings) -> list[int]:
    """B of each part of a training's sessions, each of which a process may ask."""
    training = settings["training"]
    # Drawn problems are one after the other; what a GPU computes at once is best asked at once.
    together = training["problems"] == "drawn" or not settings["device"].startswith("cpu")
    return sizes_of_parts(training["sessions"], 1 if together else training["processes"])


def n_processes(settings: Settings) -> int:
    """Processes that ask at once, at most; of an evaluation it is one."""
    return len(session_parts(settings)) if "training" in settings else 1


def sizes_of(settings: Settings, n_options: int) -> tuple[int, int, int]:
    """How many answers there are, how many factors each has, and how many rows a factor."""
    size = SIZES.get(settings["question"]["name"])
    return (n_options, 1, n_options - 1) if size is None else size(n_options)


def _shown(settings: Settings, n_queries: int, n_options: int, n_features: int) -> float:
    """Bytes for each step of a training session that the queries on the table take."""
    if settings["setup"]["name"] == "feed":
        return 40.0 * n_options * n_features
    by_index = settings["policy"]["name"] == "paper"
    candidates = None if by_index else settings["setup"]["candidates"]
    each = 700.0 + 10 * n_options * n_features
    if settings["policy"]["name"] == "attention":
        each += 2500.0 * n_options
    return min(n_queries, candidates or n_queries) * each


LEAST_SAMPLES = 8
"""M of a belief: fewer are too few to tell each other where to move."""


def default_moves(n_features: int) -> int:
    """V of a belief whose ``moves`` is None.

    With many features 100 samples tell less and less well where they spread, and a walk in a cone
    is longer: of the order of D³ (Lovász and Vempala, *Hit-and-run from a corner*, 2006).
    """
    return max(4, n_features, n_features**2 // 8, n_features**3 // 128)


def laplace_numbers(samples: int, n_rows: int, n_features: int) -> int:
    """Numbers of the matrices of a session that ``beliefs.laplace`` makes, of G rows: G times G and
    G times D, and M times each."""
    return (n_rows + samples) * (n_rows + n_features)


def _belief_parts(settings: Settings, n_options: int, n_features: int) -> Iterator[Part]:
    """What an update of the belief holds at once, for sessions in groups of so many samples."""
    belief, sessions = settings["belief"], settings.get("training", {}).get("sessions", 0)
    sessions = max(sessions, settings["evaluation"]["humans"])
    samples = belief.get("samples", 100)
    keys = ("belief.samples", "setup.budget", "pool.options", *SHOWN)
    n_answers, n_factors, n_rows = sizes_of(settings, n_options)
    if belief["name"] == "laplace":
        there = settings["setup"]["budget"] * n_factors * n_rows + _rows_shown(settings)
        each = laplace_numbers(samples, there, n_features)
        held = max(each, min(sessions * each, n_processes(settings) * LAPLACE_HELD))
        yield Part("the Gaussian of belief=laplace", 8.0 * LAPLACE_COPIES * held, keys)
    else:
        moves = belief.get("moves") or default_moves(n_features)
        at_once = max(samples, min(sessions * samples, n_processes(settings) * (MOVED // moves)))
        directions = 4.0 * (UNIFORMS * moves + 4 * n_features) * at_once
        yield Part("moving the belief", directions, ("belief.samples", "belief.moves"))
        answers = 8.0 * _padded_rows(settings, n_factors, n_rows) * at_once
        answers += 8.0 * n_options * n_answers * samples
        yield Part("the likelihood of the answers", answers, keys)
    if settings["objective"] == "entropy":
        distances = 8.0 * sessions * samples**2
        yield Part("objective=entropy", distances, ("belief.samples", "evaluation.humans"))


def _rows_shown(settings: Settings) -> int:
    """What a session's demonstrations were preferred to, taken together."""
    shown = settings["demonstrations"]
    return int(shown["count"] * shown["alternatives"])


def _padded_rows(settings: Settings, n_factors: int, n_rows: int) -> int:
    """Rows of a session's answers and demonstrations, all padded to the largest of them, as
    ``questions.prior_evidence.joined`` does."""
    shown = settings["demonstrations"]
    if shown["count"]:
        n_rows = max(n_rows, shown["alternatives"])
    return int((settings["setup"]["budget"] + shown["count"]) * n_factors * n_rows)


def _offers(settings: Settings) -> int:
    """O, 0 where queries are not offered."""
    setup = settings["setup"]
    if setup["name"] != "feed":
        return 0
    each_ask = 2 if settings["skip"] == "regret" else 5
    return setup["offers"] or each_ask * setup["budget"]


def machine_memory() -> int:
    """Bytes of memory that this process may use: the machine's, or its container's."""
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")] if _has_sysconf() else []
    for name in LIMIT_FILES:
        try:
            limits.append(int(Path(name).read_text()))
        except (OSError, ValueError):  # no container, or one without a limit
            continue
    return min(limits, default=2**40)


def _has_sysconf() -> bool:
    """Whether the system tells its memory in this way; Windows does not."""
    return "SC_PHYS_PAGES" in getattr(os, "sysconf_names", {})


def _value_of(settings: Settings, key: str) -> Any:
    """The value of a dotted key."""
    value: Any = settings
    for name in key.split("."):
        value = value.get(name)
    return "null" if value is None else value


def _readable(size: float) -> str:
    """Bytes in GB, to two digits."""
    return f"{float(f'{size / 1e9:.2g}'):g} GB" if size < 1e15 else "more than a million GB"
