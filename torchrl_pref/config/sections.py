"""The settings of a run, section by section: which keys there are, and of what type.

Nothing here has a default: these stand in ``conf/`` alone, and what values are allowed in
``config.settings``. Settings come from Hydra or from a checkpoint, as nested dicts of plain values.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NotRequired, TypeAlias, TypedDict

Plain: TypeAlias = dict[str, Any]
"""Settings as they were composed or read: nobody has looked at them yet."""

GroupSection: TypeAlias = dict[str, Any]
"""The section of a group: its ``name``, and the arguments of what that stands for, which may be a
stranger's class."""


CODE = {"task": ("make", "features", "policy")}
"""By group, settings of what is in its table that name code of the user's, as ``module:name``."""


class PoolSection(TypedDict):
    """``pool``: where queries come from."""

    size: int
    options: int
    seed: int
    train: str | None
    test: str | None


class DemonstrationsSection(TypedDict):
    """``demonstrations``: what each human shows before the first question."""

    count: int
    alternatives: int
    tau: float | None


class EvaluationSection(TypedDict):
    """``evaluation``: on whom strategies are judged."""

    humans: int
    seed: int
    metrics: list[str]
    during: NotRequired[int]


class CostSection(TypedDict):
    """``cost``: how many seconds a question takes."""

    watch: float
    decide: float


class SetupSection(TypedDict):
    """``setup``: what the action is; which keys there are follows from its name."""

    name: str
    budget: int
    candidates: NotRequired[int | None]
    repeats: NotRequired[bool]
    batch: NotRequired[int]
    offers: NotRequired[int | None]
    on_skip: NotRequired[str]


class TrainingSection(TypedDict):
    """``training``: the constants of every algorithm."""

    problems: str
    updates: int
    sessions: int
    steps: int | None
    stages: int
    processes: int
    optimizer: str
    learning_rate: float
    gamma: float
    lmbda: float
    entropy: float
    critic: float
    critic_steps: int
    grad_norm: float
    warm_up: int
    average: float
    save_every: int


class Settings(TypedDict):
    """All of them, checked. What only one of the two scripts has need not be there."""

    tau: Any
    objective: str
    skip: str
    device: str
    threads: int
    pool: PoolSection
    evaluation: EvaluationSection
    demonstrations: DemonstrationsSection
    setup: SetupSection
    task: GroupSection
    question: GroupSection
    human: GroupSection
    belief: GroupSection
    policy: NotRequired[GroupSection]
    # Of train.py, and of a checkpoint.
    algorithm: NotRequired[GroupSection]
    training: NotRequired[TrainingSection]
    seed: NotRequired[int]
    overrides: NotRequired[list[str]]
    logger: NotRequired[list[str]]
    resume: NotRequired[str | None]
    # Of evaluate.py.
    protocol: NotRequired[str | None]
    tasks: NotRequired[str | list[str] | None]
    workers: NotRequired[int]
    strategy: NotRequired[str | list[str] | None]
    cost: NotRequired[CostSection]
    # Of both: a file to start from, or those to compare.
    checkpoint: NotRequired[Any]


def flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by their dotted keys."""
    found: dict[str, Any] = {}
    for key, value in settings.items():
        found |= (
            flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
        )
    return found
