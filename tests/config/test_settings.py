"""What is typed is checked as a whole, before anything is made of it."""

from __future__ import annotations

import copy
import random
import subprocess
import sys
from functools import cache
from inspect import signature
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_origin, get_type_hints, is_typeddict

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

import torchrl_pref
from benchmarks.bad_settings import FAULTS, every_command, run_forked
from torchrl_pref.beliefs import lapses
from torchrl_pref.beliefs import sampled as belief
from torchrl_pref.beliefs import slice as sampler
from torchrl_pref.checkpoints import contents
from torchrl_pref.config import checks, memory, sections, settings, together
from torchrl_pref.envs import objectives
from torchrl_pref.errors import InputError, one_line
from torchrl_pref.policies import POLICIES, attention
from torchrl_pref.questions import QUESTIONS
from torchrl_pref.questions.prior_evidence import evidence_of, joined
from torchrl_pref.questions.responses import Boltzmann
from torchrl_pref.strategies import FEED_STRATEGIES, STRATEGIES, BatchOf
from torchrl_pref.tasks import TASKS
from torchrl_pref.training.algorithms import ALGORITHMS
from torchrl_pref.training.loggers import LOGGERS

ROOT = Path(__file__).parents[2]


def composed(script: str, *overrides: str) -> dict[str, Any]:
    return {str(key): copy.deepcopy(value) for key, value in _composed(script, *overrides).items()}


@cache
def _composed(script: str, *overrides: str) -> dict[Any, Any]:
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        plain = OmegaConf.to_container(compose(script, list(overrides)))
    assert isinstance(plain, dict)
    return plain


def test_a_random_sample_of_bad_settings_is_refused_in_one_line() -> None:
    """``benchmarks/bad_settings.py`` runs all of them."""
    commands = every_command()
    assert len(set(commands)) >= 2000
    results = [run_forked(*one) for one in random.Random(0).sample(commands, 40)]
    assert [result for result in results if result.outcome in FAULTS] == []
    assert sum(result.outcome == "refused" for result in results) > 25


@pytest.mark.parametrize("algorithm", ["a2c", "ppo"])
@pytest.mark.parametrize("setup", ["query", "feed"])
@pytest.mark.parametrize("policy", ["scorer", "attention", "paper"])
def test_every_default_of_a_training_is_legal(setup: str, policy: str, algorithm: str) -> None:
    typed = composed("train", f"setup={setup}", f"policy={policy}", f"algorithm={algorithm}")
    settings.check_train_settings(typed)
    run = {key: value for key, value in typed.items() if key not in ("resume", "checkpoint")}
    settings.check_run({**run, "overrides": []})


@pytest.mark.parametrize("setup", ["query", "feed"])
@pytest.mark.parametrize("experiment", ["everywhere", "paper"])
def test_every_experiment_is_legal(setup: str, experiment: str) -> None:
    settings.check_train_settings(composed("train", f"experiment={experiment}", f"setup={setup}"))


@pytest.mark.parametrize("typed", ["setup=query", "setup=feed", "+policy=pretrained"])
def test_every_default_of_an_evaluation_is_legal(typed: str) -> None:
    settings.check_evaluate_settings(composed("evaluate", typed.lstrip("+")))


@pytest.mark.parametrize("setup", ["feed", "query"])
@pytest.mark.parametrize("script", ["train", "evaluate"])
def test_the_types_of_the_sections_name_the_keys_of_conf_and_their_values(
    script: str, setup: str
) -> None:
    typed = composed(script, f"setup={setup}")
    hints = get_type_hints(sections.Settings)
    assert typed.keys() - hints.keys() == set()
    for key, value in typed.items():
        section = hints[key]
        if not is_typeddict(section):
            assert section == sections.GroupSection or not isinstance(value, dict), key
            continue
        inner = get_type_hints(section)
        assert value.keys() - {"name"} <= inner.keys(), key
        ours = {name for name in inner if "NotRequired" not in str(section.__annotations__[name])}
        assert ours <= value.keys(), key
        for name, number in value.items():
            kind = list if get_origin(inner[name]) is list else inner[name]
            assert isinstance(number, kind), (key, name)


def test_moves_may_be_left_to_the_belief() -> None:
    typed = composed("train")
    for moves in (None, 1, 16):
        typed["belief"]["moves"] = moves
        settings.check_train_settings(typed)


