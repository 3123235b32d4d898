"""What the docs show that a command makes: the commands of each part, and how long they take."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from typing import Any, NamedTuple

from benchmarks import docs_records, docs_tables
from benchmarks.docs_records import BELIEFS, BEYOND, SETUPS, SPREADS, TAUS
from benchmarks.docs_tables import GALLERY, Writer
from torchrl_pref.config.checks import PER_SECOND
from torchrl_pref.evaluation.metrics import ALWAYS, METRICS
from torchrl_pref.evaluation.records import CSV
from torchrl_pref.pretrained import SEEDS
from torchrl_pref.strategies import FEED_STRATEGIES


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
    write: Writer


HELDOUT, SMALLER = "python evaluate.py protocol=heldout", "pool.size=300"
MADE_FOR_IT = ",".join(
    f"torchrl_pref/policies/weights/{setup}-{tau}-{seed}.pt"
    for setup, tau, seed in product(SETUPS, TAUS, range(SEEDS))
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


def benchmark(
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
    return Part(page, (command,), minutes, docs_tables.measured(choose))


def in_corners(setup: str, corners: str) -> Part:
    """The policies for every task where there is room, on twice as many pools."""
    weights = " ".join(f"torchrl_pref/policies/weights/{setup}-every-{k}.pt" for k in range(SEEDS))
    name = "room_policies" if setup == "query" else "room_feed_policies"
    more = f'--setup {setup} --pools 16 --only "{corners}" --policies {weights}'
    return benchmark(name, "docs/strategies.md", 5, more, "room")


def on_task(task: str) -> Iterator[str]:
    """Two trainings on a task, and the held-out protocol there, with the Gridworld's policies."""
    runs = [f"{{folder}}/{task}-{tau}" for tau in TAUS]
    for tau, run in zip(TAUS, runs, strict=True):
        line = f"python train.py task={task} setup=query tau={tau} hydra.run.dir={run}"
        yield f"{line} -> {task}-{tau}/tables.txt"
    policies = runs + [f"torchrl_pref/policies/weights/query-{tau}-0.pt" for tau in TAUS]
    line = f"{HELDOUT} {SMALLER} task={task} checkpoint=[{','.join(policies)}]"
    yield f"{line} hydra.run.dir={{folder}}/{task}-heldout -> {task}-heldout/{CSV}"


COSTS = {
    "metrics": "docs/metrics.md",
    "questions": "docs/questions.md",
    "strategies": "docs/strategies.md",
    "beliefs": "docs/beliefs.md",
    "sessions": "docs/session.md",
}
"""Where it is said what single calls take, by what they are of."""

EVERY_METRIC = f"evaluation.metrics=[{','.join(name for name in METRICS if name not in ALWAYS)}]"


def on_beliefs() -> Iterator[str]:
    """People of one tau, and of many, before beliefs that are told it, or another, or nothing."""
    line = "python evaluate.py setup=query pool.size=300 evaluation.humans=150 human.tau=4.4"
    for spread, (name, (typed, _)) in product(SPREADS.values(), BELIEFS.items()):
        run = f"{name}_{spread}"
        more = f"{typed} human.spread={spread} {EVERY_METRIC}"
        yield f"{line} {more} hydra.run.dir={{folder}}/{run} -> {run}/{CSV}"


COMPARED = [name for name in FEED_STRATEGIES if name not in ("random", *PER_SECOND)]
"""Strategies of both setups that need no model of time."""

SWEEP = "hydra.sweep.dir={folder}/sweep"
TWO = "hydra/launcher=joblib hydra.launcher.n_jobs=2"
CELLS = [f"{setup}-{tau}" for setup in ("feed", "query") for tau in ("noisy", "optimal")]
MORE = 31
"""Runs of the cell in which one training tells least, with other seeds."""

JUDGED = (*CELLS, *(f"sweep/{job}" for job in range(MORE)))
"""The folders of all runs that stand beside the package's policies."""

SHEET = "python -m torchrl_pref.tasks {task} --animate --out {{folder}}/{task}.png -> {task}.gif"
PENDULUM = "python examples/pendulum_file.py {folder}/pendulum.csv 2000 -> pendulum.csv"
START = "policy.start=information_gain training.learning_rate=0.01 training.updates=200"

