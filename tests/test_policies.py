import pytest
import torch
from conftest import RESPONSE_MODELS
from tensordict import TensorDictBase
from test_envs import ENVS, make
from torch import Generator
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_pref.envs import FeedEnv, QueryEnv
from torchrl_pref.errors import InputError
from torchrl_pref.policies import Policy, paper_policy, scorer_policy
from torchrl_pref.queries import QueryPool
from torchrl_pref.responses import ResponseModel
from torchrl_pref.strategies import Greedy, RandomAsk, RandomQuery


def session_of(env: QueryEnv | FeedEnv) -> TensorDictBase:
    """A session after one answer."""
    ask = RandomQuery() if isinstance(env, QueryEnv) else RandomAsk()
    return env.rollout(1, ask)[:, -1]["next"].exclude("reward")


def disturbed(policy: Policy, generator: Generator) -> Policy:
    """The same with weights that are not those of the start."""
    with torch.no_grad():
        for weight in policy.weights.parameters():
            weight += 0.3 * torch.randn(weight.shape, generator=generator)
    return policy


@pytest.mark.parametrize("options", [2, 3])
@pytest.mark.parametrize("kind", ENVS)
def test_scorer_does_not_care_which_option_comes_first(
    kind: type, options: int, generator: Generator
) -> None:
    pool = QueryPool(torch.randn(40, options, 4, generator=generator))
    env = make(kind, pool)
    policy = disturbed(scorer_policy(env), generator)
    session = session_of(env)
    key = "queries" if kind is QueryEnv else "offer"
    swapped = session.clone()
    swapped[key] = session[key].flip(-2).contiguous()
    logits, other = (policy.strategy(td)["logits"] for td in (session, swapped))
    assert torch.allclose(logits, other, atol=1e-3)
    assert logits.std() > 0.01


def test_scorer_works_on_a_pool_of_another_size_and_dimension(
    pool: QueryPool, generator: Generator
) -> None:
    policy = disturbed(scorer_policy(make(QueryEnv, pool)), generator)
    for shape in ((7, 2, 4), (90, 2, 6), (20, 4, 3)):
        env = make(QueryEnv, QueryPool(torch.randn(shape, generator=generator)))
        data = env.rollout(5, policy.strategy)
        assert data["logits"].shape == (4, 5, shape[0])
        assert data["logits"].isfinite().all()


@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_scorer_starts_as_greedy(model: ResponseModel, pool: QueryPool) -> None:
    env = make(QueryEnv, pool, model, batch=20)
    session = session_of(env)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        learned = scorer_policy(env).strategy(session.clone())
    greedy = Greedy(model)(session.clone())["action"]
    gain = learned["candidate_features"][..., 0]
    rows = torch.arange(20)
    assert torch.allclose(gain[rows, learned["action"]], gain[rows, greedy], atol=1e-6)


def test_offer_scorer_starts_undecided(pool: QueryPool) -> None:
    env = make(FeedEnv, pool)
    assert (scorer_policy(env).strategy(session_of(env))["logits"] == 0).all()


@pytest.mark.parametrize("kind", ENVS)
@pytest.mark.parametrize("make_policy", [paper_policy, scorer_policy])
def test_batch_equals_singles(
    make_policy: object, kind: type, pool: QueryPool, generator: Generator
) -> None:
    env = make(kind, pool)
    policy = disturbed(make_policy(env), generator)  # type: ignore[operator]
    session = session_of(env)
    together = policy.critic(policy.strategy(session.clone()))
    for b in range(4):
        alone = policy.critic(policy.strategy(session[b : b + 1].clone()))
        for key in ("logits", "state_value"):
            assert torch.allclose(together[key][b : b + 1], alone[key], atol=1e-4)


def test_paper_policy_sees_the_mean_and_the_offer_only(pool: QueryPool) -> None:
    assert set(paper_policy(make(QueryEnv, pool)).strategy.in_keys) <= {"mean", "action_mask"}
    assert set(paper_policy(make(FeedEnv, pool)).strategy.in_keys) == {"mean", "offer"}


def test_random_strategies_have_their_own_seeded_luck(pool: QueryPool) -> None:
    session = session_of(make(QueryEnv, pool, batch=2000))
    session["action_mask"][:, 5:] = False
    actions = RandomQuery(1)(session)["action"]
    assert actions.bincount(minlength=5).tolist() == pytest.approx([400] * 5, abs=5 * 18)
    assert torch.equal(actions, RandomQuery(1)(session)["action"])
    offers = session_of(make(FeedEnv, pool, batch=2000))
    assert float(RandomAsk(0.3)(offers)["action"].float().mean()) == pytest.approx(0.3, abs=0.05)
    assert (RandomAsk(1.0)(offers)["action"] == 1).all()
    with pytest.raises(InputError, match="probability=2"):
        RandomAsk(2)


def test_greedy_obeys_the_mask(pool: QueryPool) -> None:
    env = make(QueryEnv, pool, repeats=False)
    greedy = Greedy(RESPONSE_MODELS[0])
    asked = env.rollout(5, greedy)["next", "history", "queries"][:, -1]
    assert all(len(row.unique()) == 5 for row in asked)
