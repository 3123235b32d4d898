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

from tabulate import tabulate
from tqdm import tqdm

from benchmarks.docs_parts import PARTS


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
        failed = []
        for name in names:
            bar.set_description(name)
            try:
                make(name, typed.folder.absolute())
            except subprocess.CalledProcessError:  # it has said why
                failed.append(name)
            bar.update(PARTS[name].minutes)
    print("written; look at the figures, and at git diff docs README.md")
    if failed:
        sys.exit(f"{', '.join(failed)}: not made, as a command failed; above it says why")


if __name__ == "__main__":
    main()
