"""Whatever is killed, or started twice: nothing is lost and nothing is mixed."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from helpers import settings_of
from hydra import compose, initialize_config_dir
from scripts import run_script
from test_cli import PARTED, ROOT, SHORT, run, start

import app
import train
from torchrl_pref import sweeps
from torchrl_pref.checkpoints.checkpoint import Checkpoint
from torchrl_pref.errors import InputError
from torchrl_pref.runs import claimed
from torchrl_pref.storage.writing import PARTIAL, replacing, write_text


@contextlib.contextmanager
def another_process(work: Callable[[Callable[[], None]], None]) -> Iterator[int]:
    """A process that has come, within ``work``, to the call that it is given; it stays there."""
    reader, writer = os.pipe()

    def stay() -> None:
        os.write(writer, b"!")
        signal.pause()

    child = os.fork()
    if child == 0:
        try:
            work(stay)
        finally:
            os._exit(1)
    try:
        assert os.read(reader, 1) == b"!"
        yield child
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(child, 0)


def test_a_claim_is_one_process_s_and_dies_with_it(tmp_path: Path) -> None:
    def hold(stay: Callable[[], None]) -> None:
        with claimed(tmp_path):
            stay()

    with another_process(hold) as child:
        with pytest.raises(InputError, match="another process is at work there"), claimed(tmp_path):
            pass
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        with claimed(tmp_path):
            pass
    assert not list(tmp_path.iterdir())


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "table.txt"
    write_text(path, "old")

    def half(stay: Callable[[], None]) -> None:
        with replacing(path) as partial:
            partial.write_text("ne")
            stay()

    with another_process(half):
        write_text(path, "newer")  # the other's half-written file is its own
    assert path.read_text() == "newer"
    assert len(list(tmp_path.glob(f".*{PARTIAL}*"))) == 1
    with contextlib.suppress(ZeroDivisionError), replacing(path) as partial:
        partial.write_text("ne")
        raise ZeroDivisionError
    with claimed(tmp_path):  # takes away what the killed process left
        assert path.read_text() == "newer"
    assert os.listdir(tmp_path) == ["table.txt"]


NAMES = [
    "plain",
    "it's",
    "a=b",
    "a,b c",
    "$HOME",
    "${tau}",
    "ünï",
    "-x",
    '"q"',
    "\\",
    "x\\'",
    "$\\${",
]
NAMES += ["[x]", "{y}", "(z)", "a:b", "#", "~t", "a;b", "`x`", "!x", "*", "50%", "two  blanks", "7"]


def test_the_line_to_go_on_with_can_be_pasted(monkeypatch: pytest.MonkeyPatch) -> None:
    """As bash and Hydra understand it."""
    monkeypatch.setattr(sys, "argv", ["train.py"])
    folders = [Path("/runs") / name for name in NAMES]
    lines = [app.command(app.as_typed("resume", folder)) for folder in folders]
    program = "import sys; print(repr(sys.argv[1:]))"
    shell = "\n".join(line.replace(" train.py ", f' -c "{program}" ') for line in lines)
    printed = subprocess.check_output(["bash", "-c", shell], text=True)
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        for folder, line in zip(folders, printed.splitlines(), strict=True):
            assert compose("train", eval(line)).resume == str(folder)


def test_kills_and_double_starts(tmp_path: Path) -> None:
    """A few of ``benchmarks/kills.py``, which says so where anything is lost or mixed."""
    script = [sys.executable, str(ROOT / "benchmarks" / "kills.py")]
    done = subprocess.run(
        [*script, "--kills=1", "--starts=1", "--seed=1"],
        env={**os.environ, "OMP_NUM_THREADS": "1", "TMPDIR": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert len(re.findall(r" 0$", done.stdout, re.M)) == 2  # the last column: lost or mixed
    assert not list(tmp_path.iterdir())


def test_evaluate_does_not_overwrite_a_run(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("somebody's")
    done = run_script("evaluate.py", f"hydra.run.dir={tmp_path}")
    assert done.returncode == 2
    assert "holds a run" in done.stderr
    assert os.listdir(tmp_path) == ["config.yaml"]


def test_a_reader_that_goes_away_costs_nothing(tmp_path: Path) -> None:
    words = " ".join([*SHORT, f"hydra.run.dir={tmp_path}"])
    line = f"set -o pipefail; {sys.executable} train.py {words} 2>&1 | head -1"
    done = subprocess.run(["bash", "-c", line], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0
    assert len(done.stdout.splitlines()) == 1
    assert (tmp_path / "summary.json").exists()
    assert (tmp_path / "tables.txt").exists()


def test_a_sweep_names_what_failed_and_then_runs_what_is_missing(tmp_path: Path) -> None:
    sweep = tmp_path / "a sweep"
    typed = ["train.py", "-m", "setup=query", f"hydra.sweep.dir={json.dumps(str(sweep))}", *SHORT]
    failed = run_script(*typed, "tau=optimal,-1,0.5")
    assert failed.returncode == 2
    assert re.search(r"^ +1 .* tau=-1: expected a finite number above 0", failed.stdout, re.M)
    lines = [line for line in failed.stderr.splitlines() if line.startswith("error: ")]
    assert lines[0].startswith("error: job 1: tau=-1")
    assert "a sweep" in lines[1]
    # Job 0 has finished; job 2 is as if it had been killed before the end of its report.
    (sweep / "2" / "summary.json").unlink()
    before = (sweep / "0" / "tables.txt").stat().st_mtime_ns
    weights = Checkpoint.load(sweep / "2").weights
    line = (
        lines[1]
        .partition("run what is missing with: ")[2]
        .replace("tau=optimal,-1", "tau=optimal,1")
    )
    done = subprocess.run(["bash", "-c", line], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (sweep / "0" / "tables.txt").stat().st_mtime_ns == before
    rows = sweeps.write_table(sweep)
    assert [(row["job"], row["tau"]) for row in rows] == [
        ("0", "optimal"),
        ("1", "1"),
        ("2", "0.5"),
    ]
    assert "failed" not in rows[0]
    assert all(
        weights[key].equal(value) for key, value in Checkpoint.load(sweep / "2").weights.items()
    )


def test_a_job_that_fails_is_a_row_of_the_table(tmp_path: Path) -> None:
    def fail() -> float:
        raise RuntimeError("no\n luck")

    folders = [tmp_path / str(number) for number in (2, 10)]
    for folder in folders:
        folder.mkdir()
    (folders[0] / "summary.json").write_text('{"overrides": ["a=1", "~b"], "asked": 3}')
    assert math.isnan(sweeps.attempt(tmp_path, folders[1], ["a=2"], fail))
    assert (tmp_path / "summary.csv").read_text().splitlines() == [
        "job,a,~b,asked,failed",
        "2,1,,3,",
        "10,2,,,RuntimeError: no luck",
    ]
    assert sweeps.attempt(tmp_path, folders[0], ["a=1"], lambda: 0.5) == 0.5


def test_sweeps_of_other_settings_do_not_mix(tmp_path: Path) -> None:
    folder = tmp_path / "0"
    run("train.py", "setup=query", *SHORT, f"hydra.run.dir={folder}")
    before = (folder / "summary.json").read_text()
    done = run_script(
        "train.py", "-m", "setup=query", "tau=2,3", "seed=1", *SHORT, f"hydra.sweep.dir={tmp_path}"
    )
    assert done.returncode == 2
    assert "seed=0 there and 1 here, tau=noisy there and 2 here" in done.stderr
    assert (folder / "summary.json").read_text() == before
    assert (tmp_path / "1" / "summary.json").exists()


@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_jobs_run_under_a_launcher(launcher: str, tmp_path: Path) -> None:
    """Each job's training in two processes, too."""
    chosen = [f"hydra/launcher={launcher}", f"hydra.sweep.dir={tmp_path}", *PARTED]
    typed = "-m", "setup=query", "tau=-1,2", *SHORT, *chosen
    process = start("train.py", *typed, NUMBA_NUM_THREADS="2")
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 2
    assert "job 0: failed" in errors.splitlines()[-1]
    assert "tau=-1: expected" in output
    assert (tmp_path / "1" / "summary.json").exists()
    before = (tmp_path / "1" / "tables.txt").stat().st_mtime_ns
    # What is missing, by whatever launcher.
    done = run_script("train.py", "-m", "setup=query", "tau=1,2", *SHORT, *chosen[1:])
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "1" / "tables.txt").stat().st_mtime_ns == before
    assert [row.get("failed") for row in sweeps.write_table(tmp_path)] == [None, None]


def test_a_run_that_is_stopped_before_it_has_a_folder_cannot_be_gone_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(train, "write_text", stop)
    with pytest.raises(KeyboardInterrupt):
        train.start(tmp_path, {**settings_of("query"), "checkpoint": None})
    assert "go on with" not in capsys.readouterr().out
    assert not list(tmp_path.iterdir())
