"""What a person wants, as a function of trajectories: a file, a score with its error, a transform.

Shapes: M samples of the weights, D features, ``…`` any leading dimensions.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from torchrl_pref.errors import InputError
from torchrl_pref.learned import Learned, Weights, scores, summary
from torchrl_pref.pool import Normalizer
from torchrl_pref.storage.files import size_of
from torchrl_pref.storage.writing import write_text
from torchrl_pref.tensors import check_finite, check_names, directions

FORMAT = 1
"""Of the file."""

LARGEST = 2**28
"""Bytes of a file that is read."""

MOST_ORIGINS, LONGEST_ORIGIN = 20, 200
"""Facts of where a reward comes from, and letters of one."""

Features: TypeAlias = Callable[[TensorDictBase, TensorDictBase], Tensor]
"""From what was before a step (with the action) and what is after it to its features (… D)."""


class Reward(Transform):
    """The reward of a person: the weighted sum of normalised features, its weights known as far as
    their answers told.

    >>> reward = Reward.of(session)
    >>> reward.save("reward.json")
    >>> mean, deviation = Reward.load("reward.json").score(features)

    It is a transform as well: appended to an environment it writes the reward of each step.

    >>> env = TransformedEnv(env, Reward.load("reward.json", features=step_features))

    Where the features of a trajectory are the mean over its steps, the rewards of its T steps sum
    to T times its score.

    Args:
        samples: (M D), of the weights; only their directions count.
        normalizer: what raw features are normalised by.
        feature_names: D.
        features: how a step is described, for the transform alone: the key of its raw features
            (… D) in what comes after it, or a function of what is before and after.
        origin: where it comes from, a few plain facts by name; it is kept in the file.

    Raises:
        InputError: the numbers of features differ, or there is a sample that has no direction.
    """

    samples: Tensor
    mean: Tensor
    std: Tensor

    def __init__(
        self,
        samples: Tensor,
        normalizer: Normalizer,
        feature_names: tuple[str, ...],
        features: NestedKey | Features = "features",
        origin: Mapping[str, str | int] | None = None,
    ) -> None:
        super().__init__(out_keys=["reward"])
        if samples.ndim != 2 or len(samples) < 2 or samples.shape[1] != len(normalizer.mean):
            raise InputError(
                f"samples of shape {tuple(samples.shape)}: expected (M, {len(normalizer.mean)}), "
                "M at least 2, with the features of the normaliser"
            )
        if not samples.isfinite().all() or not samples.any(-1).all():
            raise InputError("samples: expected finite numbers, not all 0 in any of them")
        self.feature_names = check_names(feature_names, samples.shape[1])
        self.origin = check_origin(dict(origin or {}))
        self.features = features
        self.register_buffer("samples", directions(samples.detach().float()))
        self.register_buffer("mean", normalizer.mean.detach().float())
        self.register_buffer("std", normalizer.std.detach().float())

    @classmethod
    def of(
        cls,
        learned: Learned,
        features: NestedKey | Features = "features",
        origin: Mapping[str, str | int] | None = None,
    ) -> Reward:
        """What a session with one person has learned.

        Raises:
            InputError: it is with several people.
        """
        if learned.people is not None:
            raise InputError(
                f"a session with people={learned.people}: expected one person, whose reward it is"
            )
        names, normalizer = learned.pool.feature_names, learned.normalizer
        if normalizer is None:  # its features are the raw ones
            zeros = torch.zeros(learned.pool.n_features)
            normalizer = Normalizer(zeros, zeros + 1)
        facts: dict[str, str | int] = {"answers": learned.n_answered, "pool": learned.pool.digest}
        return cls(learned.samples, normalizer, names, features, {**facts, **(origin or {})})

    @property
    def weights(self) -> Weights:
        """What is known of the weights of normalised features: of their directions."""
        mean, sd, low, high = (part[0] for part in summary(self.samples[None]))
        return Weights(mean, sd, low, high, self.feature_names)

    def score(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """The reward of trajectories, and how sure that is; gradients flow through both.

        Args:
            features: (… D), raw.

        Returns:
            (…) and (…), mean and standard deviation over the samples.

        Raises:
            InputError: the features are not (… D) finite numbers.
        """
        self._check(features)
        mean, deviation = scores(
            self.samples, self._normalised(features.reshape(-1, features.shape[-1]))
        )
        return mean.view(features.shape[:-1]), deviation.view(features.shape[:-1])

    def _normalised(self, features: Tensor) -> Tensor:
        return (features.to(self.mean) - self.mean) / self.std

    def _check(self, features: Any) -> None:
        """Refuse what is no features, or not finite."""
        n_features = len(self.mean)
        if not isinstance(features, Tensor) or features.shape[-1:] != (n_features,):
            what = tuple(features.shape) if isinstance(features, Tensor) else type(features)
            raise InputError(
                f"features of {what}: expected a tensor (…, {n_features}) of "
                f"{', '.join(self.feature_names)}"
            )
        check_finite("features", features)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the reward of recorded steps, as those of a replay buffer."""
        self._step(tensordict, tensordict.get("next"))
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        """Write the reward of a step."""
        if callable(self.features):
            features = self.features(tensordict, next_tensordict)
        else:
            features = next_tensordict.get(self.features, None)
            if features is None:
                raise InputError(
                    f"features={self.features!r}: a step has no such key; give the key of its "
                    "features, or a function of what is before and after it, as in "
                    "Reward.load(path, features=describe)"
                )
        self._check(features)
        reward = self._normalised(features) @ self.samples.mean(0)
        return next_tensordict.set("reward", reward.unsqueeze(-1))

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        """One number for each step."""
        shape = (*self.parent.batch_size, 1)
        leaf = Unbounded(shape, device=reward_spec.device, dtype=self.mean.dtype)
        if not isinstance(reward_spec, Composite):
            return leaf
        reward_spec["reward"] = leaf
        return reward_spec

    def save(self, path: str | Path) -> None:
        """Write it to a file of plain JSON, whole or not at all.

        Raises:
            InputError: the file cannot be written.
        """
        path, known = Path(path), self.weights
        content = {
            "kind": "reward",
            "format": FORMAT,
            "feature_names": list(self.feature_names),
            "weights": {name: getattr(known, name).tolist() for name in SHOWN},
            "normalizer": {"mean": self.mean.tolist(), "std": self.std.tolist()},
            "origin": self.origin,
            "samples": self.samples.tolist(),
        }
        rows = (f"{json.dumps(key)}: {json.dumps(value)}" for key, value in content.items())
        try:
            write_text(path, "{\n  " + ",\n  ".join(rows) + "\n}\n")
        except OSError as error:
            raise InputError(
                f"{path}: cannot be written ({error.strerror}); name a file in a folder that is "
                "there"
            ) from None

    @classmethod
    def load(cls, path: str | Path, features: NestedKey | Features = "features") -> Reward:
        """Read it from a file.

        Args:
            path: of the file.
            features: see the class.

        Raises:
            InputError: the file is missing, spoiled, or holds no reward.
        """
        content = _read(Path(path))
        try:
            mean, std, samples = (
                _numbers(content, *keys)
                for keys in (("normalizer", "mean"), ("normalizer", "std"), ("samples",))
            )
            if mean.shape != std.shape or mean.ndim != 1 or not (std > 0).all():
                raise InputError("normalizer: expected D means and D deviations above 0")
            names = check_names(content.get("feature_names"), len(mean))
            origin = check_origin(content.get("origin"))
            made = cls(samples, Normalizer(mean, std), names, features, origin)
            for name in SHOWN:
                told, found = _numbers(content, "weights", name), getattr(made.weights, name)
                if told.shape != found.shape or not torch.allclose(told, found, atol=1e-4):
                    raise InputError(f"weights.{name}: not those of the samples beside them")
        except InputError as error:
            raise InputError(f"{path}: {error}; make it again by Reward.save or ask.py") from None
        return made


