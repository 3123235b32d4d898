"""Trajectories of a Minari dataset on this machine. The package ``minari`` is an extra.

Letters: T observations of an episode, S numbers of an observation, A numbers of an action, D
features.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_pref.errors import InputError
from torchrl_pref.tasks.recorded import RecordedTask
from torchrl_pref.tasks.rollouts import FeatureMap, compute_features, features_of, names_of


class MinariTask(RecordedTask):
    """The episodes of a Minari dataset, paired.

    Args:
        id: of a dataset on this machine, or the folder of one; nothing is downloaded.
        features: computes them, see ``rollouts.FeatureMap``; None: those that come with the package
            for the environment of the dataset.

    Raises:
        InputError: there is no such dataset, it cannot be read, or no features are given.
    """

    def __init__(self, id: str | None = None, features: FeatureMap | None = None) -> None:
        try:
            import minari
        except ImportError:
            raise InputError(
                "minari is not installed; install it by "
                "pip install -c constraints.txt -e '.[minari]'"
            ) from None
        if not isinstance(id, str):
            raise InputError(f"id={id!r}: expected a dataset, or its folder; type id=…")
        try:
            data = minari.MinariDataset(_data_folder(id))
            spec = data.env_spec
            of_env = features_of("the dataset" if spec is None else spec.id, features)
            computed = torch.cat([_features(episode, of_env) for episode in data])
        except InputError:
            raise
        except Exception as error:  # whatever Minari trips over, the dataset is at fault
            raise InputError(
                f"id={id}: cannot be read as a Minari dataset ({type(error).__name__}: "
                f"{error!s:.300}); expected one on this machine; check the name"
            ) from error
        super().__init__(id, computed, names_of(of_env, computed.shape[-1]))


def _data_folder(id: str) -> Path:
    """Where the data of a dataset are.

    Raises:
        InputError: they do not say what is observed and done; Minari would then make the
            environment that they name, by whatever code they name.
    """
    from minari.dataset.minari_storage import MinariStorage
    from minari.storage.datasets_root_dir import get_dataset_path

    folder = (Path(id) if Path(id).is_dir() else get_dataset_path(id)) / "data"
    metadata = MinariStorage.read_raw_metadata(folder)
    if not {"observation_space", "action_space"} <= metadata.keys():
        raise InputError(
            f"id={id}: the dataset does not say what is observed and done (observation_space and "
            "action_space), and its code is not run to find out; collect it again"
        )
    return folder


def _features(episode: Any, features: FeatureMap) -> Tensor:
    """(1 D), of one episode."""
    observed, acted = episode.observations, episode.actions
    if not isinstance(observed, np.ndarray) or not isinstance(acted, np.ndarray):
        raise InputError(
            f"the dataset observes {type(observed).__name__} and acts by {type(acted).__name__}; "
            "expected arrays of numbers"
        )
    observations = torch.from_numpy(observed).reshape(1, len(observed), -1).float()
    actions = torch.from_numpy(acted).reshape(1, len(acted), -1).float()
    # The last observation, after which nothing is done.
    actions = torch.cat([actions, torch.zeros_like(actions[:, :1])], 1)
    computed = compute_features(features, observations, actions, torch.ones(1, len(observed)))
    if not computed.isfinite().all():
        raise InputError("features: NaN or infinity; expected finite numbers")
    return computed
