"""What is slow the first time, done once in the fork server of ``scripts.py``, before it forks.

Machine code is loaded, and what is imported late. No thread is started, which a fork would not
have, and random numbers go on from where they would have begun.
"""

from __future__ import annotations

import gc
import io

import hydra  # noqa: F401
import torch
import torch.utils.tensorboard
from hydra.core.plugins import Plugins
from matplotlib import pyplot as plt

import torchrl_pref.evaluation.reports
import torchrl_pref.pretrained
import torchrl_pref.training.figure
import torchrl_pref.training.learning_curve
import torchrl_pref.training.start  # noqa: F401
from torchrl_pref.acquisition.functions import alignment_gain
from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.evaluation.run import draw_humans, evaluate
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.questions.responses import Boltzmann
from torchrl_pref.strategies import Greedy, QuantileAsk
from torchrl_pref.tasks.gridworld import gridworld_pool


def warm_up() -> None:
    """Ask a few humans a question or two, and draw an empty figure."""
    Plugins.instance()
    model, pool = Boltzmann(2.0), gridworld_pool(8)
    some = pool, SimulatedHuman(model), Belief(model, 10, 1), 2
    query, feed = (kind(*some, batch_size=(3,), seed=0) for kind in (QueryEnv, FeedEnv))
    for env, strategy in (
        (query, Greedy(model)),
        (query, Greedy(model, alignment_gain)),
        (feed, QuantileAsk(feed)),
        (feed, QuantileAsk(feed, alignment_gain)),
    ):
        evaluate(env, strategy, draw_humans(env))
    figure, axis = plt.subplots(layout="constrained")
    axis.set(title="0", xlabel="0")
    figure.savefig(io.BytesIO())
    plt.close(figure)


with torch.random.fork_rng(devices=[]):
    warm_up()
gc.collect()
gc.freeze()  # forks need not look through it, nor copy it