SHOWN = ("mean", "sd", "low", "high")
"""Of the weights: they follow from the samples, and are in the file for whoever reads it."""


def _read(path: Path) -> dict[str, Any]:
    """The JSON of a file.

    Raises:
        InputError: it cannot be read, or is no reward.
    """
    if size_of(path, "reward") > LARGEST:
        raise InputError(f"{path}: larger than any reward; expected what Reward.save wrote")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: cannot be read as a reward ({error}); expected what Reward.save wrote"
        ) from None
    if not isinstance(content, dict) or content.get("kind") != "reward":
        raise InputError(f"{path}: holds no reward; expected what Reward.save wrote")
    if content.get("format") != FORMAT:
        raise InputError(
            f"{path}: a reward in the format {content.get('format')!s:.20}; expected {FORMAT}, the "
            "one of this version"
        )
    return content


def _numbers(content: dict[str, Any], *keys: str) -> Tensor:
    """The tensor of finite numbers under some keys.

    Raises:
        InputError: there is none.
    """
    found: Any = content
    for key in keys:
        found = found.get(key) if isinstance(found, dict) else None
    try:
        tensor = torch.tensor(found, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise InputError(f"{'.'.join(keys)}: expected lists of numbers") from None
    if not tensor.float().isfinite().all():
        raise InputError(f"{'.'.join(keys)}: expected finite numbers")
    return tensor.float()


def check_origin(found: Any) -> dict[str, str | int]:
    """Return the facts of where a reward comes from.

    Raises:
        InputError: they are none, or too many, or too long.
    """
    if not isinstance(found, dict) or len(found) > MOST_ORIGINS:
        raise InputError(f"origin: expected at most {MOST_ORIGINS} facts by name")
    for name, fact in found.items():
        plain = type(name) is str and type(fact) in (str, int)
        if not plain or len(name) > LONGEST_ORIGIN or len(str(fact)) > LONGEST_ORIGIN:
            raise InputError(f"origin.{name!s:.40}: expected a short text or a whole number")
    return found
