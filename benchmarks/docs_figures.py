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
import csv
import json
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable, Iterator
from itertools import product
from typing import Any, NamedTuple

from tabulate import tabulate
from torch import Tensor
from tqdm import tqdm

from torchrl_pref.evaluation.figures import figure_1, heldout_figure
from torchrl_pref.evaluation.records import CSV, Records, read_records
from torchrl_pref.evaluation.style import is_feed, is_judged, kind_of, name_of
from torchrl_pref.evaluation.tables import signed, title_of
from torchrl_pref.evaluation.views import (
    alignment,
    answers_to_reach,
    difference,
    mean_and_interval,
    milestones,
)
from torchrl_pref.pretrained import SEEDS

DOCS = ROOT / "docs"

Rows = list[dict[str, str]]


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
    write: Callable[[Path], dict[str, str]]


def table(rows: Rows) -> str:
    """As Markdown."""
    return tabulate(rows, headers="keys", tablefmt="pipe", disable_numparse=True)


def benchmark(name: str) -> Callable[[Path], dict[str, str]]:
    """The table that a benchmark left as JSON."""

    def write(folder: Path) -> dict[str, str]:
        found = json.loads((folder / f"{name}.json").read_text())
        if (folder / f"{name}.png").exists():
            shutil.copy(folder / f"{name}.png", DOCS)
        rows = [{key: cell(value) for key, value in row.items()} for row in found["rows"]]
        return {name: f"{found['title']}; {found['machine']}.\n\n{table(rows)}"}

    return write


def beside_aprel(folder: Path) -> dict[str, str]:
    """The tables of ours beside APReL."""
    tutorial = benchmark("aprel_tutorial")(folder)["aprel_tutorial"]
    return {**benchmark("aprel")(folder), "aprel-tutorial": tutorial}


def cell(value: Any) -> str:
    """Three digits of a number, and all of a whole one."""
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) else str("" if value is None else value)


def pretrained(folder: Path) -> dict[str, str]:
    """The first figure of the README."""
    figure_1(read_records(folder / CSV), DOCS / "pretrained.png")
    return {}


def gallery(folder: Path) -> dict[str, str]:
    """The pictures of the gallery."""
    (DOCS / "gallery").mkdir(exist_ok=True)
    for task in GALLERY:
        for kind in ("png", "gif"):
            shutil.copy(folder / f"{task}.{kind}", DOCS / "gallery")
    return {}


def drives(folder: Path) -> dict[str, str]:
    """How a car drives before and after it learned what somebody wants."""
    shutil.copy(folder / "drives.png", DOCS)
    return {}


def pictures(folder: Path) -> dict[str, str]:
    """The page of a study on a desktop and a phone."""
    shutil.copytree(folder / "page", DOCS / "study", dirs_exist_ok=True)
    return {}


