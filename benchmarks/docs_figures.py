"""Make again what the README and docs/ show: figures, tables between marks, and their CSV files.

``make docs-figures``, or ``python benchmarks/docs_figures.py [--only NAME[,NAME]] [--list]``. Each
part is the commands that the page states, as processes of their own, in folders under
``multirun/docs`` (or ``--folder``). ``--list`` says what there is and how long each part takes, on
two idle cores. What a command already left in that folder is used and not made again, so that a
stopped run goes on and a table or figure can be written anew from its records: remove a part's
folder to measure it again.

A table stands in its page between ``<!-- begin: NAME -->`` and ``<!-- end: NAME -->``; the first
line says which commit made it. What is between is replaced, and nothing else.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)  # this folder's select.py hides Python's

import argparse
import os
import re
import shlex
import subprocess
from collections.abc import Callable, Iterator
from itertools import product
from typing import Any, NamedTuple

from tabulate import tabulate
from tqdm import tqdm

from benchmarks import docs_tables
from benchmarks.docs_tables import BEYOND, GALLERY, TAUS, benchmark
from torchrl_pref.evaluation.records import CSV
from torchrl_pref.pretrained import SEEDS


class Part(NamedTuple):
    """Something that the docs show.

    Attributes:
        page: where its tables stand.
        commands: what is run, with ``{folder}`` for the part's own folder. The file after ``->`` is
            what the command leaves there: where it exists the command is not run again.
        minutes: that it takes on two idle cores.
        write: from the part's folder, the tables by the name of their marks; makes its figures.
    """

    page: str
    commands: tuple[str, ...]
    minutes: float
    write: docs_tables.Writer


HELDOUT, SMALLER = "python evaluate.py protocol=heldout", "pool.size=300"
MADE_FOR_IT = ",".join(
    f"torchrl_pref/policies/weights/{setup}-{tau}-{seed}.pt"
    for setup, tau, seed in product(("query", "feed"), TAUS, range(SEEDS))
)
"""The policies that were trained on the Gridworld."""


FIRST = "torchrl_pref/policies/weights/query-noisy-0.pt"
TRAIN, EVALUATE = "python train.py setup=query tau=noisy", "evaluation.humans=300"


def trained(name: str, *settings: str) -> Iterator[str]:
    """A training, and its evaluation on 300 humans."""
    run = f"{{folder}}/{name}"
    yield f"{TRAIN} {' '.join(settings)} hydra.run.dir={run} -> {name}/tables.txt"
    evaluation = f"python evaluate.py checkpoint={run} {EVALUATE} hydra.run.dir={run}-evaluated"
    yield f"{evaluation} -> {name}-evaluated/{CSV}"


def measured(
    name: str,
    page: str,
    minutes: float,
    more: str = "",
    script: str | None = None,
    choose: Callable[[Any], Any] = list,
) -> Part:
    """A benchmark that writes its table as JSON: of the part's name, or another; of its rows the
    page shows what ``choose`` makes of them."""
    command = (
        f"python benchmarks/{script or name}.py {more} --json {{folder}}/{name}.json -> {name}.json"
    )
    return Part(page, (command,), minutes, benchmark(name, choose))


def on_task(task: str) -> Iterator[str]:
    """Two trainings on a task, and the held-out protocol there, with the Gridworld's policies."""
    runs = [f"{{folder}}/{task}-{tau}" for tau in TAUS]
    for tau, run in zip(TAUS, runs, strict=True):
        line = f"python train.py task={task} setup=query tau={tau} hydra.run.dir={run}"
        yield f"{line} -> {task}-{tau}/tables.txt"
    policies = runs + [f"torchrl_pref/policies/weights/query-{tau}-0.pt" for tau in TAUS]
    line = f"{HELDOUT} {SMALLER} task={task} checkpoint=[{','.join(policies)}]"
    yield f"{line} hydra.run.dir={{folder}}/{task}-heldout -> {task}-heldout/{CSV}"


SWEEP = "hydra.sweep.dir={folder}/sweep"
TWO = "hydra/launcher=joblib hydra.launcher.n_jobs=2"
CELLS = [f"{setup}-{tau}" for setup in ("feed", "query") for tau in ("noisy", "optimal")]
MORE = {seed: f"feed-noisy-{seed}" for seed in range(1, SEEDS)}
"""Runs of the cell in which one training tells least, with other seeds."""

SHEET = "python -m torchrl_pref.tasks {task} --animate --out {{folder}}/{task}.png -> {task}.gif"
PENDULUM = "python examples/pendulum_file.py {folder}/pendulum.csv 2000 -> pendulum.csv"
START = "policy.start=information_gain training.learning_rate=0.01 training.updates=200"

