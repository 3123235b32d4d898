"""Policies that come with the package: for every task, and for the Gridworld.

``torchrl_pref/policies/weights/README.md`` is their card: how they were trained, and how they do.
"""

from __future__ import annotations

from pathlib import Path

from torchrl.envs import EnvBase

from torchrl_pref.build import load_policy
from torchrl_pref.checkpoints.checkpoint import Checkpoint
from torchrl_pref.envs.setups import setups_of
from torchrl_pref.errors import InputError, check_choice, check_count
from torchrl_pref.policies.base import Policy
from torchrl_pref.runs import CHECKPOINT
from torchrl_pref.training.progress import Progress

FOLDER = Path(__file__).parent / "policies" / "weights"

SEEDS = 5


def pretrained_checkpoint(setup: str, tau: str | None = None, seed: int = 0) -> Checkpoint:
    """One of the policies that come with the package.

    Args:
        setup: ``query`` or ``feed``.
        tau: None: the policy for every task; ``noisy`` or ``optimal``: one that was trained on the
            Gridworld, with humans of that kind.
        seed: of its training, 0 to 4.

    Raises:
        InputError: there is no such policy.
    """
    check_choice("setup", setup, ("query", "feed"))
    if tau is not None:
        check_choice("tau", tau, ("noisy", "optimal"))
    if check_count("seed", seed, 0) >= SEEDS:
        raise InputError(f"seed={seed}: expected a whole number from 0 to {SEEDS - 1}")
    return Checkpoint.load(FOLDER / _file(setup, tau, seed))


def pretrained_policy(env: EnvBase, tau: str | None = None, seed: int = 0) -> Policy:
    """A trained scorer for an environment: any pool, any number of options and features.

    Args:
        env: where it is to ask; a feed made with ``skip="free"``, which is what it was trained for.
        tau: None: the policy for every task; ``noisy`` or ``optimal``: one that was trained on the
            Gridworld, with humans of that kind.
        seed: of its training, 0 to 4.

    Raises:
        InputError: there is no such policy, or it cannot decide there (:func:`build.load_policy`).
    """
    setup, _ = setups_of(env)
    return load_policy(pretrained_checkpoint(setup, tau, seed), env)


def _file(setup: str, tau: str | None, seed: int) -> str:
    return f"{setup}-{'every' if tau is None else tau}-{seed}.pt"


def export(sweep: str | Path) -> list[Path]:
    """Put the policies of a sweep into the package: over ``setup`` and ``seed`` where each was
    trained over many problems, else over ``tau``, too.

    What only training needs is left out; the rest of each checkpoint is kept as it is.

    Args:
        sweep: a folder with one run folder for each policy.

    Returns:
        The files that were written.
    """
    written = []
    for run in sorted(Path(sweep).rglob(CHECKPOINT)):
        checkpoint = Checkpoint.load(run)
        settings = checkpoint.settings
        checkpoint.training = Progress.of(checkpoint.training).state_dict()
        tau = None if checkpoint.of_every_task else settings["tau"]
        path = FOLDER / _file(settings["setup"]["name"], tau, settings["seed"])
        checkpoint.save(path)
        written.append(path)
    return written
