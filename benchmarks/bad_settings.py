"""Thousands of bad settings, made from the configuration itself, through the real door.

Each key is given what its default is not: other types, numbers out of range, lists, words,
interpolations; groups, Hydra's own keys and flags are bent as well. Each command line runs in a
process forked from a warm one, in a folder of its own, under limits of time and memory. Some are
legal after all: they are stopped where their work would start. A few of the refused are run again
as processes of their own, which must say the same.

    python benchmarks/bad_settings.py               all: half an hour of CPU; Ctrl-C ends it early
    python benchmarks/bad_settings.py --sample 200  a random sample
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path[0] = str(ROOT)  # not benchmarks, whose select.py would be found before Python's own

import collections
import contextlib
import functools
import os
import random
import resource
import runpy
import shlex
import shutil
import signal
import subprocess
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from benchmarks import common

LIMIT_S, LIMIT_BYTES = 60, 4 * 10**9
"""Of each command: seconds, and bytes beyond what the warm process holds."""

STARTED = 77
"""Status of a command that was stopped where its work would start."""

FAULTS = ("traceback", "more than one line", "hang", "crash", "left files")

COLUMNS = {
    "refused in one line": "refused",
    "legal, stopped where work starts": "started",
    "answered, as --help is": "answered",
    **{fault: fault for fault in FAULTS},
}
"""Of the table, and which outcome each counts."""

ANY = ["null", "true", "word", "WORD", "''", "' '", "'null'", "[]", "[1,2]", "[[1]]", "{}", "{a:1}"]
ANY += ["ω", "'a b'", '"quoted"', "a'b", "a=b", "x" * 5000, "[" * 300, "${seed}", "${nosuch}", "${"]
ANY += [
    "${oc.env:NOPE}",
    "${tau}",
    "${now:%Y}",
    "???",
    "",
    "a,b",
    "range(3)",
    "1:2",
    "\\",
    "{a:",
    "%",
]
NUMBERS = [
    "0",
    "-1",
    "-0",
    "-0.0",
    "0.5",
    "1e400",
    "-1e400",
    "nan",
    "inf",
    "-inf",
    "1e-300",
    "1e300",
]
NUMBERS += [
    "1000000000",
    str(10**12),
    str(2**63),
    "9" * 400,
    "9" * 5000,
    "0x10",
    "1_0",
    "1e3",
    "1.",
    "5%",
]

HYDRA_KEYS = [
    "hydra.run.dir",
    "hydra.sweep.dir",
    "hydra.mode",
    "hydra.output_subdir",
    "hydra.verbose",
]
HYDRA_KEYS += [
    "hydra.job.chdir",
    "hydra.job.name",
    "hydra.job_logging",
    "hydra/job_logging",
    "hydra",
]
HYDRA_KEYS += [
    "hydra/launcher",
    "hydra.launcher",
    "hydra.callbacks",
    "hydra.searchpath",
    "hydra.run",
]
HYDRA_VALUES = [
    "null",
    "''",
    ".",
    "..",
    "/",
    "/proc/x",
    "/dev/null",
    "/dev/null/x",
    "5",
    "true",
    "[]",
]
HYDRA_VALUES += [
    "{}",
    "[a]",
    "word",
    "ω",
    "x" * 300,
    "${tau}",
    "${nosuch}",
    "${oc.env:NOPE}",
    "???",
    "nan",
]

FLAGS = ["--nosuch", "-x", "--config-name=task", "--config-name=nosuch", "--config-name=setup/feed"]
FLAGS += [
    "--config-path=/nosuch",
    "--config-path=conf",
    "--config-dir=/nosuch",
    "--cfg",
    "--cfg=word",
]
FLAGS += ["--resolve", "--info=word", "--package=x", "--run --cfg=job", "--experimental-rerun=x"]
FLAGS += [
    "--experimental-rerun",
    "-sc",
    "--cfg=job",
    "--cfg=hydra",
    "--cfg=all",
    "--help",
    "--version",
]
FLAGS += ["--cfg=job --resolve tau=${nosuch}", "-- tau=1", "--tau=1", "-r tau=0", "--hydra-help=x"]
FLAGS += [
    "--multirun=1",
    "-tau",
    "tau",
    "=",
    "=1",
    ".=1",
    "a.=1",
    "~",
    "+",
    "++",
    "@",
    "a@b=c",
    "\ud800",
]

ODD = {
    "train": [
        "setup.repeats=false setup.candidates=5 setup=query",
        "setup.batch=5 setup=query",
        "setup.batch=7 setup=query",
        "setup.batch=2 setup=feed",
        "setup.repeats=false pool.size=5 setup=query",
        "setup.candidates=5 setup=feed",
        "setup.offers=30 setup=query",
        "setup.offers=19",
        "experiment=attention setup=feed",
        "experiment=paper policy=attention setup.candidates=3",
        "experiment=[paper,attention]",
        "objective=entropy belief.samples=3",
        "policy.start=alignment setup=feed",
        "policy.tokens=samples policy=scorer",
        "algorithm.epochs=4 algorithm=a2c",
        "algorithm=ppo algorithm.clip_epsilon=1.5",
        "logger=[csv,wandb,csv]",
        "resume=. tau=1",
        "resume=. checkpoint=.",
        "pool.test=.",
        "pool.train=. pool.test=.",
        "training.sessions=1000000 belief.samples=1000000",
        "setup.budget=100000 setup.offers=100000",
        "pool.size=100000000 task.length=1000",
        "belief.moves=100000000",
        "objective=entropy belief.samples=200000",
        "setup=query policy=attention setup.candidates=null pool.size=1000000",
        "tau=1 tau=2",
        "protocol=heldout",
    ],
    "evaluate": [
        "protocol=heldout setup=query",
        "protocol=heldout policy=pretrained",
        "policy=pretrained tau=3",
        "policy=pretrained checkpoint=.",
        "checkpoint=. tau=1",
        "checkpoint=[.,.]",
        "tau=[noisy,noisy]",
        "tau=[noisy,loud]",
        "tau=[noisy,[optimal]]",
        "objective=entropy",
        "setup.repeats=false setup=query pool.size=5",
        "setup.batch=7 setup=query",
        "setup.batch=10 setup=query policy=pretrained",
        "setup.batch=10 protocol=heldout",
        "setup.candidates=5 setup=feed",
        "training.updates=5",
        "resume=.",
        "evaluation.humans=1000000000 pool.size=2",
        "workers=1000000",
    ],
}


class Result(NamedTuple):
    """What became of a command line."""

    script: str
    arguments: tuple[str, ...]
    outcome: str
    errors: str


def keys_of(script: str) -> dict[str, tuple[Any, list[str]]]:
    """Every key with its default, and what chooses the groups that have it."""
    found: dict[str, tuple[Any, list[str]]] = {}
    choices = [["policy=pretrained"]]
    if script == "train":
        choices = [[f"policy={policy}"] for policy in ("scorer", "attention", "paper")]
        choices = [[*chosen, f"algorithm={name}"] for chosen in choices for name in ("a2c", "ppo")]
    for setup in ("feed", "query"):
        for chosen in choices:
            groups = [f"setup={setup}", *chosen]
            with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
                config = compose(script, groups)
            for key, value in _leaves(OmegaConf.to_container(config), ""):
                found.setdefault(key, (value, [g for g in groups if g.split("=")[0] in key]))
    return found


def _leaves(node: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in node.items():
        if isinstance(value, dict):
            yield prefix + key, value
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def commands_of(script: str) -> list[tuple[str, ...]]:
    """Distinct wrong command lines of a script."""
    made: list[Sequence[str]] = []
    groups = ("setup", "policy", "algorithm", "experiment")
    keys = keys_of(script)
    for key, (default, chosen) in keys.items():
        numeric = isinstance(default, (int, float)) or default is None or key == "tau"
        values = [*ANY, *(NUMBERS if numeric and not isinstance(default, bool) else NUMBERS[:4])]
        before = [] if key in groups else chosen
        made += [(*before, f"{key}={value}") for value in values]
        bent = (f"~{key}", f"+{key}=1", f"++{key}=word", key, f"{key}.x=1", f"++{key}.x=1")
        made += [(*before, *typed.split()) for typed in bent]
        made += [(*before, f"{key}=word", f"{key}=-7"), (f"{key}@x=1",), (f"+{key}x=1",)]
    for group in groups:
        values = [*ANY, *NUMBERS[:4], "[feed,query]", "[scorer,paper]", "../task", "feed.yaml"]
        made += [
            (f"{mark}{group}{at}={value}").split("\0")
            for value in values
            for mark, at in (("", ""), ("+", ""), ("+", "@x"), ("", "@tau"), ("+", "@policy"))
        ]
        made += [(f"~{group}",), (f"~{group}=word",), (group,)]
    for key in HYDRA_KEYS:
        made += [(f"{mark}{key}={value}",) for value in HYDRA_VALUES for mark in ("", "+")]
        made += [(f"~{key}",), (f"{key}.x=1",)]
    made += [tuple(flags.split()) for flags in (*FLAGS, *ODD[script])]
    return sorted({tuple(one) for one in made})


def every_command() -> list[tuple[str, tuple[str, ...]]]:
    """All command lines of both scripts."""
    return [(script, one) for script in ("train", "evaluate") for one in commands_of(script)]


def run_forked(script: str, arguments: Sequence[str]) -> Result:
    """Run a command line in a fork of this process, up to where its work would start."""
    _import_heavy()
    folder = Path(tempfile.mkdtemp(prefix="bad-settings-"))
    work = folder / "work"
    work.mkdir()
    child = os.fork()
    if child == 0:
        _be_command(script, arguments, work)
    status = _wait(child)
    out, errors = ((folder / name).read_text(errors="replace") for name in ("out", "err"))
    outcome = _judge(status, out, errors, list(work.rglob("*")))
    shutil.rmtree(folder)
    return Result(script, tuple(arguments), outcome, errors)


@functools.cache
def _import_heavy() -> None:
    """Once, and not in each fork."""
    import torch

    import torchrl_pref.evaluation.reports  # noqa: F401

    torch.set_num_threads(1)


def _be_command(script: str, arguments: Sequence[str], work: Path) -> None:
    """Become the command; never returns."""
    status = 1
    try:
        os.setsid()
        for number, name in ((1, "out"), (2, "err")):
            os.dup2(os.open(work.parent / name, os.O_WRONLY | os.O_CREAT), number)
        sys.stdout, sys.stderr = (os.fdopen(n, "w", errors="backslashreplace") for n in (1, 2))
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        warnings.resetwarnings()
        os.chdir(work)
        held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (held + LIMIT_BYTES,) * 2)
        _stop_at_work()
        sys.argv = [str(ROOT / f"{script}.py"), *arguments]
        runpy.run_path(sys.argv[0], run_name="__main__")
        status = 0
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _stop_at_work() -> None:
    """What is legal ends where it would start to train or to evaluate, on a machine of 4 GB."""
    from torchrl_pref.config import memory
    from torchrl_pref.evaluation import comparison, heldout
    from torchrl_pref.training.trainer import Trainer

    def stop(*_: Any, **__: Any) -> None:
        os._exit(STARTED)

    Trainer.run = stop  # type: ignore[assignment, method-assign]
    comparison.evaluate_task = stop  # type: ignore[assignment]
    heldout.run_protocol = stop  # type: ignore[assignment]
    memory.machine_memory = lambda: LIMIT_BYTES


def _wait(child: int) -> int:
    """The child's status as a shell would tell it, negative where a signal ended it."""
    deadline = time.monotonic() + LIMIT_S
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > deadline:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return -signal.SIGALRM
        time.sleep(0.01)


