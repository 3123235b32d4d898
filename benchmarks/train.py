"""A2C on the feed: our ``Trainer`` beside Stable-Baselines3's A2C, in frames per CPU second.

``python benchmarks/train.py`` (needs ``pip install -e ".[bench]"``). Both learn the paper's feed
with the same constants. Ours steps all sessions of ``FeedEnv`` as one tensor; Stable-Baselines3
runs its NumPy twin (``numpy_feed.py``), one human an environment, in its ``DummyVecEnv``.

A pair first learns, in turns, until it asks nearly everything, as the paper's reward teaches; that
time is one column (of one seed: a rough number). Stable-Baselines3's orthogonal initialisation
takes about twice our updates; with torch's, which is ours, it takes as many. Frames per second are
timed after that, as what a frame costs depends on how often the human is asked.

Shapes: B environments (sessions), H query budget.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder's select.py hides Python's

import importlib.util
import math
import time
from collections import deque
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf

from benchmarks import common
from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.objectives import alignment
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.policies.paper import paper_policy
from torchrl_pref.questions.responses import Boltzmann
from torchrl_pref.strategies import RandomAsk
from torchrl_pref.training.a2c import A2C
from torchrl_pref.training.sessions import Sessions
from torchrl_pref.training.settings import TrainingSettings
from torchrl_pref.training.trainer import Trainer

COUNTS = (1, 8, 64, 256)
PAPER = Path(__file__).parents[1] / "conf" / "experiment" / "paper.yaml"
BUDGET = 20
STEPS = 5
BLOCK = BUDGET // STEPS
"""Updates in turn: as many as a session lasts in which everything is asked."""

SHORT = 22
"""Mean length of the sessions that counts as "asks everything"; the least is H = 20."""

HUMANS = 100
"""Who the twin is checked on."""


class Ours:
    """This package's trainer on B sessions, with the constants of ``experiment=paper``."""

    def __init__(self, n_envs: int) -> None:
        constants = {**OmegaConf.load(PAPER).training, "sessions": n_envs, "steps": STEPS}
        env = make_env(n_envs)
        torch.manual_seed(0)
        algorithm = A2C(paper_policy(env), TrainingSettings(**constants))
        self.trainer = Trainer(Sessions(env, algorithm.policy, STEPS), algorithm, seed=0)

    def advance(self, updates: int) -> list[int]:
        """Collect and update so often; the lengths of the sessions that ended meanwhile."""
        lengths: list[int] = []
        for _ in range(updates):
            batch = self.trainer.sessions.collect()
            self.trainer.update(batch)
            ended = batch["next", "done"]
            lengths += batch["next", "step_count"][ended].tolist()
        return lengths


class Theirs:
    """Stable-Baselines3's A2C as it comes, on B NumPy environments; imported only where needed."""

    def __init__(self, n_envs: int) -> None:
        from stable_baselines3 import A2C
        from stable_baselines3.common.logger import Logger
        from stable_baselines3.common.vec_env import DummyVecEnv

        environments = DummyVecEnv([make_twin] * n_envs)
        self.model = A2C("MlpPolicy", environments, n_steps=STEPS, seed=0, device="cpu")
        self.model.set_logger(Logger(None, []))  # else every call of learn() makes a folder
        self.frames = STEPS * n_envs

    def advance(self, updates: int) -> list[int]:
        """Collect and update so often; the lengths of the sessions that ended meanwhile."""
        lengths: list[int] = []

        def note(step: dict[str, Any], _: dict[str, Any]) -> bool:
            lengths.extend(step["infos"][i]["length"] for i in np.flatnonzero(step["dones"]))
            return True

        never = updates + 1
        self.model.learn(updates * self.frames, note, never, reset_num_timesteps=False)
        return lengths


def make_env(n_envs: int) -> FeedEnv:
    """Our environment, B sessions."""
    model = Boltzmann(common.TAU)
    pool, human = common.normalised_pool(), SimulatedHuman(model)
    paper: dict[str, Any] = {"skip": "regret", "objective": "information_gain"}
    return FeedEnv(pool, human, Belief(model), BUDGET, 2 * BUDGET, batch_size=(n_envs,), **paper)


@cache
def twin_arguments() -> tuple[Any, ...]:
    """What a twin is made with; all share one pool."""
    belief = Belief(Boltzmann(common.TAU))
    pool = common.normalised_pool().features.double().numpy()
    return pool, common.TAU, belief.n_samples, 4, BUDGET


def make_twin() -> Any:
    """The same in NumPy, for one human."""
    from benchmarks.numpy_feed import NumpyFeed

    return NumpyFeed(*twin_arguments())


