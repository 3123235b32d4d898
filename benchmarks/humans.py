"""What it costs that a human is not as the belief takes them to be.

``python benchmarks/humans.py``: simulated humans of every kind after 20 questions on a pool of 300,
by greedy information gain and greedy expected alignment, with a belief that knows nothing of their
imperfection and with one that allows for an answer at random in 20. The first row is what the
others are held against: the human whom the belief expects. The humans of all rows have the same ω.
Alignment is the mean over the samples of their cosine with ω, beside it stands the cosine of their
mean, ± is twice the standard error of the latter, and the last number is the calibration error of
the answers that the beliefs predict to questions that nobody asks.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder's select.py hides Python's

from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from benchmarks import common
from torchrl_pref.build import make_pools, make_task
from torchrl_pref.evaluation.comparison import compare
from torchrl_pref.evaluation.run import Evaluation

KINDS = {
    "as expected": [],
    "mistakes: 10% (lapse 0.2)": ["human.lapse=0.2"],
    "tau a quarter": ["human.tau=1.1"],
    "tau four times": ["human.tau=17.6"],
    "each their own tau, within 4": ["human.spread=4"],
    "skipping below average": ["human=skipping"],
    "myopic, discount 0.9": ["human=myopic"],
    "drifting, 0.1 a question": ["human=drifting"],
    "a weak question, as expected": ["question=weak"],
    "a weak question, undecided": ["question=weak", "human=undecided"],
    "a weak question, drifting": ["question=weak", "human=drifting"],
    "first 3 demonstrations": ["demonstrations.count=3"],
    "first 3 corrections": ["demonstrations.count=3", "demonstrations.alternatives=1"],
    "first 3 demonstrations, tau 1.1": ["demonstrations.count=3", "demonstrations.tau=1.1"],
}
"""What is typed for each; ``tau`` is 4.4, about what noisy solves to."""

STRATEGIES = {"greedy_information": "information gain", "greedy_alignment": "expected alignment"}


def main() -> None:
    """Print the table."""
    parser = common.arguments(__doc__)
    parser.add_argument("--humans", type=int, default=200, help="of each kind (default 200)")
    options = common.start(parser)
    rows = []
    for name, typed in KINDS.items():
        row: dict[str, Any] = {"human": name}
        for lapse in (0.0, 0.05):
            settings = settings_of(*typed, f"belief.lapse={lapse}", options.humans)
            task = make_task(*make_pools(settings), settings["tau"], settings)
            results = compare(settings, task, task.test, {})
            for key, words in STRATEGIES.items():
                beside = f", belief.lapse={lapse:g}" if lapse else ""
                row[words + beside] = _reached(results[key])
        rows.append(row)
    title = (
        f"Alignment / cosine of the mean / calibration error after 20 questions, {options.humans} "
        "humans of each kind"
    )
    common.report(title, rows, options.json)


def settings_of(*typed: str | int) -> dict[str, Any]:
    """What ``evaluate.py`` would be given; last the number of humans."""
    *overrides, n_humans = typed
    with initialize_config_dir(str(Path(sys.path[0]) / "conf"), version_base="1.3"):
        always = ["setup=query", "setup.repeats=false", "tau=4.4", "pool.size=300"]
        always.append(f"evaluation.humans={n_humans}")
        config = compose("evaluate", [*always, *map(str, overrides)])
    settings = OmegaConf.to_container(config)
    assert isinstance(settings, dict)
    return {str(key): value for key, value in settings.items()}


def _reached(result: Evaluation) -> str:
    """The mean alignment, the cosine of the mean with twice its standard error, and calibration."""
    cosines = result.alignment_of_mean[:, -1]
    error = 2 * cosines.std() / len(cosines) ** 0.5
    wrong = result.metrics["calibration"][0, -1]
    aligned = result.alignment[:, -1].mean()
    return f"{aligned:.3f} / {cosines.mean():.3f} ± {error:.3f} / {wrong:.3f}"


if __name__ == "__main__":
    main()
