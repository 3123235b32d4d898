"""Advantage actor-critic (A2C) on either environment, with TorchRL's GAE and loss.

Shapes: B sessions side by side, T steps of each in a batch.
"""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.utils import clip_grad_norm_
from torchrl.objectives import A2CLoss
from torchrl.objectives.value import GAE
from torchrl.record.loggers import get_logger
from tqdm import tqdm

from torchrl_pref.checkpoints.restore import (
    restore_generator,
    restore_optimizer,
    restore_sessions,
    restore_weights,
)
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.errors import check_choice, check_count, check_positive, check_share
from torchrl_pref.policies.base import Policy
from torchrl_pref.training.progress import Progress, add_row, start_table
from torchrl_pref.training.sessions import Sessions

OF_EPISODES = {
    "train/alignment": "alignment",
    "train/episode_length": "step_count",
    "train/reward": "episode_reward",
}
"""What is averaged over the episodes that end in a batch, by the key that holds it."""


@dataclass(frozen=True)
class A2CSettings:
    """The constants of A2C.

    Attributes:
        updates: batches; the policy takes one gradient step on each.
        sessions: B, humans questioned side by side.
        steps: T, steps of each session between two updates; None: as many as a session may take.
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

    def __post_init__(self) -> None:
        for name in ("updates", "sessions", "save_every"):
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


class Trainer:
    """The state of a training run, and the loop.

    Args:
        env: where to learn; its batch size is B.
        policy: what learns.
        settings: the constants of A2C.
        seed: fixes the actions; the environment has its own seed. On the CPU the two fix every bit.
    """

    def __init__(
        self, env: QueryEnv | FeedEnv, policy: Policy, settings: A2CSettings, seed: int
    ) -> None:
        torch.manual_seed(seed)
        self.env, self.policy, self.settings = env, policy, settings
        self.progress = Progress()
        self.start_average()
        self.advantage = GAE(
            gamma=settings.gamma,
            lmbda=settings.lmbda,
            value_network=None,  # the values come with the batch
            vectorized=False,
        )
        self.loss = A2CLoss(
            actor_network=policy.actor,
            critic_network=policy.value,
            entropy_coeff=settings.entropy,
            critic_coeff=settings.critic,
            loss_critic_type="l2",
        )
        self.optimizer: torch.optim.Optimizer
        if settings.optimizer == "adam":
            self.optimizer = torch.optim.Adam(self.loss.parameters(), settings.learning_rate)
        else:
            self.optimizer = torch.optim.RMSprop(
                self.loss.parameters(), settings.learning_rate, alpha=0.99, eps=1e-5
            )
        self.frames = settings.sessions * (settings.steps or env.max_steps)
        self.sessions = Sessions(env, policy, settings.steps or env.max_steps)

    def run(
        self, folder: Path, save: Callable[[], None], measure: Callable[[], None] = lambda: None
    ) -> None:
        """Train until the last update. Ctrl-C and SIGTERM take effect once the update that they
        came in is done and saved.

        Args:
            folder: where the logs go.
            save: called every ``save_every`` updates, at the end and before a stop.
            measure: called at the start and after each update; it may add to the progress what the
                policy does elsewhere, and must leave the training as it is.

        Raises:
            KeyboardInterrupt: at Ctrl-C; at SIGTERM whatever the process does then.
        """
        settings, progress = self.settings, self.progress
        table = folder / "training.csv"
        bar = tqdm(total=settings.updates, initial=progress.update, desc="training", unit="update")
        with bar, _stop_request() as stopped:
            measure()
            start_table(table, progress, self.frames)
            logger = get_logger(
                "tensorboard", logger_name=str(folder), experiment_name="tensorboard"
            )
            assert logger is not None
            while progress.update < settings.updates and not stopped():
                start = time.perf_counter()
                batch = self.sessions.collect()
                self.update(batch)
                progress.update += 1
                metrics = _episode_metrics(batch)
                metrics["train/explained_variance"] = _explained_variance(batch)
                metrics["time/frames_per_second"] = batch.numel() / (time.perf_counter() - start)
                for name, value in metrics.items():
                    progress.history[name].append(value)
                    if not math.isnan(value):
                        logger.log_scalar(name, value, step=progress.update)
                measure()
                add_row(table, progress, self.frames)
                bar.update()
                bar.set_postfix(_latest(progress.history), refresh=False)
                if progress.update % settings.save_every == 0:
                    save()
            save()

    def update(self, batch: TensorDictBase) -> None:
        """One A2C step on a batch (B T) of transitions, and the critic's own."""
        if getattr(self.env, "skip", None) == "free":
            # A free skip takes none of the human's time: gamma discounts by the question.
            batch["steps_to_next_obs"] = batch["next", "n_asked"] - batch["n_asked"]
        with torch.no_grad():
            self.advantage(batch)
        flat = batch.reshape(-1)
        losses = self.loss(flat)
        learning = "loss_critic" if self.progress.update < self.settings.warm_up else "loss_"
        total = sum(value for key, value in losses.items() if key.startswith(learning))
        self._descend(total)
        self._fit_critic(flat)
        for name, weight in self.policy.weights.state_dict().items():
            self.average[name].lerp_(weight, 1 - self.settings.average)

    def _fit_critic(self, flat: TensorDictBase) -> None:
        """Bring the critic nearer to the returns of a batch (BT), in one pass over it."""
        if self.settings.critic_steps:
            shown = flat.select(*self.policy.value.in_keys, "value_target")
            for part in torch.randperm(len(shown)).chunk(self.settings.critic_steps):
                self._descend(self.loss.loss_critic(shown[part])[0].mean())

    def _descend(self, loss: Tensor) -> None:
        """One step of the optimizer, for the weights that the loss depends on."""
        self.optimizer.zero_grad()
        loss.backward()
        clip_grad_norm_(self.loss.parameters(), self.settings.grad_norm)
        self.optimizer.step()

    def start_average(self) -> None:
        """Begin the average of the weights with what the policy holds now."""
        weights = self.policy.weights.state_dict()
        self.average = {name: weight.clone() for name, weight in weights.items()}

    def state_dict(self) -> dict[str, Any]:
        """Plain data and tensors that :meth:`load_state_dict` goes on from, bit for bit."""
        return {
            **self.progress.state_dict(),
            "weights": self.policy.weights.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "sessions": self.sessions.state_dict(),
            "env_generator": self.env.generator.get_state(),
            "global_generator": torch.get_rng_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where :meth:`state_dict` was taken; the average is what the policy holds now.

        Raises:
            InputError: the state was taken of another run.
        """
        self.start_average()
        restore_weights(self.policy.weights, state["weights"])
        self.progress = Progress.of(state)
        restore_optimizer(self.optimizer, state["optimizer"]["state"])
        now = self.sessions.now
        session = now.select(*self.env.state_spec.keys())
        restore_sessions(now, state["sessions"], session, len(self.env.features))
        restore_generator(self.env.generator, state["env_generator"])
        restore_generator(torch.default_generator, state["global_generator"])


def _episode_metrics(batch: TensorDictBase) -> dict[str, float]:
    """Means over the episodes that ended in a batch; NaN where none did."""
    done = batch["next", "done"]
    return {
        name: batch["next", key][done].float().mean().item() for name, key in OF_EPISODES.items()
    }


def _explained_variance(batch: TensorDictBase) -> float:
    """The share of the variance of the returns that the critic knew of: 1 is all, 0 nothing; a
    critic that only adds to it, as in the first updates, is never put below -1."""
    target, value = batch["value_target"], batch["state_value"]
    left = (target - value).var(correction=0) / target.var(correction=0).clamp(min=1e-12)
    return (1 - left).clamp(min=-1).item()


def _latest(history: dict[str, list[float]]) -> dict[str, str]:
    """The last number of each metric, for the progress bar."""
    latest = {}
    for name, values in history.items():
        known = (value for value in reversed(values) if not math.isnan(value))
        number = next(known, None)
        latest[name.split("/")[-1]] = "-" if number is None else f"{number:.3g}"
    return latest


@contextmanager
def _stop_request() -> Iterator[Callable[[], bool]]:
    """Hold the first Ctrl-C or SIGTERM back until the end of the block; says whether it came."""
    came: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    # What a process ignores, as one in the background Ctrl-C, is not meant for it.
    before = {n: handler for n, handler in before.items() if handler not in (signal.SIG_IGN, None)}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def request(number: int, frame: FrameType | None) -> None:
        came.append(number)
        restore()

    for number in before:
        signal.signal(number, request)
    try:
        yield lambda: bool(came)
    finally:
        restore()
    if came:
        signal.raise_signal(came[0])