def check_twin() -> str:
    """Ask the same humans the same queries in both environments; a line on how they compare.

    Raises:
        AssertionError: mean alignment or reward differ by more than chance would have it.
    """
    env, twin = make_env(HUMANS), make_twin()
    start = env.reset()
    steps = env.rollout(BUDGET, RandomAsk(), auto_reset=False, tensordict=start)["next"]
    reached = alignment(steps["samples"][:, -1], start["human", "omega"])
    total = torch.cat([reached, steps["reward"].sum(1)], -1)
    ours, theirs = total.double().numpy(), np.zeros((HUMANS, 2))
    for i in range(HUMANS):
        given = {key: start["human", key][i].double().numpy() for key in ("omega", "noise")}
        twin.reset(seed=i, options={**given, "offers": start["offers"][i].numpy()})
        for _ in range(BUDGET):
            _, reward, _, _, info = twin.step(1)
            theirs[i, 1] += reward
        theirs[i, 0] = info["alignment"]
    apart, error = (ours - theirs).mean(0), (ours - theirs).std(0) / math.sqrt(HUMANS)
    assert (np.abs(apart) < 4 * error + 1e-3).all(), f"the twin is wrong: {apart} ± {error}"
    pairs = [f"{a:.3f} and {b:.3f}" for a, b in zip(ours.mean(0), theirs.mean(0), strict=True)]
    return (
        f"FeedEnv and its twin, {HUMANS} humans who are asked every offer: mean alignment "
        f"{pairs[0]} (standard error of the difference {error[0]:.3f}), mean reward {pairs[1]}"
    )


def learn(learners: Sequence[Ours | Theirs], n_envs: int, limit: float) -> list[float]:
    """CPU seconds of each until its sessions are short; infinite where the limit came first."""
    seconds, spent = [math.inf] * len(learners), [0.0] * len(learners)
    # Wide enough that every environment counts, or the first to end, the short ones, would be all.
    recent: list[deque[int]] = [deque(maxlen=max(100, n_envs)) for _ in learners]
    going = list(range(len(learners)))
    while going:
        for i in going:
            start = time.process_time()
            recent[i].extend(learners[i].advance(BLOCK))
            spent[i] += time.process_time() - start
            if len(recent[i]) == recent[i].maxlen and np.mean(recent[i]) <= SHORT:
                seconds[i] = spent[i]
        going = [i for i in going if math.isinf(seconds[i]) and spent[i] < limit]
    return seconds


def compare(n_envs: int, options: Any) -> list[float]:
    """Frames per CPU second of both at B environments, and seconds to learn of both."""
    ours, theirs = Ours(n_envs), Theirs(n_envs)
    ours.advance(1), theirs.advance(1)  # warm-up
    seconds = learn((ours, theirs), n_envs, options.limit)
    updates = max(BLOCK, 32 // n_envs)  # a block of few environments is too short to time
    cases = {"ours": lambda: ours.advance(updates), "theirs": lambda: theirs.advance(updates)}
    times = common.paired(cases, options.repeats)
    frames = updates * STEPS * n_envs
    return [frames / times["ours"], frames / times["theirs"], *seconds]


def main() -> None:
    """Print the table."""
    parser = common.arguments(__doc__)
    parser.set_defaults(repeats=3)
    parser.add_argument("--limit", type=float, default=60, help="CPU s to learn in (default 60)")
    options = common.start(parser)
    needed = ("stable_baselines3", "gymnasium")
    missing = [name for name in needed if importlib.util.find_spec(name) is None]
    if missing:
        print(f'not installed: {", ".join(missing)}; pip install -e ".[bench]"', file=sys.stderr)
        sys.exit(2)
    print(check_twin())
    results = np.array([compare(n_envs, options) for n_envs in COUNTS])
    results = np.vstack([results, [*results[:, :2].max(0), *results[:, 2:].min(0)]])
    names = ["1 (SB3's default)", *COUNTS[1:], "best of column"]
    rows = []
    for name, (ours, theirs, *seconds) in zip(names, results, strict=True):
        row = {"environments": name, "ours, frames/s": ours, "SB3, frames/s": theirs}
        row["ours / SB3"] = ours / theirs
        for who, took in zip(("ours", "SB3"), seconds, strict=True):
            late = f"not within {options.limit:g} s"
            row[f"{who}, s to learn"] = took if math.isfinite(took) else late
        rows.append(row)
    learned = f"learned: sessions have {SHORT} offers or less"
    common.report(f"A2C on the feed, per CPU second ({learned})", rows, options.json)


if __name__ == "__main__":
    main()
