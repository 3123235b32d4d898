import math

import numpy as np
import pytest
import torch
from conftest import RESPONSE_MODELS
from helpers import make, session_of
from torch import Generator, Tensor

from torchrl_pref.acquisition.functions import alignment_gain, information_gain
from torchrl_pref.acquisition.knowledge_gradient import KnowledgeGradient
from torchrl_pref.acquisition.pairs import max_regret
from torchrl_pref.acquisition.per_second import Cost, PerSecond
from torchrl_pref.acquisition.scoring import predict_answers, score_queries
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.objectives import make_objective
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.errors import InputError
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions.response_model import Prediction, ResponseModel
from torchrl_pref.questions.responses import Boltzmann, Optimal
from torchrl_pref.strategies import (
    FEED_STRATEGIES,
    STRATEGIES,
    Greedy,
    Lookahead,
    OfferRank,
    QuantileAsk,
    RandomAsk,
    RandomQuery,
    Thompson,
    ThresholdAsk,
    make_strategy,
)
from torchrl_pref.strategies.feed import REFERENCE


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


def test_greedy_asks_what_is_worth_most(pool: QueryPool) -> None:
    env = make(QueryEnv, pool, seed=0)
    session, model = env.reset(), env.belief.response_model
    values = score_queries(session["samples"], session["queries"], model, information_gain)
    assert torch.equal(Greedy(model)(session)["action"], values.argmax(-1))


@pytest.mark.parametrize("setup", [QueryEnv, FeedEnv])
@pytest.mark.parametrize("name", ["information_per_second", "alignment_per_second"])
def test_seconds_that_are_given_are_those_that_count(
    name: str, setup: type[QueryEnv | FeedEnv], pool: QueryPool
) -> None:
    env, slow = make(setup, pool, batch=300, seed=0), Cost(watch=0.1, decide=1000.0)
    session, own = env.reset(), {"information": information_gain, "alignment": alignment_gain}
    expected = PerSecond(own[name.split("_")[0]], slow)
    if setup is QueryEnv:
        by_hand = Greedy(env.belief.response_model, expected)(session.clone())["action"]
    else:
        by_hand = QuantileAsk(env, expected)(session.clone())["action"]
    asked = make_strategy(name, env, cost=slow)(session.clone())["action"]
    assert torch.equal(asked, by_hand)
    assert not torch.equal(asked, make_strategy(name, env)(session.clone())["action"])
    greedy = make_strategy("alignment_gain", env)(session.clone())["action"]
    counted = make_strategy("alignment_gain", env, cost=slow)(session.clone())["action"]
    assert torch.equal(greedy, counted)


def test_greedy_obeys_the_mask(pool: QueryPool) -> None:
    env = make(QueryEnv, pool, repeats=False)
    greedy = Greedy(RESPONSE_MODELS[0])
    asked = env.rollout(5, greedy)["next", "session", "history", "index"][:, -1]
    assert all(len(row.unique()) == 5 for row in asked)


def weighted_gain(probs: torch.Tensor, weights: torch.Tensor) -> float:
    """Information gain in bits of one query, probs (M R), under weighted samples (M)."""
    weights = weights / weights.sum()
    mean = (weights[:, None] * probs).sum(0)
    entropy = sum(-float(p) * math.log2(p) for p in mean if p > 0)
    for row, weight in zip(probs, weights, strict=True):
        entropy += float(weight) * sum(float(p) * math.log2(p) for p in row if p > 0)
    return entropy


@pytest.mark.parametrize("options", [2, 3])
@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_lookahead_agrees_with_brute_force(
    model: ResponseModel, options: int, generator: Generator
) -> None:
    pool = QueryPool(torch.randn(8, options, 4, generator=generator))
    env = make(QueryEnv, pool, model, batch=5)
    session = session_of(env)
    session["action_mask"][:, 5:] = False
    chosen = Lookahead(model, beam=8)(session.clone())["action"]
    assert (chosen < 5).all()
    last = session.clone()
    last["session", "history", "answers"][:, :4] = 0
    gain = make_objective("information_gain").forecast(
        last["session"], last["human"], last["queries"], model
    )
    final = Lookahead(model, beam=8)(last)["action"]
    assert torch.allclose(gain[range(5), final], gain[:, :5].amax(1), atol=1e-6)
    for b in range(5):
        samples, queries = session["samples"][b : b + 1], session["queries"][b : b + 1]
        probs = predict_answers(samples, queries, model).probs[0].double()
        values = []
        for first in probs[:5]:
            value = weighted_gain(first, torch.ones(20))
            for answer in first.unbind(-1):
                if answer.sum() > 0:
                    best = max(weighted_gain(second, answer) for second in probs[:5])
                    value += float(answer.mean()) * best
            values.append(value)
        assert values[int(chosen[b])] == pytest.approx(max(values), abs=1e-4)