def _judge(status: int, output: str, errors: str, left: Sequence[Path]) -> str:
    """One of ``FAULTS``, or ``refused``, ``started`` or ``answered``."""
    if status == -signal.SIGALRM:
        return "hang"
    if "Traceback" in errors:
        return "traceback"
    if status in (0, STARTED):
        return "answered" if status == 0 else "started"
    if status != 2:
        return "crash"
    if not errors.startswith("error: ") or errors.count("\n") != 1:
        return "more than one line"
    return "left files" if left else "refused"


def agrees(result: Result) -> bool:
    """Whether a process of its own says the same as the fork did."""
    command = [sys.executable, str(ROOT / f"{result.script}.py"), *result.arguments]
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)
        same = (done.returncode, done.stderr) == (2, result.errors)
        return same and not os.listdir(folder)


def main() -> None:
    """Run them, count what became of them, and run some again."""
    parser = common.arguments(__doc__)
    parser.add_argument("--sample", type=int, help="how many, at random; by default all")
    parser.add_argument("--seed", type=int, default=0, help="of the sample (default 0)")
    parser.add_argument("--apart", type=int, default=20, help="run again as processes (default 20)")
    parser.add_argument("--show", default="", help="print every command with this outcome")
    typed = common.start(parser)
    commands, luck = every_command(), random.Random(typed.seed)
    made = len(commands)
    if typed.sample is not None:
        commands = luck.sample(commands, typed.sample)
    results = []
    with contextlib.suppress(KeyboardInterrupt):  # then what has run is counted
        for script, arguments in commands:
            results.append(result := run_forked(script, arguments))
            if result.outcome in (*FAULTS, typed.show):
                line = shlex.join([f"{script}.py", *arguments])
                print(f"{result.outcome}: {line[:300]}\n    {result.errors[-600:]!r}", flush=True)
    counts = collections.Counter(result.outcome for result in results)
    row = {"tried": len(results), **{name: counts[which] for name, which in COLUMNS.items()}}
    common.report(f"{len(results)} of {made} wrong commands", [row], typed.json)
    refused = [result for result in results if result.outcome == "refused"]
    again = luck.sample(refused, min(typed.apart, len(refused)))
    differing = [result for result in again if not agrees(result)]
    print(f"{len(again) - len(differing)} of {len(again)} say the same as a process of its own")
    for result in differing:
        print(f"differs: {shlex.join(result.arguments)}")
    raise SystemExit(bool(differing or any(counts[fault] for fault in FAULTS)))


if __name__ == "__main__":
    main()
