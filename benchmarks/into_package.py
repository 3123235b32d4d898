"""What it takes to put something new into the package: files touched, and whether it works.

``python benchmarks/into_package.py``. Each file of ``examples/extending`` is put into a copy of the
package as if it came with it: into its folder, with a line in the folder's table and, where it has
settings, a file of defaults in ``conf/``. Then the main job runs with it by its name, and so do the
tests of that folder, which hold every line of the table to what is promised for all. *Files
touched* counts those that were there before.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)  # and not this folder, whose select.py would hide Python's own

import os
import subprocess
import tempfile
from typing import NamedTuple

from tqdm import tqdm

from benchmarks import common

SMALL = (
    *("pool.size=40", "setup.budget=3", "evaluation.humans=6", "training.updates=2"),
    *("training.sessions=6", "training.steps=8", "training.warm_up=1", "evaluation.during=0"),
)


class New(NamedTuple):
    """Something to put into the package.

    Attributes:
        what: it is.
        file: in ``examples/extending``, without ``.py``.
        folder: of the package.
        table: in its ``__init__.py``.
        entry: what stands there for its name, ``new``, from what the file defines.
        defaults: of ``conf/<group>/new.yaml``, the group being named in the command; None: none.
        command: that runs with it.
        tests: of its folder.
    """

    what: str
    file: str
    folder: str
    table: str
    entry: str
    defaults: str | None
    command: tuple[str, ...]
    tests: str


BY_NAME = "pool.size=40", "setup.budget=3", "evaluation.humans=6", "tau=noisy", "setup=query"
OF_SEVEN = (
    New(
        *("a task", "my_task", "tasks", "TASKS", "Table", "name: new\nsteps: 30\n"),
        *(("train.py", "task=new", *SMALL), "tests/tasks/test_tasks.py"),
    ),
    New(
        *("a kind of answer", "my_question", "questions", "QUESTIONS", "Worst", "name: new\n"),
        ("train.py", "question=new", "pool.options=3", *SMALL),
        "tests/questions/test_conformance.py",
    ),
    New(
        *("a simulated human", "my_human", "humans", "HUMANS", "Tiring"),
        "name: new\npatience: 20.0\ntau: null\nlapse: 0.0\n",
        *(("train.py", "human=new", *SMALL), "tests/humans/test_humans.py"),
    ),
    New(
        *("a belief", "my_belief", "beliefs", "BELIEFS", "Weighted"),
        "name: new\nsamples: 100\ndraws: 5000\nlapse: 0.0\n",
        *(("train.py", "belief=new", *SMALL), "tests/beliefs/test_beliefs.py"),
    ),
    New(
        *("a policy", "my_policy", "policies", "POLICIES", "PolicyKind(perceptron)"),
        "name: new\nwidth: 32\nsample: false\n",
        *(("train.py", "setup=query", "policy=new", *SMALL), "tests/policies/test_table.py"),
    ),
    New(
        *("a strategy", "my_strategy", "strategies", "STRATEGIES", "most_different", None),
        *(("evaluate.py", "strategy=new", *BY_NAME), "tests/strategies"),
    ),
    New(
        *("an acquisition function", "my_acquisition", "acquisition", "ACQUISITIONS"),
        *("vote_entropy", None, ("evaluate.py", "strategy=new", *BY_NAME), "tests/acquisition"),
    ),
)


def put_in(new: New, root: Path) -> None:
    """Put it into a copy of the package."""
    folder = root / "torchrl_pref" / new.folder
    text = (ROOT / "examples" / "extending" / f"{new.file}.py").read_text()
    if new.folder == "acquisition":  # there a strategy is made of it already
        text = text[: text.index("\n\ndef most_disputed")] + "\n"
        text = text.replace("from torchrl_pref import QueryEnv\n", "")
        text = text.replace("from torchrl_pref.strategies import Greedy\n", "")
    text = text.replace("from torchrl_pref import", "from torchrl_pref.envs.query import")
    (folder / "new.py").write_text(text)
    table = folder / "__init__.py"
    name = new.entry.removeprefix("PolicyKind(").removesuffix(")")
    lines = table.read_text().replace(
        f"\n{new.table}: dict",
        f"\nfrom torchrl_pref.{new.folder}.new import {name}\n\n{new.table}: dict",
    )
    start = lines.index(f"{new.table}: dict")
    end = lines.index("\n}", start)
    table.write_text(f'{lines[:end]}\n    "new": {new.entry},{lines[end:]}')
    if new.defaults is not None:
        group = next(word for word in new.command if word.endswith("=new")).partition("=")[0]
        (root / "conf" / group / "new.yaml").write_text(new.defaults)


def works(command: tuple[str, ...], root: Path) -> bool:
    """Whether a command ends well in the copy; what it says is shown where it does not."""
    environment = {**os.environ, "PYTHONPATH": str(root)}
    line = [sys.executable, *command]
    done = subprocess.run(line, capture_output=True, text=True, env=environment, cwd=root)
    if done.returncode != 0:
        tqdm.write(f"{' '.join(command)}\n{done.stdout[-3000:]}{done.stderr[-2000:]}")
    return done.returncode == 0


def tried(new: New) -> common.Row:
    """Put it in and try it, in a copy of its own."""
    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        names = common.copy_to(root)
        put_in(new, root)
        touched = sum((root / name).read_bytes() != (ROOT / name).read_bytes() for name in names)
        return {
            "new": new.what,
            "files touched": touched,
            "new files": 1 if new.defaults is None else 2,
            "runs by its name": "yes" if works(new.command, root) else "NO",
            "tests of its folder": "pass"
            if works(("-m", "pytest", "-q", "-x", new.tests), root)
            else "FAIL",
        }


def main() -> None:
    """Print the table; the exit status says whether all work."""
    options = common.start(common.arguments(__doc__))
    rows = [tried(new) for new in tqdm(OF_SEVEN, desc="new things")]
    common.report("Something new in the package", rows, options.json)
    sys.exit(any("NO" in row.values() or "FAIL" in row.values() for row in rows))


if __name__ == "__main__":
    main()