def test_threshold_asks_above_it_and_at_the_end(pool: QueryPool) -> None:
    env = make(FeedEnv, pool, batch=30, skip="free")
    nothing = env.rollout(25, ThresholdAsk(env, 9.0))
    # 25 offers, 5 asks, no offer is worth 9 bits: the last five are asked.
    assert (nothing["action"][:, :20] == 0).all()
    assert (nothing["action"][:, 20:] == 1).all()
    data = env.rollout(5, ThresholdAsk(env, 0.2))
    for step in range(5):
        samples, offer = data["samples"][:, step], data["offer"][:, step]
        predicted = predict_answers(samples, offer.unsqueeze(1), env.belief.response_model)
        asks = information_gain(predicted, samples).squeeze(-1) >= 0.2
        assert torch.equal(data["action"][:, step] == 1, asks)


@pytest.mark.parametrize("left", [1, 2, 5])
def test_the_last_offers_are_asked_however_poor(left: int, pool: QueryPool) -> None:
    """With as many offers left as asks, each must be asked; with one offer more, none must."""
    env = make(FeedEnv, pool, batch=10, offers=12, skip="free")
    session = session_of(env)
    # Of two options that are alike nothing can be learned: no query of the pool is poorer.
    session["offer"] = pool.features[0, 0].expand_as(session["offer"]).clone()
    session["n_asked"].fill_(5 - left)
    rules = [ThresholdAsk(env, 0.5), QuantileAsk(env), QuantileAsk(env, alignment_gain)]
    rules.append(QuantileAsk(env, information_gain, late=alignment_gain))
    for more, asks in ((0, 1), (1, 0)):
        session["n_offered"].fill_(12 - left - more)
        for rule in rules:
            assert (rule(session.clone())["action"] == asks).all()


@pytest.mark.parametrize("left", [1.0, 0.25])
def test_rank_by_two_functions_weighs_them_by_the_asks_left(left: float, pool: QueryPool) -> None:
    env = make(FeedEnv, pool, batch=40, skip="free")
    first, model = env.reset(), env.belief.response_model
    weights = {information_gain: left, alignment_gain: 1 - left}
    rank_of, share = OfferRank(env, information_gain, alignment_gain), torch.full((40, 1), left)
    ranks = rank_of(first["samples"], first["offer"], share)
    for samples, offer, rank in zip(first["samples"], first["offer"], ranks, strict=True):
        queries = torch.cat([offer.unsqueeze(0), pool.features]).unsqueeze(0)
        predicted = predict_answers(samples.unsqueeze(0), queries, model)
        total = np.zeros(len(pool) + 1)
        for function, weight in weights.items():
            values = function(predicted, samples.unsqueeze(0))[0].double().numpy()
            total += weight * (values - values[1:].mean()) / values[1:].std()
        assert rank.item() == pytest.approx(
            ((total[0] > total[1:] + 1e-3).sum() + 0.5) / len(pool), abs=1e-6
        )
    # No query of the sample outranks itself: the best is above all but one.
    own = [rank_of(first["samples"], query.expand(40, -1, -1), share) for query in pool.features]
    highest = (len(pool) - 0.5) / len(pool)
    assert torch.stack(own).amax().item() == pytest.approx(highest, abs=1e-6)


