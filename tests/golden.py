"""The numbers that a redesign must not change: `python tests/golden.py` writes them anew.

In each cell (setup, kind of human) the shipped policy of seed 0 and every baseline face the same
40 humans on one small pool, and one short training runs to its end. ``golden.json`` holds the
SHA-256 of what came out, bit for bit, and the mean alignments, on one kind of machine.
"""

from __future__ import annotations

import hashlib
import json
import platform
import tempfile
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from torch import Tensor

from torchrl_pref.build import make_pools, make_task
from torchrl_pref.evaluation.comparison import compare, policy_key
from torchrl_pref.pretrained import pretrained_checkpoint
from torchrl_pref.training.start import make_trainer

ROOT = Path(__file__).resolve().parents[1]
FILE = Path(__file__).with_suffix(".json")

CELLS = [(setup, tau) for setup in ("query", "feed") for tau in ("noisy", "optimal")]

SMALL = ["pool.size=150", "setup.budget=6", "evaluation.humans=40"]
SHORT = ["training.updates=6", "training.sessions=12", "training.warm_up=1", "training.stages=1"]

WRITTEN_AS = {
    "greedy_information": "greedy",
    "greedy_alignment": "greedy alignment",
    "ask_all": "ask all",
    "quantile_alignment": "quantile",
    "policy_query": "RL",
    "policy_feed": "RL-feed",
}
"""What the file, which is as it was, calls the strategies."""


def main() -> None:
    """Write the file."""
    torch.set_num_threads(1)
    found: dict[str, Any] = {"machine": machine()}
    for setup, tau in CELLS:
        found[f"{setup} {tau}"] = {**evaluated(setup, tau), "training": trained(setup, tau)}
    FILE.write_text(json.dumps(found, indent=1) + "\n")


def machine() -> str:
    """What the last bits of a sum depend on."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        model = lines[0].partition(":")[2].strip() if lines else model
    return f"{model}, torch {torch.__version__}"


def settings_of(setup: str, tau: str, *overrides: str) -> dict[str, Any]:
    """What ``train.py`` is given."""
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        config = compose("train", [f"setup={setup}", f"tau={tau}", *SMALL, *overrides])
    settings = OmegaConf.to_container(config)
    assert isinstance(settings, dict)
    return {str(key): value for key, value in settings.items()}


def evaluated(setup: str, tau: str) -> dict[str, dict[str, Any]]:
    """By strategy: a digest of its curves, and its alignment in the end."""
    settings = settings_of(setup, tau)
    task = make_task(*make_pools(settings), tau, settings)
    checkpoint = pretrained_checkpoint(setup, tau)
    checkpoint.settings["setup"]["budget"] = settings["setup"]["budget"]
    if setup == "feed":
        checkpoint.settings["setup"]["offers"] = settings["setup"]["offers"]
    results = compare(settings, task, task.test, {policy_key(settings): checkpoint})
    return {
        WRITTEN_AS.get(key, key): {
            "alignment": float(result.alignment[:, -1].mean()),
            "digest": digest(
                result.alignment, result.alignment_of_mean, result.information, result.ess
            ),
        }
        for key, result in results.items()
    }


def trained(setup: str, tau: str) -> dict[str, Any]:
    """A digest of the weights that a short training ends with, and its last alignment."""
    settings = settings_of(setup, tau, *SHORT)
    task = make_task(*make_pools(settings), tau, settings)
    trainer = make_trainer(settings, task)
    # The folder stays: a logger's thread may write into it later.
    trainer.run(Path(tempfile.mkdtemp()), lambda: None)
    weights = trainer.policy.weights.state_dict()
    return {
        "digest": digest(*(weights[name] for name in sorted(weights))),
        "alignment": trainer.progress.history["train/alignment"][-1],
    }


def digest(*tensors: Tensor) -> str:
    """Of the bits of tensors."""
    found = hashlib.sha256()
    for tensor in tensors:
        found.update(tensor.detach().contiguous().numpy().tobytes())
    return found.hexdigest()[:16]


if __name__ == "__main__":
    main()
