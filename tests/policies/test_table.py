"""What every policy keeps to: the package's, and one written outside of it."""

import my_policy
import pytest
import torch
from helpers import ENVS, make
from torchrl.envs import TransformedEnv

from torchrl_pref.checkpoints.restore import restore_weights
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.envs.setups import refuse_other_setup
from torchrl_pref.errors import InputError
from torchrl_pref.policies import POLICIES
from torchrl_pref.policies.base import Policy, PolicyKind
from torchrl_pref.pool import QueryPool

KINDS = {**POLICIES, "own": PolicyKind(my_policy.perceptron)}


CASES = [(name, kind) for name in POLICIES for kind in ENVS] + [("own", QueryEnv)]
"""The one of our own is for queries."""


@pytest.mark.parametrize("name", POLICIES)
def test_a_policy_is_for_a_setup_and_refuses_the_other_if_it_has_to(
    name: str, pool: QueryPool
) -> None:
    assert any(made(name, make(env_kind, pool)) for env_kind in ENVS)


def made(name: str, env: QueryEnv | FeedEnv) -> Policy | None:
    """The policy, or None where it is for the other setup."""
    try:
        policy = KINDS[name].make(env)
        refuse_other_setup(name, policy.strategy, env)
    except InputError:
        return None
    return policy


@pytest.mark.parametrize(("name", "env_kind"), CASES)
def test_policies(name: str, env_kind: type, pool: QueryPool) -> None:
    env = make(env_kind, pool, seed=0)
    torch.manual_seed(0)
    policy = made(name, env)
    if policy is None:
        return
    with torch.random.fork_rng():
        data = env.rollout(3, policy.strategy)
    assert data["action"].shape == (4, 3)
    assert not any(value.requires_grad for value in data.values(True, True))
    # The critic values any session, and what is learned is saved and loaded.
    assert policy.critic(env.reset())["state_value"].shape == (4, 1)
    again = KINDS[name].make(TransformedEnv(make(env_kind, pool, seed=0)))
    restore_weights(again.weights, policy.weights.state_dict())
    for mine, other in zip(policy.weights.parameters(), again.weights.parameters(), strict=True):
        assert torch.equal(mine, other)
    assert set(KINDS[name].query + KINDS[name].feed) <= set("NKD")