def test_words_are_those_of_the_library() -> None:
    assert set(settings.OBJECTIVES) == set(objectives.OBJECTIVES)
    for tokens in attention.TOKENS:
        settings.POLICIES["attention"]["policy.tokens"]("policy.tokens", tokens)
    assert set(settings.ALGORITHMS) == set(ALGORITHMS) == set(contents.ALGORITHMS)
    assert set(checks.LOGGERS) == {"csv", *LOGGERS}
    bound = {name for name, kind in POLICIES.items() if "D" in kind.query + kind.feed}
    assert set(together.OF_ONE_DIMENSION) == bound
    assert set(settings.PROTOCOL_TASKS) <= set(TASKS)
    assert signature(BatchOf).parameters["shortlist"].default == memory.SHORTLIST


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("csv", r"logger='csv': expected a list, such as logger=\[csv,tensorboard\]"),
        (None, "logger=None: expected a list"),
        (["paper"], "logger='paper': expected one of csv, tensorboard, wandb, mlflow"),
        ([["csv"]], "expected one of csv"),
        (["csv", "csv"], "names the same twice"),
        (
            ["csv", "wandb"],
            r"wandb is not installed; install it by .*'\.\[wandb\]', or leave wandb",
        ),
        (["mlflow"], r"mlflow is not installed; install it by .*'\.\[mlflow\]', or leave mlflow"),
    ],
)
def test_bad_loggers_are_refused(value: Any, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=message):
        settings.check_train_settings({**composed("train"), "logger": value})


def test_loggers_may_be_none_or_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "find_spec", lambda name: SimpleNamespace(origin="a file"))
    for value in ([], ["csv"], ["mlflow", "wandb", "tensorboard", "csv"]):
        settings.check_train_settings({**composed("train"), "logger": value})


def test_a_folder_named_wandb_is_no_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """wandb leaves one where it ran."""
    (tmp_path / "wandb").mkdir()
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    monkeypatch.delitem(sys.modules, "wandb", raising=False)
    with pytest.raises(InputError, match="wandb is not installed"):
        checks.check_loggers("logger", ["wandb"])


@pytest.mark.parametrize(
    ("key", "value", "what"),
    [
        ("evaluation.humans", 10**12, "the evaluation"),
        ("training.sessions", 10**8, "training"),
        ("belief.samples", 10**9, "training"),
        ("pool.size", 10**9, "the evaluation"),
        ("task.length", 2**32, "the pools"),
        ("setup.budget", 10**9, "training"),
        ("training.steps", 10**9, "training"),
        ("belief.moves", 10**9, "moving the belief"),
    ],
)
def test_what_cannot_fit_is_refused_with_its_estimate(key: str, value: int, what: str) -> None:
    typed = composed("train")
    section, name = key.split(".")
    typed[section][name] = value
    with pytest.raises(InputError, match=rf"{key}={value}.*: {what} would take about .* GB"):
        settings.check_train_settings(typed)


def test_the_limit_of_memory_is_the_machines(monkeypatch: pytest.MonkeyPatch) -> None:
    typed = composed("train")
    monkeypatch.setattr(memory, "machine_memory", lambda: 10**8)
    with pytest.raises(InputError, match=r"at most the 0.1 GB of this machine"):
        settings.check_train_settings(typed)


def test_a_pool_of_ones_own_counts_as_large_as_it_is() -> None:
    typed = composed("evaluate")
    memory.check_memory(typed)
    with pytest.raises(InputError, match="the evaluation would take"):
        memory.check_memory(typed, 10**10, 2, 4)


def test_a_batch_of_questions_with_many_answers_is_counted() -> None:
    """720 orders of six options, of 400 candidates, under 100,000 samples: 690 GB."""
    typed = composed("evaluate", "setup=query", "setup.batch=20", "question=ranking")
    typed["belief"]["samples"] = 100_000
    size = {part.what: part.size for part in memory.parts_of(typed, 1000, 6, 4)}
    assert size["choosing a batch"] == 24.0 * 400 * 100_000 * 720
    with pytest.raises(InputError, match=r"samples=100000: choosing a batch"):
        memory.check_memory({**typed, "pool": {**typed["pool"], "train": "mine.pt"}}, 1000, 6, 4)


@pytest.mark.parametrize(
    "key", ["tau", "seed", "training.gamma", "logger", "setup", "policy", "algorithm", "belief"]
)
def test_a_missing_key_is_named(key: str) -> None:
    typed = composed("train")
    *sections, name = key.split(".")
    inner = typed[sections[0]] if sections else typed
    del inner[name]
    with pytest.raises(InputError, match=rf"^{key}\S* is missing"):
        settings.check_train_settings(typed)


def test_long_and_unprintable_input_stays_one_short_line() -> None:
    line = one_line(InputError("tau=" + "x" * 10_000 + "\n\x1b[31mred: expected a number"))
    assert len(line) < 1300
    assert line.isprintable()
    assert line.endswith("expected a number")


