"""What a policy does with held-out humans while it is in training.

Every evaluation faces the same humans with the same luck, as does the baseline, so that all
differences are paired. They are neither those of the training nor those of the final evaluation.
"""

from __future__ import annotations

from functools import cached_property

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_pref.acquisition.functions import alignment_gain
from torchrl_pref.build import make_policy, make_training_env
from torchrl_pref.checkpoints.checkpoint import picks_by_index
from torchrl_pref.config.sections import Settings
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.envs.session import is_feed
from torchrl_pref.evaluation.comparison import check_evaluation
from torchrl_pref.evaluation.run import draw_humans, evaluate
from torchrl_pref.policies.base import Policy
from torchrl_pref.problem import Problem
from torchrl_pref.strategies import Greedy, QuantileAsk
from torchrl_pref.training.trainer import Trainer

HUMANS = 100
"""At most: all evaluations of a training together are to take a small part of its time."""

LAST_SEED = 2**32 - 1
"""Counted down from here, no seed is that of a training or of a final evaluation."""


class LearningCurve:
    """Evaluates the moving average of a training's weights, which is what is saved in the end.

    The environment is that of the training but for the humans and the pool, which is held out; a
    policy that picks an index keeps its own. In the query setup as many candidates are on the table
    as in training, so that the time does not grow with the pool.

    Args:
        settings: of the run; ``evaluation.during`` says how often: at the start and so many times
            more, evenly spaced, up to the last update; 0 is never.
        task: the pools and the response model.
        trainer: whose progress is added to.

    Raises:
        InputError: a setting is out of range.
    """

    def __init__(self, settings: Settings, task: Problem, trainer: Trainer) -> None:
        n_humans, _ = check_evaluation(settings)
        self.times = settings["evaluation"]["during"]
        self.n_humans, self.seed = min(n_humans, HUMANS), LAST_SEED - settings["evaluation"]["seed"]
        self.settings, self.task, self.trainer = settings, task, trainer

    def measure(self) -> None:
        """Evaluate if it is time, and at first the baseline too; the training is not disturbed."""
        progress = self.trainer.progress
        if not self._due(progress.update) or progress.update in progress.held_out:
            return
        cuda = [self.trainer.env.device] if self.trainer.env.device.type == "cuda" else []
        with torch.random.fork_rng(cuda):
            if progress.baseline is None:
                name, baseline = self._baseline
                progress.baseline = name, self._alignment(baseline, sample=False)
            _, policy, _ = self._made
            policy.weights.load_state_dict(self.trainer.average)
            sample = self.settings["policy"]["sample"]
            progress.held_out[progress.update] = self._alignment(policy.strategy, sample)

    def _due(self, update: int) -> bool:
        """Whether an evaluation belongs after so many updates."""
        updates = self.trainer.settings.updates
        if update == 0:
            return self.times > 0
        return update * self.times // updates > (update - 1) * self.times // updates

    @cached_property
    def _made(self) -> tuple[QueryEnv | FeedEnv, Policy, TensorDictBase]:
        """The environment, a policy to hold the average, and the humans."""
        pool = self.task.train if picks_by_index(self.settings) else self.task.test
        env = make_training_env(self.settings, self.task, pool, self.n_humans, self.seed)
        return env, make_policy(self.settings, env), draw_humans(env)

    @property
    def _baseline(self) -> tuple[str, TensorDictModuleBase]:
        """The strongest strategy that learns nothing, by the name that reports know it by."""
        env, _, _ = self._made
        if is_feed(env):
            return "quantile", QuantileAsk(env, alignment_gain)
        return "greedy alignment", Greedy(self.task.response_model, alignment_gain)

    def _alignment(self, strategy: TensorDictModuleBase, sample: bool) -> Tensor:
        """(B), after the last query, with the same luck each time."""
        env, _, humans = self._made
        env.set_seed(self.seed)
        torch.manual_seed(self.seed)
        # A copy: a view would put the whole curve into the checkpoint.
        return evaluate(env, strategy, humans, sample).alignment[:, -1].clone()
