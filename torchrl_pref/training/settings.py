"""The constants of a training, whichever algorithm learns."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_pref.errors import check_choice, check_count, check_positive, check_share


@dataclass(frozen=True)
class TrainingSettings:
    """The constants that every algorithm has.

    Attributes:
        updates: batches that are learned from, each of the sessions' next steps.
        sessions: B, humans questioned side by side.
        steps: T, steps of each session between two updates; None: as many as a session may take,
            divided by ``stages``.
        stages: at how many points, T steps apart, the sessions of a batch are; at most as many as
            T goes into a session. Of ``drawn`` problems each batch has whole sessions.
        optimizer: ``adam`` or ``rmsprop``.
        learning_rate: of the optimizer.
        gamma: discount of the reward for each step; where skips are free, for each question.
        lmbda: of generalised advantage estimation, for each step; 1 is the plain advantage.
        entropy: coefficient of the entropy bonus.
        critic: coefficient of the critic's squared error.
        critic_steps: gradient steps, at most, of the critic alone after each update, on as many
            parts of the batch. With few, the critic is for long far from the returns that it is to
            forecast, and what the policy learns is the critic's error.
        grad_norm: the gradient is clipped to this length.
        warm_up: updates, of the first, in which only the critic learns: a policy that starts from a
            good strategy is not to be judged by a critic that knows nothing.
        average: share of the old that the moving average of the weights keeps at each update; the
            average is what is saved and evaluated, as it is steadier. 0 averages nothing.
        save_every: updates between two checkpoints.
        processes: in so many parts the sessions are asked, each in a process of its own if there
            are cores for all, else in turn, with the same result; fewer where a part would have
            less than 64 sessions, or problems are ``drawn``.
        problems: ``one``, that of the run; or ``drawn``: another for each batch, drawn at random,
            see :mod:`torchrl_pref.training.drawn`.

    Raises:
        InputError: a constant is out of range.
    """

    updates: int
    sessions: int
    steps: int | None
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
    stages: int = 1
    processes: int = 1
    problems: str = "one"

    def __post_init__(self) -> None:
        check_choice("training.problems", self.problems, ("one", "drawn"))
        for name in ("updates", "sessions", "stages", "processes", "save_every"):
            check_count(f"training.{name}", getattr(self, name), 1)
        if self.steps is not None:
            check_count("training.steps", self.steps, 1)
        for name in ("critic_steps", "warm_up"):
            check_count(f"training.{name}", getattr(self, name), 0)
        for name in ("learning_rate", "critic", "grad_norm"):
            check_positive(f"training.{name}", getattr(self, name))
        for name in ("gamma", "lmbda", "entropy", "average"):
            check_share(f"training.{name}", getattr(self, name))
        check_choice("training.optimizer", self.optimizer, ("adam", "rmsprop"))