def heldout(folder: Path) -> dict[str, str]:
    """A table for each cell of the protocol, its figure, and its curves."""
    records = read_records(folder / CSV)
    heldout_figure(records, DOCS / "heldout.png")
    with (DOCS / "heldout.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["task", "strategy", "queries", "mean", "low", "high"])
        for task in records.tasks:
            own = records.of_task(task)
            for key in own.strategies:
                for query, column in enumerate(alignment(own, key).unbind(-1)):
                    numbers = (f"{number:.5f}" for number in mean_and_interval(column))
                    writer.writerow([task, key, query, *numbers])
    return {
        f"heldout-{task.replace('/', '-')}": table(heldout_rows(records.of_task(task)))
        for task in records.tasks
    }


def heldout_rows(records: Records) -> Rows:
    """A line for each strategy of one cell, with the policy's paired difference to it."""
    policy = next(key for key in records.strategies if is_judged(key))
    information = next(k for k in records.strategies if kind_of(k).endswith("_information"))
    _, half, budget = milestones(alignment(records, policy).shape[-1] - 1)
    level = float(alignment(records, information).mean((0, 1, 2))[half])
    rows = []
    for key in records.strategies:
        values, gap = alignment(records, key), difference(records, policy, key)
        few = values.shape[2] < alignment(records, policy).shape[2]
        name = f"{name_of(key)}, {values.shape[2]} humans a pool" if few else name_of(key)
        row = {
            "strategy": f"**{name}**" if key == policy else name,
            f"after {half}": f"{values[..., half].mean():.3f}",
            f"after {budget}": f"{values[..., -1].mean():.3f}",
            f"mean of 1 to {budget}": f"{values[..., 1:].mean():.3f}",
            f"RL minus it, after {budget}": "" if key == policy else interval(gap[..., -1]),
            "RL minus it, mean": "" if key == policy else interval(gap[..., 1:].mean(-1)),
            f"reaches {level:.3f} after": answers_to_reach(records, key, level),
            "bits": f"{records.values(key, 'information').mean():.2f}",
        }
        if is_feed(key, records.strategies):
            row["offers seen"] = f"{records.values(key, 'offered').mean():.0f}"
        else:
            row["repeats"] = f"{records.values(key, 'repeated').mean():.1f}"
        row["ms to choose"] = f"{1000 * records.values(key, 'seconds_to_choose').mean():.2f}"
        rows.append(row)
    return rows


def interval(gap: Tensor) -> str:
    """Mean of paired differences, with its 95% interval."""
    mean, low, high = mean_and_interval(gap)
    return signed(mean, (low, high))


def paper(folder: Path) -> dict[str, str]:
    """The paper's two figures, final alignments, and the differences that its claims are about."""
    records = read_records(folder / "evaluation" / CSV)
    figure_1(records, DOCS / "figure_1.png")
    shutil.copy(folder / "evaluation" / "figure_2.png", DOCS)
    final, apart = [], []
    for key in records.strategies:
        row, other_row = {"alignment after 20 queries": name_of(key)}, {"minus": name_of(key)}
        for task in records.tasks:
            own, title = records.of_task(task), title_of(task)
            row[title] = f"{alignment(own, key)[..., -1].mean():.3f}"
            for policy in filter(is_judged, own.strategies):
                gap = difference(own, policy, key)[..., -1]
                other_row[f"{name_of(policy)}, {title}"] = interval(gap)
        final.append(row)
        if kind_of(key) in ("random", "greedy_information"):
            apart.append(other_row)
    return {"paper": f"{table(final)}\n\n{table(transposed(apart))}"}


def transposed(rows: Rows) -> Rows:
    """Columns as rows: what has many of them is read better so."""
    head, *names = rows[0]
    return [{"": name, **{f"{head} {row[head]}": row[name] for row in rows}} for name in names]


def objectives(folder: Path) -> dict[str, str]:
    """What an objective is worth, and what is learned from nothing: one training of each."""
    rows = []
    for run in ("control", "started", "mean", "covariance", "samples"):
        records = read_records(folder / f"{run}-evaluated" / CSV)
        for key in (
            records.strategies if run == "control" else filter(is_judged, records.strategies)
        ):
            gap = difference(records, key, "greedy_information")[..., -1]
            row = {"strategy": f"{name_of(key)}, {run}" if is_judged(key) else name_of(key)}
            values = alignment(records, key)
            row |= {f"after {j}": f"{values[..., j].mean():.3f}" for j in milestones(20)}
            row["minus information_gain, last"] = interval(gap)
            rows.append(row)
    return {"objectives": table(rows)}


def tasks(folder: Path) -> dict[str, str]:
    """All strategies on the literature's tasks, and the policy for every task beside the two rules
    that it has to be as good as, on all tasks that no training saw."""
    found = [read_records(path) for path in sorted(folder.glob(f"*/{CSV}"))]
    cells = {cell: records.of_task(cell) for records in found for cell in records.tasks}
    tables = {}
    for cell in (f"query/{tau}/{task}" for task in ("driver", "lds") for tau in TAUS):
        rows = []
        for key in cells[cell].strategies:
            values, gap = (
                alignment(cells[cell], key),
                difference(cells[cell], key, "greedy_information"),
            )
            row = {"strategy": name_of(key)}
            row |= {f"after {j}": f"{values[..., j].mean():.3f}" for j in milestones(20)}
            row["mean of 1 to 20"] = f"{values[..., 1:].mean():.3f}"
            row["minus information_gain, mean"] = (
                "" if key == "greedy_information" else interval(gap[..., 1:].mean(-1))
            )
            rows.append(row)
        tables[f"tasks-{cell.replace('/', '-')}"] = table(rows)
    order = sorted(cells, key=lambda cell: (cell.split("/")[0] == "feed", cell.split("/")[2]))
    return {**tables, "tasks-every": table([every_row(cell, cells[cell]) for cell in order])}


def every_row(cell: str, records: Records) -> dict[str, str]:
    """One cell of the policy for every task."""
    setup, tau, task = cell.split("/")
    return {"setup, human": f"{setup}, {tau}", "task": task, **beside_rules(setup, records)}


def beside_rules(setup: str, records: Records) -> dict[str, str]:
    """The policy beside both rules of a setup, in the mean over the questions."""
    policy = next(key for key in records.strategies if is_judged(key))
    rule = "quantile" if setup == "feed" else "greedy"
    information, rule_alignment = f"{rule}_information", f"{rule}_alignment"

    def gap(first: str, second: str) -> str:
        return interval(difference(records, first, second)[..., 1:].mean(-1))

    return {
        "by information": f"{alignment(records, information)[..., 1:].mean():.3f}",
        "alignment − information": gap(rule_alignment, information),
        "RL − information": gap(policy, information),
        "RL − alignment": gap(policy, rule_alignment),
    }


BEYOND = {
    "2_features": "task=gaussian task.dimension=2 setup.budget=10",
    "8_features": "task=gaussian task.dimension=8 setup.budget=10",
    "24_features": "task=gaussian task.dimension=24 task.skew=3000 belief=laplace",
    "weak": "task=driver question=weak",
    "tau_unknown": "task=driver belief=rationality",
}
"""What else than choices between two options is tried, by name; its humans are noisy."""


def beyond(folder: Path) -> dict[str, str]:
    """The policy for every task beside both rules where questions or beliefs are others."""
    rows = []
    for setup, name in product(("query", "feed"), BEYOND):
        records = read_records(folder / name / CSV)
        cell = next(cell for cell in records.tasks if cell.startswith(setup))
        row = beside_rules(setup, records.of_task(cell))
        rows.append({"setup": setup, "what": name.replace("_", " "), **row})
    return {"tasks-beyond": table(rows)}


TAUS = ("noisy", "optimal")
HELDOUT, SMALLER = "python evaluate.py protocol=heldout", "pool.size=300"
MADE_FOR_IT = ",".join(
    f"torchrl_pref/policies/weights/{setup}-{tau}-{seed}.pt"
    for setup, tau, seed in product(("query", "feed"), TAUS, range(SEEDS))
)
"""The policies that were trained on the Gridworld."""


TRAIN, EVALUATE = "python train.py setup=query tau=noisy", "evaluation.humans=300"


def trained(name: str, *settings: str) -> Iterator[str]:
    """A training, and its evaluation on 300 humans."""
    run = f"{{folder}}/{name}"
    yield f"{TRAIN} {' '.join(settings)} hydra.run.dir={run} -> {name}/tables.txt"
    evaluation = f"python evaluate.py checkpoint={run} {EVALUATE} hydra.run.dir={run}-evaluated"
    yield f"{evaluation} -> {name}-evaluated/{CSV}"


def measured(
    name: str, page: str, minutes: float, more: str = "", script: str | None = None
) -> Part:
    """A benchmark that writes its table as JSON: of the part's name, or another."""
    command = (
        f"python benchmarks/{script or name}.py {more} --json {{folder}}/{name}.json -> {name}.json"
    )
    return Part(page, (command,), minutes, benchmark(name))


SWEEP = "hydra.sweep.dir={folder}/sweep"
TWO = "hydra/launcher=joblib hydra.launcher.n_jobs=2"
CELLS = [f"{setup}-{tau}" for setup in ("feed", "query") for tau in ("noisy", "optimal")]
GALLERY = ("gridworld", "driver", "lds", "gymnasium")
SHEET = "python -m torchrl_pref.tasks {task} --animate --out {{folder}}/{task}.png -> {task}.gif"
START = "policy.start=information_gain training.learning_rate=0.01 training.updates=200"

PARTS: dict[str, Part] = {
    "pretrained": Part(
        "README.md",
        (f"python evaluate.py policy=pretrained setup=query hydra.run.dir={{folder}} -> {CSV}",),
        0.5,
        pretrained,
    ),
    "gallery": Part(
        "docs/gallery.md", tuple(SHEET.format(task=task) for task in GALLERY), 0.5, gallery
    ),
    "heldout": Part(
        "docs/results.md",
        (f"{HELDOUT} checkpoint=[{MADE_FOR_IT}] hydra.run.dir={{folder}} -> {CSV}",),
        13,
        heldout,
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
        paper,
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
        objectives,
    ),
    "tasks": Part(
        "docs/results.md",
        (
            f"{HELDOUT} {SMALLER} tasks=[driver,lds,gymnasium] hydra.run.dir={{folder}}/tasks "
            f"-> tasks/{CSV}",
            "python examples/pendulum_file.py {folder}/pendulum.csv 2000 -> pendulum.csv",
            f"{HELDOUT} {SMALLER} task=files task.path={{folder}}/pendulum.csv "
            f"hydra.run.dir={{folder}}/files -> files/{CSV}",
        ),
        40,
        tasks,
    ),
    "beyond": Part(
        "docs/results.md",
        tuple(
            f"{HELDOUT} {SMALLER} {typed} tau=noisy hydra.run.dir={{folder}}/{name} -> {name}/{CSV}"
            for name, typed in BEYOND.items()
        ),
        25,
        beyond,
    ),
    "batches": measured("batches", "docs/batches.md", 20),
    "answers": measured("answers", "docs/questions.md", 3, "--plot {folder}/answers.png"),
    "quality": Part(
        "docs/results.md",
        (
            "python benchmarks/main_job.py --folder {folder}/runs -> runs/query-optimal/tables.txt",
            f"python benchmarks/quality.py {' '.join(f'{{folder}}/runs/{c}' for c in CELLS)} "
            "--json {folder}/quality.json -> quality.json",
        ),
        20,
        benchmark("quality"),
    ),
    "select": measured("select", "docs/speed.md", 3),
    "limit": measured("limit", "docs/speed.md", 2),
    "belief": measured("belief", "docs/speed.md", 10),
    "session": measured("session", "docs/speed.md", 2),
    "scale": measured("scale", "docs/speed.md", 5, "--plot {folder}/scale.png"),
    "train": measured("train", "docs/speed.md", 10),
    "main_job": measured("main_job", "docs/speed.md", 7),
    "study": measured("study", "docs/study.md", 15),
    "study_times": measured("study_times", "docs/study.md", 5),
    "page": measured("page", "docs/study.md", 10),
    "drives": Part(
        "docs/reward.md",
        ("python examples/drive_by_reward.py {folder} -> drives.png",),
        0.2,
        drives,
    ),
    "pictures": Part(
        "docs/study.md",
        ("python benchmarks/page.py --pictures {folder}/page -> page/error-phone.png",),
        2,
        pictures,
    ),
    "room": measured("room", "docs/strategies.md", 40),
    "room_finer": measured(
        "room_finer", "docs/strategies.md", 8, '--pools 16 --only "D=8;tau unknown"', "room"
    ),
    "room_feed": measured("room_feed", "docs/strategies.md", 40, "--setup feed", "room"),
    "large_pool": measured("large_pool", "docs/speed.md", 1),
    "aprel": Part(
        "docs/aprel.md",
        (
            "python benchmarks/aprel.py posterior --json {folder}/aprel.json -> aprel.json",
            "python benchmarks/aprel.py tutorial --json {folder}/aprel_tutorial.json "
            "-> aprel_tutorial.json",
        ),
        5,
        beside_aprel,
    ),
    "dimension": measured("dimension", "docs/robustness.md", 30, "--features 8,16,32"),
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