PARTS: dict[str, Part] = {
    "pretrained": Part(
        "README.md",
        (f"python evaluate.py policy=pretrained setup=query hydra.run.dir={{folder}} -> {CSV}",),
        0.5,
        docs_records.pretrained,
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
    "authors": benchmark("authors", "docs/gallery.md", 0.5),
    "heldout": Part(
        "docs/results.md",
        (f"{HELDOUT} checkpoint=[{MADE_FOR_IT}] hydra.run.dir={{folder}} -> {CSV}",),
        8,
        docs_records.heldout,
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
        docs_records.paper,
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
        docs_records.objectives,
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
        docs_records.noise_range,
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
        docs_records.tasks,
    ),
    "literature": Part(
        "docs/results.md",
        (*on_task("driver"), *on_task("lds")),
        12,
        docs_records.literature,
    ),
    "beyond": Part(
        "docs/results.md",
        tuple(
            f"{HELDOUT} {SMALLER} {typed} tau=noisy hydra.run.dir={{folder}}/{name} -> {name}/{CSV}"
            for name, typed in BEYOND.items()
        ),
        50,
        docs_records.beyond,
    ),
    "into_package": benchmark("into_package", "docs/extending.md", 4),
    "batches": benchmark("batches", "docs/batches.md", 20),
    "answers": benchmark("answers", "docs/questions.md", 3, "--plot {folder}/answers.png"),
    "quality": Part(
        "docs/results.md",
        (
            "python benchmarks/main_job.py --folder {folder}/runs -> runs/query-optimal/tables.txt",
            "python train.py -m setup=feed tau=noisy evaluation.humans=20 "
            f"seed={','.join(map(str, range(1, 1 + MORE)))} {TWO} "
            f"hydra.sweep.dir={{folder}}/runs/sweep -> runs/sweep/{MORE - 1}/tables.txt",
            "python benchmarks/quality.py "
            f"{' '.join(f'{{folder}}/runs/{run}' for run in JUDGED)} "
            "--json {folder}/quality.json -> quality.json",
        ),
        40,
        docs_tables.measured(),
    ),
    "select": benchmark("select", "docs/speed.md", 3),
    "limit": benchmark("limit", "docs/speed.md", 2),
    "belief": benchmark("belief", "docs/speed.md", 10, choose=docs_tables.after_twenty),
    "session": benchmark("session", "docs/speed.md", 2),
    "scale": benchmark(
        "scale",
        "docs/speed.md",
        5,
        "--plot {folder}/scale.png",
        choose=docs_tables.ends,
    ),
    "train": benchmark("train", "docs/speed.md", 10),
    "main_job": benchmark("main_job", "docs/speed.md", 7),
    "study": benchmark("study", "docs/study.md", 15),
    "study_times": benchmark("study_times", "docs/study.md", 5),
    "page": benchmark("page", "docs/study.md", 10),
    "drives": Part(
        "docs/reward.md",
        ("python examples/drive_by_reward.py {folder} -> drives.png",),
        0.2,
        docs_tables.measured(),
    ),
    "pictures": Part(
        "docs/study.md",
        ("python benchmarks/page.py --pictures {folder}/page -> page/error-phone.png",),
        2,
        docs_tables.pictures,
    ),
    "room": benchmark("room", "docs/strategies.md", 70),
    "room_finer": benchmark(
        "room_finer", "docs/strategies.md", 8, '--pools 16 --only "D=8;tau unknown"', "room"
    ),
    "room_feed": benchmark("room_feed", "docs/strategies.md", 40, "--setup feed", "room"),
    "room_policies": in_corners("query", "D=8;D=16;K=5;N=50"),
    "room_feed_policies": in_corners("feed", "H=20;D=16;70%, H=20;N=50;isotropic, H=20"),
    "room_kinds": benchmark("room_kinds", "docs/strategies.md", 35, "--humans 60"),
    **{f"{of}_cost": benchmark(f"{of}_cost", page, 0.5, of, "costs") for of, page in COSTS.items()},
    "large_pool": benchmark("large_pool", "docs/speed.md", 3),
    "aprel": Part(
        "docs/aprel.md",
        (
            "python benchmarks/aprel.py posterior --json {folder}/aprel.json -> aprel.json",
            "python benchmarks/aprel.py tutorial --json {folder}/aprel-tutorial.json "
            "-> aprel-tutorial.json",
        ),
        5,
        docs_tables.measured(),
    ),
    "rationality": benchmark(
        "rationality",
        "docs/beliefs.md",
        8,
        "--seed 1 --plot {folder}/calibration.png",
        choose=docs_tables.inferred,
    ),
    "rationality_bound": benchmark(
        "rationality_bound", "docs/beliefs.md", 9, "--seed 1", choose=docs_tables.inferred
    ),
    "laplace": benchmark("laplace", "docs/beliefs.md", 2),
    "humans": benchmark("humans", "docs/humans.md", 8),
    "metrics": Part("docs/metrics.md", tuple(on_beliefs()), 5, docs_records.metrics),
    "strategies": Part(
        "docs/strategies.md",
        tuple(
            f"python evaluate.py setup={setup} strategy=[{','.join(COMPARED)}] "
            f"hydra.run.dir={{folder}}/{setup} -> {setup}/{CSV}"
            for setup in SETUPS
        ),
        10,
        docs_records.strategies,
    ),
    "posterior": benchmark(
        "posterior", "docs/robustness.md", 40, "--features 2,4,6,8 --sessions 100"
    ),
    "dimension": benchmark("dimension", "docs/robustness.md", 30, "--features 8,16,32"),
    "bad_settings": benchmark("bad_settings", "docs/robustness.md", 7, "--sample 2500 --seed 7"),
    "bad_files": benchmark("bad_files", "docs/robustness.md", 5, choose=docs_tables.harmed),
    "kills": benchmark("kills", "docs/robustness.md", 15),
    "faults": benchmark("faults", "docs/robustness.md", 8),
    "versions": Part(
        "docs/speed.md",
        tuple(
            f"python benchmarks/versions.py {commit} --json {{folder}}/{name}.json -> {name}.json"
            for name, commit in (("versions", "672a7d5"), ("versions-choice", "3a5bf4f"))
        ),
        6,
        docs_tables.measured(),
    ),
}
"""In the order in which they are made. The minutes of ``pretrained``, ``heldout`` and ``main_job``
were measured, those of trainings follow from what one takes, and those of the other benchmarks are
estimates."""