PARTS: dict[str, Part] = {
    "pretrained": Part(
        "README.md",
        (f"python evaluate.py policy=pretrained setup=query hydra.run.dir={{folder}} -> {CSV}",),
        0.5,
        docs_tables.pretrained,
    ),
    "gallery": Part(
        "docs/gallery.md",
        (
            *(SHEET.format(task=task) for task in GALLERY),
            PENDULUM,
            "python -m torchrl_pref.tasks files path={folder}/pendulum.csv "
            "--out {folder}/files.png -> files.png",
        ),
        1,
        docs_tables.gallery,
    ),
    "heldout": Part(
        "docs/results.md",
        (f"{HELDOUT} checkpoint=[{MADE_FOR_IT}] hydra.run.dir={{folder}} -> {CSV}",),
        8,
        docs_tables.heldout,
    ),
    "paper": Part(
        "docs/paper.md",
        (
            f"python train.py -m setup=query,feed tau=noisy,optimal experiment=paper {TWO} {SWEEP} "
            "-> sweep/3/tables.txt",
            "python evaluate.py checkpoint={folder}/sweep hydra.run.dir={folder}/evaluation "
            f"-> evaluation/{CSV}",
        ),
        20,
        docs_tables.paper,
    ),
    "objectives": Part(
        "docs/results.md",
        (
            *trained("control", "objective=information_gain"),
            *trained("started", START),
            *trained("mean", "experiment=attention policy.tokens=mean"),
            *trained("covariance", "experiment=attention policy.tokens=covariance"),
            *trained("samples", "experiment=attention policy.tokens=samples"),
        ),
        80,
        docs_tables.objectives,
    ),
    "noise_range": Part(
        "docs/results.md",
        (
            f"{TRAIN} human.spread=4 hydra.run.dir={{folder}}/range -> range/tables.txt",
            # One update is one of the critic alone: the policy stays what it was.
            f"{TRAIN} human.spread=4 checkpoint={FIRST} training.updates=1 "
            "hydra.run.dir={folder}/one -> one/tables.txt",
            f"python evaluate.py checkpoint=[{{folder}}/range,{{folder}}/one] {EVALUATE} "
            f"hydra.run.dir={{folder}}/evaluated -> evaluated/{CSV}",
        ),
        5,
        docs_tables.noise_range,
    ),
    "tasks": Part(
        "docs/results.md",
        (
            f"{HELDOUT} {SMALLER} tasks=[driver,lds,gymnasium] hydra.run.dir={{folder}}/tasks "
            f"-> tasks/{CSV}",
            PENDULUM,
            f"{HELDOUT} {SMALLER} task=files task.path={{folder}}/pendulum.csv "
            f"hydra.run.dir={{folder}}/files -> files/{CSV}",
        ),
        11,
        docs_tables.tasks,
    ),
    "literature": Part(
        "docs/results.md",
        (*on_task("driver"), *on_task("lds")),
        12,
        docs_tables.literature,
    ),
    "beyond": Part(
        "docs/results.md",
        tuple(
            f"{HELDOUT} {SMALLER} {typed} tau=noisy hydra.run.dir={{folder}}/{name} -> {name}/{CSV}"
            for name, typed in BEYOND.items()
        ),
        25,
        docs_tables.beyond,
    ),
    "into_package": measured("into_package", "docs/extending.md", 4),
    "batches": measured("batches", "docs/batches.md", 20),
    "answers": measured("answers", "docs/questions.md", 3, "--plot {folder}/answers.png"),
    "quality": Part(
        "docs/results.md",
        (
            "python benchmarks/main_job.py --folder {folder}/runs -> runs/query-optimal/tables.txt",
            *(
                f"python train.py setup=feed tau=noisy seed={seed} "
                f"hydra.run.dir={{folder}}/runs/{run} -> runs/{run}/tables.txt"
                for seed, run in MORE.items()
            ),
            "python benchmarks/quality.py "
            f"{' '.join(f'{{folder}}/runs/{run}' for run in (*CELLS, *MORE.values()))} "
            "--json {folder}/quality.json -> quality.json",
        ),
        20,
        benchmark("quality"),
    ),
    "select": measured("select", "docs/speed.md", 3),
    "limit": measured("limit", "docs/speed.md", 2),
    "belief": measured("belief", "docs/speed.md", 10, choose=docs_tables.after_twenty),
    "session": measured("session", "docs/speed.md", 2),
    "scale": measured(
        "scale",
        "docs/speed.md",
        5,
        "--plot {folder}/scale.png",
        choose=docs_tables.ends,
    ),
    "train": measured("train", "docs/speed.md", 10),
    "main_job": measured("main_job", "docs/speed.md", 7),
    "study": measured("study", "docs/study.md", 15),
    "study_times": measured("study_times", "docs/study.md", 5),
    "page": measured("page", "docs/study.md", 10),
    "drives": Part(
        "docs/reward.md",
        ("python examples/drive_by_reward.py {folder} -> drives.png",),
        0.2,
        docs_tables.drives,
    ),
    "pictures": Part(
        "docs/study.md",
        ("python benchmarks/page.py --pictures {folder}/page -> page/error-phone.png",),
        2,
        docs_tables.pictures,
    ),
    "room": measured("room", "docs/strategies.md", 40),
    "room_finer": measured(
        "room_finer", "docs/strategies.md", 8, '--pools 16 --only "D=8;tau unknown"', "room"
    ),
    "room_feed": measured("room_feed", "docs/strategies.md", 40, "--setup feed", "room"),
    "large_pool": measured("large_pool", "docs/speed.md", 3),
    "aprel": Part(
        "docs/aprel.md",
        (
            "python benchmarks/aprel.py posterior --json {folder}/aprel.json -> aprel.json",
            "python benchmarks/aprel.py tutorial --json {folder}/aprel_tutorial.json "
            "-> aprel_tutorial.json",
        ),
        5,
        docs_tables.beside_aprel,
    ),
    "dimension": measured("dimension", "docs/robustness.md", 30, "--features 8,16,32"),
    "faults": measured("faults", "docs/robustness.md", 8),
}
"""In the order in which they are made. The minutes of ``pretrained``, ``heldout`` and ``main_job``
were measured, those of trainings follow from what one takes, and those of the other benchmarks are
estimates. What ``posterior.py`` (hours), ``versions.py`` (needs an earlier checkout),
``bad_settings.py``, ``bad_files.py`` and ``kills.py`` print is copied into the pages by hand."""