def test_rank_is_that_among_the_whole_pool(generator: Generator) -> None:
    """Of a pool larger than the sample, whose first half teaches nothing."""
    features = torch.randn(2 * REFERENCE, 2, 4, generator=generator)
    features[:REFERENCE, 1] = features[:REFERENCE, 0]
    env = make(FeedEnv, QueryPool(features), batch=80, skip="free")
    offers = features[REFERENCE :: REFERENCE // 80][:80]
    rank = OfferRank(env, information_gain)(env.reset()["samples"], offers, torch.ones(80, 1))
    assert float(rank.mean()) == pytest.approx(0.75, abs=0.05)
    assert rank.amin() > 0.5


def test_rank_keeps_scores_only_while_the_belief_stays(pool: QueryPool) -> None:
    env = make(FeedEnv, pool, batch=40, skip="free")
    kept = OfferRank(env, information_gain)
    data = env.rollout(8, RandomAsk(0.5), break_when_any_done=False)
    asked = data["action"][:, :7] == 1
    assert asked.any()
    assert not asked.all()
    for step in data.unbind(1):
        now = step["samples"], step["offer"], torch.ones(40, 1)
        assert torch.equal(kept(*now), OfferRank(env, information_gain)(*now))
    few, left = data[:3, 0], torch.ones(3, 1)
    now = few["samples"], few["offer"], left
    assert torch.equal(kept(*now), OfferRank(env, information_gain)(*now))
    # Nothing but the offer is scored while no belief changes, and one session where one does.
    scored: list[tuple[int, ...]] = []

    def watched(predicted: Prediction, samples: Tensor) -> Tensor:
        scored.append(tuple(predicted.entropy.shape))
        return information_gain(predicted, samples)

    rank = OfferRank(env, watched)
    rank(*now)
    rank(*now)
    other = few["samples"].clone()
    other[1] = -other[1]
    rank(other, few["offer"], left)
    assert scored == [(3, len(pool)), (3, 1), (3, 1), (1, len(pool)), (3, 1)]


def test_quantile_rule_turns_from_one_value_to_the_other(pool: QueryPool) -> None:
    env = make(FeedEnv, pool, batch=200, skip="free")
    rule = QuantileAsk(env, information_gain, late=alignment_gain)
    rank = OfferRank(env, information_gain, late=alignment_gain)
    session = env.reset()
    for asked in range(5):
        session["n_asked"].fill_(asked)
        left = torch.full((200, 1), 1 - asked / 5)
        expected = rank(session["samples"], session["offer"], left) >= 1 - (5 - asked) / 25
        assert torch.equal(rule(session.clone())["action"] == 1, expected.squeeze(-1))


@pytest.mark.parametrize("acquisition", [information_gain, alignment_gain])
def test_quantile_rule_uses_up_its_asks_on_the_best(acquisition: object, pool: QueryPool) -> None:
    env = make(FeedEnv, pool, batch=40, skip="free")
    data = env.rollout(25, QuantileAsk(env, acquisition), break_when_any_done=False)  # type: ignore[arg-type]
    first = data[:, 0]
    left = torch.ones(40, 1)
    rank = OfferRank(env, acquisition)(first["samples"], first["offer"], left)  # type: ignore[arg-type]
    assert torch.equal(first["action"] == 1, rank.squeeze(-1) >= 1 - 5 / 25)
    asked = data["next", "n_asked"].squeeze(-1).amax(1)
    assert (asked == 5).all()


def test_thompson_asks_what_two_drawn_samples_have_most_at_stake_about(pool: QueryPool) -> None:
    env = make(QueryEnv, pool, batch=30)
    session, model = session_of(env), env.belief.response_model
    chosen = Thompson(Greedy(model, max_regret), seed=3)(session.clone())
    assert torch.equal(chosen["samples"], session["samples"])
    assert torch.equal(
        chosen["action"], Thompson(Greedy(model, max_regret), seed=3)(session.clone())["action"]
    )
    asked = []
    for b in range(30):
        omegas = session["samples"][b].double()
        returns = session["queries"][b].double() @ omegas.T  # (C K M)
        stakes = set()
        for i in range(len(omegas)):
            for j in range(i):
                one, other = returns[..., i], returns[..., j]
                first, second = one.argmax(-1, keepdim=True), other.argmax(-1, keepdim=True)
                lost = one.gather(-1, first) - one.gather(-1, second)
                lost = lost + other.gather(-1, second) - other.gather(-1, first)
                stakes.add(int(lost.squeeze(-1).argmax()))
        assert int(chosen["action"][b]) in stakes
        asked.append(int(chosen["action"][b]))
    assert len(set(asked)) > 5


@pytest.mark.parametrize("model", [Boltzmann(0.001), Boltzmann(1e5), Optimal()], ids=str)
def test_thompson_cares_about_returns_alone(model: ResponseModel, pool: QueryPool) -> None:
    """Not about tau, nor about the order of options; where all are alike it asks the first."""
    env = make(QueryEnv, pool, model, batch=30)
    session = session_of(env)
    chosen = STRATEGIES["thompson"](env)(session.clone())["action"]
    turned, alike = session.clone(), session.clone()
    turned["queries"] = turned["queries"].flip(2)
    alike["queries"] = alike["queries"][:, :, :1].expand_as(alike["queries"])
    assert torch.equal(STRATEGIES["thompson"](env)(turned)["action"], chosen)
    assert (STRATEGIES["thompson"](env)(alike)["action"] == 0).all()
    other = make(QueryEnv, pool, Boltzmann(2.0), batch=30)
    assert torch.equal(STRATEGIES["thompson"](other)(session.clone())["action"], chosen)


@pytest.mark.parametrize("name", ["thompson", "knowledge_gradient", "max_regret"])
def test_later_strategies_decide_in_both_setups(name: str, pool: QueryPool) -> None:
    for kind, table in ((QueryEnv, STRATEGIES), (FeedEnv, FEED_STRATEGIES)):
        env = make(kind, pool, batch=6)
        data = env.rollout(5, table[name](env))
        assert data["action"].unique().numel() > 1
        assert (data["action"] < (2 if kind is FeedEnv else len(pool))).all()


def test_knowledge_gradient_is_of_the_pool_that_is_asked_about(pool: QueryPool) -> None:
    env = make(QueryEnv, pool)
    acquisition = STRATEGIES["knowledge_gradient"](env).acquisition
    assert isinstance(acquisition, KnowledgeGradient)
    assert torch.equal(acquisition.trajectories, pool.features.flatten(0, 1).unique(dim=0))
    with pytest.raises(InputError, match="strategy=lookahead with setup=feed"):
        make_strategy("lookahead", make(FeedEnv, pool))
