import math

import pytest
import torch
from conftest import RESPONSE_MODELS
from helpers import ENVS, make, session_of
from torch import Generator
from torch.nn import functional as F
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_pref.acquisition.functions import alignment_gain, information_gain, volume_removal
from torchrl_pref.acquisition.scoring import predict_answers
from torchrl_pref.beliefs.resampling import covariance_of
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.objectives import make_objective
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.policies.attention import TOKENS, attention_policy, belief_tokens
from torchrl_pref.policies.base import Policy, belief_summary
from torchrl_pref.policies.paper import paper_policy
from torchrl_pref.policies.scorer import (
    FEED_SCALE,
    PATIENCE_SCALE,
    CandidateFeatures,
    OfferScorer,
    scorer_policy,
)
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.strategies import QuantileAsk


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


@pytest.mark.parametrize("objective", ["alignment", "information_gain"])
@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_scorer_starts_as_the_greedy_strategy_of_its_objective(
    model: ResponseModel, objective: str, pool: QueryPool
) -> None:
    env = make(QueryEnv, pool, model, batch=20, objective=objective)
    session = session_of(env)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        chosen = scorer_policy(env).strategy(session.clone())["action"]
    forecast = make_objective(objective).forecast(
        session["session"], session["human"], session["queries"], model
    )
    rows = torch.arange(20)
    assert torch.allclose(forecast[rows, chosen], forecast.amax(1), atol=1e-5)


RULES = {
    None: (information_gain, alignment_gain),
    "information_gain": (information_gain, None),
    "alignment": (alignment_gain, None),
}


@pytest.mark.parametrize("start", RULES)
@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_offer_scorer_starts_as_a_quantile_rule(
    model: ResponseModel, start: str | None, pool: QueryPool
) -> None:
    env = make(FeedEnv, pool, model, batch=50, skip="free")
    data = env.rollout(12, QuantileAsk(env, *RULES[start]), break_when_any_done=False)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        learned = scorer_policy(env, start).strategy(data.clone().reshape(-1))["action"]
    # With answers that never err, many queries split the samples alike; rounding orders them.
    assert (learned == data["action"].reshape(-1)).float().mean() > 0.99
    assert 0.05 < data["action"].float().mean() < 0.95


def with_patience(policy: Policy, *patience: float) -> Policy:
    """The same policy, its patience set: for later asks, and for a belief that is unsure."""
    with torch.no_grad():
        for name, weight in policy.weights.named_parameters():
            if name.endswith("patience"):
                weight.copy_(torch.tensor(patience))
    return policy


def test_patience_asks_early_and_waits_late(pool: QueryPool) -> None:
    env = make(FeedEnv, pool, batch=200, skip="free")
    policy, session = scorer_policy(env), session_of(env)
    before = policy.strategy(session.clone())["logits"]
    after = with_patience(policy, 0.05, 0.0).strategy(session.clone())["logits"]
    assert (after[:, 1] > before[:, 1]).all()
    # The last ask gets no more of the offers than the rule gives it.
    session["n_asked"].fill_(env.budget - 1)
    late = policy.strategy(session.clone())["logits"]
    rule = with_patience(policy, 0.0, 0.0).strategy(session)["logits"]
    assert torch.allclose(late, rule, atol=1e-5)


def test_patience_grows_the_share_by_how_late_the_asks_left_are(pool: QueryPool) -> None:
    """With asks 3, 4 and 5 left of five, the next is number 3 and the mean number is 4."""
    env = make(FeedEnv, pool, batch=30, offers=40, skip="free")
    session = session_of(env)
    session["n_offered"].fill_(1)
    for asked in range(5):
        session["n_asked"].fill_(asked)
        rule = with_patience(scorer_policy(env), 0.0, 0.0).strategy(session.clone())["logits"]
        # A patience of one per unit of urgency multiplies the share by the quotient itself.
        policy = with_patience(scorer_policy(env), 1 / PATIENCE_SCALE, 0.0)
        logits = policy.strategy(session.clone())["logits"]
        to_come = range(asked + 1, 6)
        quotient = sum(to_come) / len(to_come) / to_come[0]
        share = len(to_come) / 39
        expected = FEED_SCALE * share * (quotient - 1)
        assert share * quotient < 1
        assert torch.allclose(logits[:, 1] - rule[:, 1], torch.tensor(expected), atol=1e-3)


