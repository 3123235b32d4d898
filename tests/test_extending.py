"""Each file of examples/extending is short, and the main job runs with it from outside."""

import re
import shlex
import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest
from scripts import run_script

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "examples" / "extending"

SMALL = [
    *("pool.size=40", "setup.budget=3", "evaluation.humans=6"),
    *("training.updates=2", "training.sessions=6", "training.steps=8", "training.warm_up=1"),
    "evaluation.during=0",
]

JOBS = {
    "task": ["task=my_task:Table", "task.steps=12"],
    "question": ["question=my_question:Worst", "pool.options=3"],
    "belief": ["belief=my_belief:Weighted", "belief.draws=500"],
    "human": ["human=my_human:Tiring", "human.patience=5"],
    "policy": ["setup=query", "policy=my_policy:perceptron", "policy.width=8"],
}

ORDER = ("task", "question", "human", "belief", "policy")
"""On the page."""


class Made(NamedTuple):
    """A run of the main job."""

    done: subprocess.CompletedProcess[str]
    folder: Path


def run(script: str, *arguments: str, folder: Path = FOLDER) -> subprocess.CompletedProcess[str]:
    """A script as a user runs it from that folder."""
    return run_script(script, *arguments, folder=folder)


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_each_is_one_short_file(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 60
    assert path.stem in (ROOT / "docs" / "extending.md").read_text()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Made]:
    """The main job with what a file has, run once; its folder is to be left as it is."""

    @cache
    def run_with(what: str) -> Made:
        folder = tmp_path_factory.mktemp("made") / "run"
        done = run("train.py", *SMALL, *JOBS[what], f"hydra.run.dir={folder}")
        return Made(done, folder)

    return run_with


@pytest.mark.parametrize("what", JOBS)
def test_the_main_job_runs_with_it(what: str, made: Callable[[str], Made]) -> None:
    done, folder = made(what)
    assert done.returncode == 0, done.stderr
    assert (folder / "checkpoint.pt").exists()
    assert "written to" in done.stdout


COMMANDS = re.findall(r"`python (\S+\.py [^`<]+)`", (ROOT / "docs" / "extending.md").read_text())


def test_the_page_trains_with_each() -> None:
    """As typed above, but for sizes."""
    trained = [set(shlex.split(line)[1:]) for line in COMMANDS if line.startswith("train.py")]
    sizes = {"task.steps=12": "task.steps=30", "belief.draws=500": "belief.draws=5000"}
    sizes |= {"human.patience=5": "human.patience=10", "policy.width=8": "policy.width=32"}
    assert trained == [{sizes.get(one, one) for one in JOBS[what]} for what in ORDER]


@pytest.mark.parametrize("line", [line for line in COMMANDS if line.startswith("evaluate.py")])
def test_strategies_are_rows_of_the_table(line: str, tmp_path: Path) -> None:
    script, *typed = shlex.split(line)
    small = "pool.size=40", "setup.budget=3", "tau=noisy", "evaluation.humans=6"
    done = run(script, *typed, *small, f"hydra.run.dir={tmp_path / 'run'}")
    assert done.returncode == 0, done.stderr
    (name,) = (one.removeprefix("strategy=") for one in typed if one.startswith("strategy="))
    assert name in (tmp_path / "run" / "tables.txt").read_text()
    # In a feed it is refused before anything is run.
    refused = run(script, *(one for one in typed if one != "setup=query"))
    assert f"error: strategy={name} with setup=feed: it reads queries" in refused.stderr


def test_a_checkpoint_never_names_code_to_import(
    made: Callable[[str], Made], tmp_path: Path
) -> None:
    """What the run was made with is typed again, or is not imported."""
    folder = tmp_path / "run"
    shutil.copytree(made("policy").folder, folder)
    longer = [f"resume={folder}", "training.updates=3"]
    untyped = run("train.py", *longer)
    assert untyped.returncode == 2
    assert untyped.stderr.startswith("error: policy=my_policy:perceptron: a file names code")
    other = run("train.py", *longer, "policy=my_policy:Scores")
    assert "the run was made with policy=my_policy:perceptron" in other.stderr
    typed = run("train.py", *longer, "policy=my_policy:perceptron")
    assert typed.returncode == 0, typed.stderr
    judged = [f"checkpoint={folder}", f"hydra.run.dir={tmp_path / 'judged'}"]
    assert "a file names code" in run("evaluate.py", *judged).stderr
    typed = run("evaluate.py", *judged, "policy=my_policy:perceptron")
    assert typed.returncode == 0, typed.stderr
    alone = run("evaluate.py", "policy=my_policy:perceptron")
    assert "add checkpoint=<its run folder>" in alone.stderr
