"""A training: sessions are asked, an algorithm learns from them, and what came of it is logged.

Shapes: B sessions side by side, T steps of each in a batch.
"""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.objectives.value import GAE
from tqdm import tqdm

from torchrl_pref.checkpoints.restore import (
    restore_generator,
    restore_optimizer,
    restore_weights,
)
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.envs.session import is_feed
from torchrl_pref.policies.base import Policy
from torchrl_pref.training.actor_critic import ActorCritic
from torchrl_pref.training.drawn import DrawnSessions
from torchrl_pref.training.loggers import opened
from torchrl_pref.training.parts import SessionParts
from torchrl_pref.training.progress import Progress
from torchrl_pref.training.sessions import Sessions
from torchrl_pref.training.settings import TrainingSettings

OF_EPISODES = {
    "train/alignment": "alignment",
    "train/episode_length": "step_count",
    "train/reward": "episode_reward",
}
"""What is averaged over the episodes that end in a batch, by the key that holds it."""


class Trainer:
    """The state of a training run, and the loop.

    Args:
        sessions: where to learn, see :mod:`torchrl_pref.training.sessions`.
        algorithm: how the policy that asks in them learns.
        seed: fixes the actions; the sessions have seeds of their own. On the CPU they fix every
            bit.
    """

    def __init__(
        self, sessions: Sessions | SessionParts | DrawnSessions, algorithm: ActorCritic, seed: int
    ) -> None:
        torch.manual_seed(seed)
        self.sessions, self.algorithm = sessions, algorithm
        self.policy: Policy = algorithm.policy
        self.settings: TrainingSettings = algorithm.settings
        self.progress = Progress()
        self.start_average()
        self.advantage = GAE(
            gamma=self.settings.gamma,
            lmbda=self.settings.lmbda,
            value_network=None,  # the values come with the batch
            vectorized=False,
        )

    @property
    def env(self) -> QueryEnv | FeedEnv:
        """Where the policy asks at present."""
        return self.sessions.env

    def run(
        self,
        folder: Path,
        save: Callable[[], None],
        measure: Callable[[], None] = lambda: None,
        logger: Sequence[str] = ("csv", "tensorboard"),
    ) -> None:
        """Train until the last update. Ctrl-C and SIGTERM take effect once the update that they
        came in is done and saved.

        Args:
            folder: where the logs go.
            save: called every ``save_every`` updates, at the end and before a stop.
            measure: called at the start and after each update; it may add to the progress what the
                policy does elsewhere, and must leave the training as it is.
            logger: names of what logs, see :mod:`torchrl_pref.training.loggers`.

        Raises:
            InputError: a logger does not start.
            KeyboardInterrupt: at Ctrl-C; at SIGTERM whatever the process does then.
        """
        settings, progress = self.settings, self.progress
        bar = tqdm(total=settings.updates, initial=progress.update, desc="training", unit="update")
        logs_of = opened(logger, folder, self.sessions.frames)
        left = progress.update < settings.updates
        apart = self.sessions.apart() if left else nullcontext()
        with bar, _stop_request() as stopped, logs_of as logs, apart:
            measure()
            logs.start(progress)
            while progress.update < settings.updates and not stopped():
                self._advance()
                measure()
                logs.add(progress)
                bar.update()
                bar.set_postfix(_latest(progress.history), refresh=False)
                if progress.update % settings.save_every == 0:
                    save()
            save()

    def _advance(self) -> None:
        """Ask, learn, and note in the progress how it went."""
        start = time.perf_counter()
        batch = self.sessions.collect(self.progress.update)
        learned = self.update(batch)
        self.progress.update += 1
        metrics = {f"train/{name}": value for name, value in learned.items()}
        metrics |= _episode_metrics(batch)
        metrics["train/explained_variance"] = _explained_variance(batch)
        metrics["train/share_asked"] = math.nan  # the query setup offers nothing to skip
        if is_feed(self.env):
            metrics["train/share_asked"] = batch["action"].float().mean().item()
        metrics["time/frames_per_second"] = batch.numel() / (time.perf_counter() - start)
        for name, values in self.progress.history.items():
            values.append(metrics[name])

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from a batch (B T) of transitions.

        Returns:
            What the algorithm tells of its steps, the ``entropy`` of the policy that acted in the
            batch (nats, the mean over its steps) and the ``learning_rate``.
        """
        if getattr(self.env, "skip", None) == "free":
            # A free skip takes none of the human's time: gamma discounts by the question.
            batch["steps_to_next_obs"] = batch["next", "n_asked"] - batch["n_asked"]
        with torch.no_grad():
            self.advantage(batch)
        flat = batch.reshape(-1)
        entropy = self.algorithm.acted(flat).entropy().mean().item()
        only_critic = self.progress.update < self.settings.warm_up
        rate = self.algorithm.optimizer.param_groups[0]["lr"]
        told = {"entropy": entropy, "learning_rate": rate}
        told |= self.algorithm.learn(flat, only_critic)
        self.algorithm.fit_critic(flat)
        for average, weight in zip(self.average.values(), self._weights.values(), strict=True):
            average.lerp_(weight, 1 - self.settings.average)
        return told

    def start_average(self) -> None:
        """Begin the average of the weights with what the policy holds now."""
        self._weights = self.policy.weights.state_dict()  # they change where they are
        self.average = {name: weight.clone() for name, weight in self._weights.items()}

    def state_dict(self) -> dict[str, Any]:
        """Plain data and tensors that :meth:`load_state_dict` goes on from, bit for bit."""
        return {
            **self.progress.state_dict(),
            "weights": self.policy.weights.state_dict(),
            "optimizer": self.algorithm.optimizer.state_dict(),
            "sessions": self.sessions.state_dict(),
            "env_generator": self.sessions.generator.get_state(),
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
        restore_optimizer(self.algorithm.optimizer, state["optimizer"]["state"])
        self.sessions.load_state_dict(state["sessions"])
        restore_generator(self.sessions.generator, state["env_generator"])
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
    """The last number of some metrics, for the progress bar."""
    latest = {}
    for name in (*OF_EPISODES, "train/explained_variance", "time/frames_per_second"):
        known = (value for value in reversed(history[name]) if not math.isnan(value))
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
