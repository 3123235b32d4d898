import pytest
import torch
from torch import Generator

from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.objectives import alignment
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.errors import InputError
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.pool import QueryPool
from torchrl_pref.pretrained import FOLDER, SEEDS, pretrained_checkpoint, pretrained_policy
from torchrl_pref.questions.responses import Boltzmann, Optimal


@pytest.mark.parametrize("setup", ["query", "feed"])
@pytest.mark.parametrize("tau", [None, "noisy", "optimal"])
def test_policies_are_small_and_what_they_say(setup: str, tau: str | None) -> None:
    for seed in range(SEEDS):
        checkpoint = pretrained_checkpoint(setup, tau, seed)
        settings = checkpoint.settings
        assert (settings["setup"]["name"], settings["seed"]) == (setup, seed)
        assert checkpoint.of_every_task == (tau is None)
        assert tau is None or settings["tau"] == tau
        assert settings["objective"] == "alignment"
        assert (FOLDER / f"{setup}-{tau or 'every'}-{seed}.pt").stat().st_size < 60_000


@pytest.mark.parametrize("kind", [QueryEnv, FeedEnv])
@pytest.mark.parametrize("shape", [(50, 2, 4), (30, 3, 6)])
def test_they_work_on_any_pool(kind: type, shape: tuple[int, ...], generator: Generator) -> None:
    pool = QueryPool(torch.randn(shape, generator=generator))
    models = ("noisy", Boltzmann(3.0)), ("optimal", Optimal()), (None, Boltzmann(3.0))
    for tau, model in models:
        options = {"skip": "free"} if kind is FeedEnv else {}
        env = kind(
            pool,
            SimulatedHuman(model),
            Belief(model),
            4,
            batch_size=(40,),
            objective="alignment",
            seed=0,
            **options,
        )
        data = env.rollout(20, pretrained_policy(env, tau).strategy, break_when_any_done=False)
        asked = data["next", "n_asked"].squeeze(-1) == 4
        reached = alignment(data["next", "samples"], data["human", "omega"]).squeeze(-1)
        assert reached[asked].mean() > 0.3


def test_unknown_policies_are_refused() -> None:
    with pytest.raises(InputError, match="tau='loud'"):
        pretrained_checkpoint("query", "loud")
    with pytest.raises(InputError, match="seed=99: expected a whole number from 0 to 4"):
        pretrained_checkpoint("query", "noisy", 99)
    model = Boltzmann(3.0)
    pool = QueryPool(torch.rand(9, 2, 4))
    feed = FeedEnv(pool, SimulatedHuman(model), Belief(model), skip="regret", batch_size=(2,))
    with pytest.raises(InputError, match="skip='regret'"):
        pretrained_policy(feed, "noisy")
