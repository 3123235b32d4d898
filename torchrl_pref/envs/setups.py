"""The two setups of an environment, and what is for one of them alone."""

from __future__ import annotations

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_pref.envs.session import is_feed
from torchrl_pref.errors import OtherSetup

ALONE = {"feed": ("offer", "n_offered"), "query": ("queries", "action_mask")}
"""What one setup shows and the other does not."""


def setups_of(env: EnvBase) -> tuple[str, str]:
    """The names of an environment's setup, and of the other one."""
    return ("feed", "query") if is_feed(env) else ("query", "feed")


def refuse_other_setup(what: str, asks: TensorDictModuleBase, env: EnvBase) -> None:
    """Refuse what reads something that this environment does not show.

    Raises:
        OtherSetup: it does; ``what`` was typed for it.
    """
    here, there = setups_of(env)
    for key in ALONE[there]:
        if key in asks.in_keys:
            raise OtherSetup(
                f"{what} with setup={here}: it reads {key}, which setup={there} alone shows; type "
                "that, or name another"
            )