def test_patience_shrinks_the_share_by_the_misalignment_that_is_left(pool: QueryPool) -> None:
    env = make(FeedEnv, pool, batch=30, offers=100, skip="free")
    session = session_of(env)
    rule = with_patience(scorer_policy(env), 0.0, 0.0).strategy(session.clone())["logits"]
    # A patience of one per unit of urgency multiplies the share by e times the misalignment.
    policy = with_patience(scorer_policy(env), 0.0, 1 / PATIENCE_SCALE)
    logits = policy.strategy(session.clone())["logits"]
    left = 1 - session["samples"].mean(1).square().sum(-1)
    assert left.amin() < 0.8
    share = (env.budget - session["n_asked"]) / (env.n_offers - session["n_offered"])
    expected = FEED_SCALE * share.squeeze(-1) * (math.e * left - 1)
    assert torch.allclose(logits[:, 1] - rule[:, 1], expected, atol=1e-3)


@pytest.mark.parametrize("left", [1, 2, 5])
def test_the_last_offers_are_asked_whatever_was_learned(left: int, pool: QueryPool) -> None:
    """With as many offers left as asks, each must be asked; with one offer more, none must."""
    env = make(FeedEnv, pool, batch=10, offers=12, skip="free")
    policy = scorer_policy(env)
    with torch.no_grad():  # the correction of the logits: skip, by far
        next(m for m in policy.actor.modules() if isinstance(m, OfferScorer)).network[-1].bias -= 20
    session = session_of(env)
    # Of two options that are alike nothing can be learned: no query of the pool is poorer.
    session["offer"] = pool.features[0, 0].expand_as(session["offer"]).clone()
    session["n_asked"].fill_(5 - left)
    for more, asks in ((0, 1), (1, 0)):
        session["n_offered"].fill_(12 - left - more)
        logits = policy.strategy(session.clone())["logits"]
        assert (logits.argmax(-1) == asks).all()
        assert (logits.softmax(-1)[:, asks] > 0.99).all()


def test_patience_waits_when_the_belief_is_sure(pool: QueryPool) -> None:
    env = make(FeedEnv, pool, batch=200, skip="free")
    policy, session = scorer_policy(env), session_of(env)
    sure = session.clone()
    # All samples near one another: the expected misalignment is far below 1/e.
    sure["samples"] = F.normalize(session["samples"][:, :1] + 0.1 * session["samples"], dim=-1)
    rule = [policy.strategy(each.clone())["logits"][:, 1] for each in (session, sure)]
    policy = with_patience(policy, 0.0, 0.05)
    after = [policy.strategy(each.clone())["logits"][:, 1] for each in (session, sure)]
    assert (after[0] > rule[0]).all()
    assert (after[1] < rule[1]).all()


@pytest.mark.parametrize("options", [2, 3])
def test_candidates_are_described_by_what_the_belief_knows(
    options: int, generator: Generator
) -> None:
    """Option by option: how far its return lies from the mean return of its query."""
    env = make(QueryEnv, QueryPool(torch.randn(9, options, 4, generator=generator)))
    session, model = session_of(env), env.belief.response_model
    found = CandidateFeatures(model)(session["samples"], session["queries"])
    for b, c in ((0, 0), (1, 4), (3, 8)):
        samples, features = session["samples"][b], session["queries"][b, c]
        predicted = predict_answers(samples[None], features[None, None], model)
        scores = [
            float(function(predicted, samples[None]))
            for function in (information_gain, alignment_gain, volume_removal)
        ]
        returns = samples @ features.T  # (M K)
        apart = returns - returns.mean(1, keepdim=True)
        variance = float(apart.var(0, correction=0).sum())
        scores += [variance**0.5, variance, float(apart.mean(0).norm())]
        scores.append(float((features - features.mean(0)).norm()))
        assert found[b, c].tolist() == pytest.approx(scores, abs=1e-4)


