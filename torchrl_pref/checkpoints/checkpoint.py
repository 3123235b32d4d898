"""Checkpoints: weights, the whole configuration, the normaliser and the digests of the pools."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from torchrl_pref.checkpoints.contents import check_content
from torchrl_pref.checkpoints.migrations import migrate, migrate_training
from torchrl_pref.config.sections import Settings
from torchrl_pref.errors import InputError
from torchrl_pref.policies import POLICIES
from torchrl_pref.pool import Normalizer, QueryPool, save_atomically
from torchrl_pref.runs import CHECKPOINT
from torchrl_pref.storage.files import load_safely

KIND = "torchrl_pref checkpoint"

FORMAT = 10
"""Raised whenever a key of the settings or of the checkpoint comes, goes or changes its meaning."""

READABLE = (4, 5, 6, 7, 8, 9, FORMAT)
"""Formats that can be read, the older ones by :mod:`torchrl_pref.checkpoints.migrations`."""


def picks_by_index(settings: Settings) -> bool:
    """Whether a policy of these settings picks an index of its training pool."""
    return "N" in bound_to(settings)


def bound_to(settings: Settings) -> str:
    """Which of N, K and D may not change for a policy of these settings."""
    kind = POLICIES.get(settings["policy"]["name"])
    return "" if kind is None else str(getattr(kind, settings["setup"]["name"]))


@dataclass
class Checkpoint:
    """All that is needed to evaluate a policy elsewhere, or to go on training it.

    Attributes:
        settings: the run's whole configuration, plain data.
        tau: the human's tau as solved or given; None for an optimal human.
        mean, std: (D), the normaliser of the training pool.
        train_digest, test_digest: of the run's normalised pools.
        pool_shape: N, K and D of the training pool.
        weights: state dict of the policy.
        training: what the training loop needs to go on, bit for bit.
    """

    settings: Settings
    tau: float | None
    mean: Tensor
    std: Tensor
    train_digest: str
    test_digest: str
    pool_shape: dict[str, int]
    weights: dict[str, Any]
    training: dict[str, Any]

    @property
    def normalizer(self) -> Normalizer:
        """The normaliser fitted on the training pool."""
        return Normalizer(self.mean, self.std)

    @property
    def picks_by_index(self) -> bool:
        """Whether the policy picks an index of its training pool, as the paper's query policy."""
        return picks_by_index(self.settings)

    @property
    def of_every_task(self) -> bool:
        """Whether the policy was trained over many problems, and is bound to no task, tau, kind of
        question or budget."""
        return self.settings["training"]["problems"] == "drawn"

    def save(self, path: str | Path) -> None:
        """Write the checkpoint, whole or not at all."""
        save_atomically({"kind": KIND, "format": FORMAT, **asdict(self)}, path)

    @classmethod
    def load(cls, path: str | Path) -> Checkpoint:
        """Read a checkpoint from a file or from the folder of a run, with ``weights_only=True``.

        Raises:
            InputError: it is missing, cut off, spoiled, or written by something else.
        """
        file = Path(path) / CHECKPOINT if os.path.isdir(path) else path
        content = load_safely(file, KIND)
        content.pop("kind")
        found = content.pop("format", None)
        version = found if type(found) is int and 0 <= found < 1000 else "unknown"
        if version not in READABLE or set(content) != set(cls.__dataclass_fields__):
            raise InputError(
                f"{path}: written by another version of this package (format {version}, expected "
                f"{', '.join(map(str, READABLE))}); train again, or use the version that wrote it"
            )
        if version != FORMAT:
            migrate(content["settings"])
            migrate_training(content["training"])
        try:
            check_content(content)
        except InputError as error:
            raise InputError(
                f"{path}: {error}; restore a copy of the file, or train again"
            ) from None
        return cls(**content)

    def check_fits(self, pool: QueryPool, own_indices: bool = False) -> None:
        """Refuse a pool on which this policy has no meaning.

        Args:
            pool: the queries, normalised.
            own_indices: whether a policy that picks by index must be on its own training pool.

        Raises:
            InputError: options, features or (for a policy that picks by index) queries differ.
        """
        expected = dict(self.pool_shape)
        found = {"N": len(pool), "K": pool.n_options, "D": pool.n_features}
        expected = {size: expected[size] for size in bound_to(self.settings)}
        differs = [f"{k}={found[k]} (trained on {v})" for k, v in expected.items() if found[k] != v]
        if differs:
            raise InputError(
                f"the checkpoint does not fit the pool: {', '.join(differs)}; evaluate it on a "
                "pool of the shape it was trained on, or train a policy for this pool"
            )
        if own_indices and self.picks_by_index and pool.digest != self.train_digest:
            raise InputError(
                "the checkpoint does not fit the pool: its policy picks indices of a training pool "
                f"with digest {self.train_digest[:12]}, and this one has {pool.digest[:12]}; start "
                "from a checkpoint of the same pool, or use policy=scorer"
            )
