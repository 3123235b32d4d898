"""What a live person is asked by: a strategy by its name, the trained policy, or one's own."""

from __future__ import annotations

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_pref.errors import InputError, check_choice, check_type
from torchrl_pref.strategies import STRATEGIES, MakeStrategy


def strategy_of(strategy: str | MakeStrategy, env: EnvBase) -> TensorDictModuleBase:
    """What asks in an environment of queries.

    Args:
        strategy: a name of ``strategies.STRATEGIES``, ``policy``, or a function from an environment
            to a module that writes ``action``.
        env: the environment.

    Raises:
        InputError: it is none of these.
    """
    if strategy == "policy":
        from torchrl_pref.pretrained import pretrained_policy  # and all that it takes

        kind = "noisy" if env.belief.response_model.is_soft else "optimal"
        return pretrained_policy(env, kind).strategy
    if isinstance(strategy, str):
        return STRATEGIES[check_choice("strategy", strategy, (*STRATEGIES, "policy"))](env)
    if not callable(strategy) or isinstance(strategy, TensorDictModuleBase):
        raise InputError(
            f"strategy of type {type(strategy).__name__}: expected a function from an environment "
            "to a module that writes action, such as lambda env: Greedy(env.belief.response_model)"
        )
    made = strategy(env)
    check_type("what strategy makes of an environment", made, TensorDictModuleBase, "Greedy(…)")
    return made