def test_help_and_the_package_need_nothing_heavy() -> None:
    heavy = {"torch", "torchrl", "tensordict", "matplotlib", "numba", "tabulate", "tensorboard"}
    code = f"""
import runpy, sys
import torchrl_pref, torchrl_pref.config.settings
sys.argv = ["train.py", "--help"]
try:
    runpy.run_path({str(ROOT / "train.py")!r}, run_name="__main__")
except SystemExit as ended:
    assert not ended.code
print(sorted({heavy!r} & set(sys.modules)), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.stderr == "[]\n"
    assert "Train a policy to ask" in done.stdout


def test_the_package_gives_its_names_when_they_are_used() -> None:
    assert set(torchrl_pref.__all__) <= set(dir(torchrl_pref))
    for name in torchrl_pref.__all__:
        assert getattr(torchrl_pref, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        _ = torchrl_pref.Nothing


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["belief=rationality"], r"belief=rationality with tau=\[noisy,optimal\].*type tau=noisy"),
        (["belief=laplace", "tau=optimal"], "belief=laplace with tau=optimal.*type tau=noisy"),
        (
            ["belief=rationality", "tau=noisy", "belief.lapse=0.25"],
            "belief.lapse=0.25 with belief=rationality.*less than 0.25",
        ),
    ],
)
def test_what_a_belief_cannot_infer_is_refused_before_the_first_panel(
    overrides: list[str], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        settings.check_evaluate_settings(composed("evaluate", *overrides))


@pytest.mark.parametrize(
    "overrides",
    [
        ["belief=rationality", "tau=noisy", "belief.lapse=0.24"],
        ["belief=laplace", "tau=[noisy,3]", "belief.lapse=0.3", "human.tau=optimal"],
    ],
)
def test_what_a_belief_can_infer_is_let_through(overrides: list[str]) -> None:
    settings.check_evaluate_settings(composed("evaluate", *overrides))


def test_the_largest_rate_is_that_of_the_belief() -> None:
    assert lapses.RATES[-1] == together.LARGEST_RATE


def part(what: str, *overrides: str) -> float:
    """Bytes that a part of an evaluation is estimated at."""
    parts = memory.parts_of(composed("evaluate", *overrides))  # type: ignore[arg-type]
    return {part.what: part.size for part in parts}[what]


def test_the_estimate_pads_answers_and_demonstrations_as_the_session_does() -> None:
    """An evidence of them has all factors and rows of the largest."""
    options, kind = torch.randn(1, 20, 4, 4), QUESTIONS["ranking"]()
    answers = Boltzmann(1.0, kind).evidence(options, torch.zeros(1, 20, dtype=torch.long))
    shown = evidence_of({"rows": torch.zeros(1, 3, 50, 4), "offsets": torch.zeros(1, 3, 50)})
    padded = joined(shown, answers).offsets.numel()
    given = ["question=ranking", "pool.options=4", "setup.budget=20", "evaluation.humans=1000"]
    demonstrations = ["demonstrations.count=3", "demonstrations.alternatives=50"]
    at_once = min(1000 * 100, memory.MOVED // memory.default_moves(4))
    size, more = (
        part("the likelihood of the answers", *given, *extra) for extra in ([], demonstrations)
    )
    assert more - size == 8.0 * (padded - answers.offsets.numel()) * at_once


def test_the_estimate_knows_the_gaussian_belief() -> None:
    what, given = "the Gaussian of belief=laplace", ["belief=laplace", "tau=noisy"]
    small = part(what, *given, "setup.budget=30", "evaluation.humans=1000")
    assert small == 8.0 * memory.LAPLACE_COPIES * memory.LAPLACE_HELD
    assert part(what, *given, "setup.budget=9000") > 8.0 * 9000**2
    given += ["pool.options=20", "setup.budget=1000000", "evaluation.humans=2"]
    with pytest.raises(InputError, match=f"setup.budget=1000000.*{what} would take"):
        settings.check_evaluate_settings(composed("evaluate", *given))


def test_the_estimate_knows_what_the_belief_does_at_once() -> None:
    """The estimate is made before anything heavy is imported, so the numbers stand there again."""
    assert memory.MOVED == belief.MOVED
    assert memory.UNIFORMS == 2 + sampler.MAX_SHRINKS


def test_the_estimate_knows_how_many_answers_there_are() -> None:
    for name, kind in QUESTIONS.items():
        for n_options in {"weak": (2,), "approve": (1,)}.get(name, (2, 3, 5)):
            table = kind().answers(n_options)
            expected = len(table.labels), *table.offsets.shape[1:]
            assert memory.sizes_of({"question": {"name": name}}, n_options) == expected


def test_every_strategy_has_its_line_in_the_docs() -> None:
    page = (ROOT / "docs" / "strategies.md").read_text()
    for name in {*STRATEGIES, *FEED_STRATEGIES} - {"random"}:
        assert f"| `{name}` |" in page