def commit() -> str:
    """The commit that the working tree is at, and whether there is more in it."""

    def git(*arguments: str) -> str:
        line = ["git", *arguments]
        return subprocess.run(line, cwd=ROOT, capture_output=True, text=True).stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no", "--", "torchrl_pref", "conf")
    return (git("rev-parse", "--short", "HEAD") or "unknown") + (" with changes" if changed else "")


def make(name: str, folder: Path) -> None:
    """Run what is missing of a part, and write it into its page."""
    part, folder = PARTS[name], folder / name
    folder.mkdir(parents=True, exist_ok=True)
    stamp = folder / "commit.txt"
    for line in part.commands:
        command, _, left = line.partition(" -> ")
        if not (folder / left).exists():
            words = shlex.split(command.format(folder=folder))
            stamp.write_text(commit())
            tqdm.write(f"{name}: {shlex.join(words)}")
            subprocess.run([sys.executable, *words[1:]], cwd=ROOT, check=True)
    page = ROOT / part.page
    text = page.read_text()
    for mark, content in part.write(folder).items():
        text = between(text, mark, f"*Made at commit {stamp.read_text()}.*\n\n{content}")
    page.write_text(text)


def between(text: str, mark: str, content: str) -> str:
    """A page with something else between two marks.

    Raises:
        ValueError: the page has no such marks.
    """
    begin, end = f"<!-- begin: {mark} -->\n", f"<!-- end: {mark} -->"
    found = re.compile(re.escape(begin) + ".*?" + re.escape(end), re.S)
    if not found.search(text):
        raise ValueError(f"no {begin.strip()} … {end.strip()} in the page")
    return found.sub(lambda _: f"{begin}{content}\n{end}", text)


def overview(names: list[str]) -> str:
    """What each part makes, and how long it takes."""
    rows = [{"part": n, "minutes": f"{PARTS[n].minutes:g}", "page": PARTS[n].page} for n in names]
    total = sum(PARTS[name].minutes for name in names)
    time = f"{total / 60:.1f} hours" if total > 60 else f"{total:g} minutes"
    lines = tabulate(rows, headers="keys", disable_numparse=True)
    return f"{lines}\n\n{time} in all on two idle cores, less what is there already"


def main() -> None:
    """Say how long it takes, and make it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--only", help=f"parts, by commas: {', '.join(PARTS)}")
    parser.add_argument("--list", action="store_true", help="say what there is, and stop")
    parser.add_argument("--folder", type=Path, default=ROOT / "multirun" / "docs")
    typed = parser.parse_args()
    names = typed.only.split(",") if typed.only else list(PARTS)
    for name in names:
        if name not in PARTS:
            parser.error(f"--only {name}: expected some of {', '.join(PARTS)}")
    print(overview(names), flush=True)
    if typed.list:
        return
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    total = sum(PARTS[name].minutes for name in names)
    form = "{desc}{percentage:3.0f}% |{bar}| {elapsed}"
    with tqdm(total=total, bar_format=form) as bar:
        for name in names:
            bar.set_description(name)
            make(name, typed.folder.absolute())
            bar.update(PARTS[name].minutes)
    print("written; look at the figures, and at git diff docs README.md")


if __name__ == "__main__":
    main()