@pytest.mark.parametrize("n_features", [2, 3, 5])
def test_belief_is_summed_up_by_its_length_and_its_widths(
    n_features: int, generator: Generator
) -> None:
    """Samples around a given mean whose variances along turned axes are given."""
    variances = torch.tensor([0.5, 0.03, 0.002, 0.1, 0.009])[:n_features]
    cross = torch.cat([torch.eye(n_features), -torch.eye(n_features)])  # (2D D), variance 1/D
    turn = torch.linalg.qr(torch.randn(n_features, n_features, generator=generator)).Q
    mean = torch.linspace(0.1, 0.4, n_features)
    samples = mean + (cross * (n_features * variances).sqrt()) @ turn
    env = make(QueryEnv, QueryPool(torch.randn(9, 2, n_features, generator=generator)))
    session = session_of(env)
    session["samples"] = samples.repeat(4, 1, 1)
    session["remaining"] = torch.full((4, 1), 0.3)
    widths = torch.stack([variances.max(), variances.mean(), variances.min()]).log() / 4
    expected = torch.cat([mean.norm().unsqueeze(0), widths])
    assert torch.allclose(belief_summary(samples.unsqueeze(0))[0], expected, atol=1e-4)
    # A policy sees of samples where they point, and not how long they are.
    found = scorer_policy(env).strategy(session)["belief_features"][2]
    expected = belief_summary((samples / samples.norm(dim=-1, keepdim=True)).unsqueeze(0))[0]
    assert torch.allclose(found, torch.cat([torch.tensor([0.3]), expected]), atol=1e-4)


@pytest.mark.parametrize("kind", ENVS)
@pytest.mark.parametrize("tokens", TOKENS)
def test_attention_does_not_care_about_the_order_of_options_or_samples(
    kind: type, tokens: str, pool: QueryPool, generator: Generator
) -> None:
    env = make(kind, pool)
    policy = disturbed(attention_policy(env, tokens), generator)
    session = session_of(env)
    key = "queries" if kind is QueryEnv else "offer"
    swapped = session.clone()
    swapped[key] = session[key].flip(-2).contiguous()
    swapped["samples"] = session["samples"].flip(1).contiguous()
    logits, other = (policy.strategy(td)["logits"] for td in (session, swapped))
    assert torch.allclose(logits, other, atol=1e-4)
    assert logits.std() > 0.01


def test_attention_sees_no_more_than_its_tokens(generator: Generator) -> None:
    samples = torch.randn(3, 50, 4, generator=generator) + 1
    whitened = torch.linalg.solve_triangular(
        torch.linalg.cholesky(covariance_of(samples)),
        (samples - samples.mean(1, True)).mT,
        upper=False,
    )
    other = torch.randn(3, 50, 4, generator=generator)
    other = torch.linalg.solve_triangular(
        torch.linalg.cholesky(covariance_of(other)), (other - other.mean(1, True)).mT, upper=False
    )
    # Another sample of the same mean and covariance.
    twin = (torch.linalg.cholesky(covariance_of(samples)) @ other).mT + samples.mean(1, True)
    assert not torch.allclose(whitened, other, atol=0.1)
    for kind in ("mean", "covariance"):
        tokens = belief_tokens(samples, kind)
        assert torch.allclose(tokens.mean(1), samples.mean(1), atol=1e-4)
        assert torch.allclose(tokens, belief_tokens(twin, kind), atol=1e-3)
    spread = belief_tokens(samples, "covariance")
    expected = covariance_of(spread) * spread.shape[1] / 2
    assert torch.allclose(expected, covariance_of(samples), atol=1e-4)
    assert torch.equal(belief_tokens(samples, "samples"), samples)


@pytest.mark.parametrize("kind", ENVS)
@pytest.mark.parametrize("make_policy", [paper_policy, scorer_policy, attention_policy])
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
