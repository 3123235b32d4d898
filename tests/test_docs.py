"""What the README and the pages in docs/ say is there: files, settings, commands, code."""

from __future__ import annotations

import functools
import importlib
import re
import shlex
from importlib.util import find_spec
from itertools import chain, product
from pathlib import Path

import pytest
import torch
from config.test_settings import composed
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from test_cli import keys_of

import typed
from benchmarks import docs_figures, docs_records, docs_tables
from benchmarks.docs_parts import PARTS
from benchmarks.planted import FAULTS, Fault
from torchrl_pref.config.settings import check_evaluate_settings, check_train_settings
from torchrl_pref.config.study import check_ask_settings
from torchrl_pref.evaluation.records import Entry, Records
from torchrl_pref.humans import HUMANS
from torchrl_pref.tasks import TASKS

ROOT = Path(__file__).parents[1]
CARD = ROOT / "torchrl_pref" / "policies" / "weights" / "README.md"
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", CARD, *sorted((ROOT / "docs").glob("*.md"))]

FENCE = re.compile(r"^(<!-- runs -->\n)?```(\w*)\n(.*?)^```$", re.M | re.S)
INLINE = re.compile(r"`([^`\n]+)`")
FOLDERS = r"(?:benchmarks|conf|docs|examples|tests|torchrl_pref)"
KEY = r"[a-z_]+(?:\.[a-z_]+)*"


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


pages = pytest.mark.parametrize("page", PAGES, ids=name_of)


def prose(page: Path) -> str:
    """A page without its blocks of code, each paragraph on one line."""
    return re.sub(r"(?<!\n)\n(?!\n)", " ", FENCE.sub("", page.read_text()))


def paths_in(page: Path) -> set[str]:
    """The files and folders that a page names."""
    text, spans = page.read_text(), INLINE.findall(prose(page))
    links = {link for link in re.findall(r"\]\(([^)#]+)", text) if "://" not in link}
    named = {span for span in spans if re.fullmatch(r"[\w./-]+(\.(py|md)|/)", span)}
    anywhere = re.findall(rf"(?<![\w/.-]){FOLDERS}/[\w./-]*[\w/]", text)
    return links | named - {"__init__.py"} | set(anywhere)


@pages
def test_files_that_are_named_exist(page: Path) -> None:
    around = (page.parent, ROOT, ROOT / "torchrl_pref", ROOT / "examples" / "extending")
    gone = [path for path in paths_in(page) if not any((at / path).exists() for at in around)]
    assert gone == []


@pages
def test_modules_that_are_named_exist(page: Path) -> None:
    for dotted in set(re.findall(r"\btorchrl_pref(?:\.\w+)+", page.read_text())):
        parts = dotted.split(".")
        for count in range(len(parts), 0, -1):
            try:
                found = importlib.import_module(".".join(parts[:count]))
            except ModuleNotFoundError:
                continue
            for part in parts[count:]:
                found = getattr(found, part)
            break


def commands_in(page: Path) -> set[str]:
    """The command lines of our scripts on a page."""
    blocks = (code.splitlines() for _, _, code in FENCE.findall(page.read_text()))
    lines = [*chain(*blocks), *INLINE.findall(prose(page))]
    made = re.findall(r'make (train|ask) ARGS="([^"]+)"', "\n".join(lines))
    found = re.findall(r"^\S*python ((?:train|evaluate|ask)\.py\b.*)", "\n".join(lines), re.M)
    return {*found, *(f"{script}.py {arguments}" for script, arguments in made)}


COMMANDS = [(page, line) for page in PAGES for line in sorted(commands_in(page))]


def jobs_of(arguments: list[str]) -> list[list[str]]:
    """The settings of each job of a sweep; those of Hydra's own are left out."""
    parsed = OverridesParser.create().parse_overrides(arguments)
    choices = [
        [f"{one.input_line.partition('=')[0]}={value}" for value in one.sweep_string_iterator()]
        if one.is_sweep_override()
        else [str(one.input_line)]
        for one in parsed
        if not str(one.key_or_group).startswith("hydra")
    ]
    return [list(job) for job in product(*choices)]


@pytest.mark.parametrize(("page", "line"), COMMANDS, ids=lambda one: str(one)[-60:])
def test_commands_are_accepted(page: Path, line: str) -> None:
    """As far as settings alone can tell; any file stands for a run or a pool that is not there."""
    script, *arguments = shlex.split(re.sub(r"<[^>]*>", "x", line), comments=True)
    files = r"^(checkpoint|resume|export|pool\.(?:train|test|file))=.*"
    arguments = [re.sub(files, rf"\1='{CARD}'", argument) for argument in arguments]
    if "--help" in arguments:
        return
    for job in jobs_of([one for one in typed.told_hydra(arguments) if one != "-m"]):
        name = script.removesuffix(".py")
        CHECKS[name](composed(name, *job))


CHECKS = {
    "train": check_train_settings,
    "evaluate": check_evaluate_settings,
    "ask": check_ask_settings,
}


NO_SETTINGS = ("actor", "csv", "db", "md", "png", "pt", "py", "strategy")
"""``policy.actor`` is Python, and ``training.csv`` a file."""


@functools.cache
def known_keys() -> set[str]:
    """Every key that a script has, whatever is chosen."""
    groups = ("setup=query", "setup=feed", "question=weak", "belief=rationality")
    groups += ("policy=attention", "policy=scorer")
    tasks = [f"task={name}" for name in TASKS]
    humans = [f"human={name}" for name in HUMANS]
    typed_here = [("train", one) for one in (*groups, *tasks, *humans, "algorithm=ppo")]
    typed_here += [(script, one) for script in ("evaluate", "ask") for one in groups[:4]]
    keys = set(chain(*(keys_of(OmegaConf.create(composed(*one))) for one in typed_here)))
    return keys | {key.partition(".")[0] for key in keys} | {"experiment"}


@pages
def test_settings_that_are_named_exist(page: Path) -> None:
    own = {
        argument.partition("=")[0]
        for line in commands_in(page)
        for argument in shlex.split(line, comments=True)
        if any(re.match(r"\w+=\w+:\w", other) for other in line.split())
    }
    known = known_keys() | own
    sections = {key.partition(".")[0] for key in known if "." in key}
    unknown = []
    for span in INLINE.findall(prose(page)):
        set_here = re.fullmatch(rf"(?:({KEY})=(?!True|False|[\"'(])\S+ ?)+", span)
        typed_keys = re.findall(rf"(?:^| )({KEY})=", span) if set_here else []
        first, dot, rest = span.partition(".")
        if re.fullmatch(KEY, span) and first in sections and dot and rest not in NO_SETTINGS:
            typed_keys = [span]
        unknown += [k for k in typed_keys if k not in known and not k.startswith("hydra.")]
    assert unknown == []


CODE = [
    (page, bool(runs), code)
    for page in PAGES
    for runs, language, code in FENCE.findall(page.read_text())
    if language == "python"
]


def test_there_is_code_that_runs() -> None:
    assert sum(runs for _, runs, _ in CODE) >= 3


@pytest.mark.parametrize("page", sorted({page for page, _, _ in CODE}), ids=name_of)
def test_code_compiles_and_runs(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The blocks of a page that are marked to run do so one after the other."""
    monkeypatch.chdir(tmp_path)
    threads, names = torch.get_num_threads(), {"__name__": page.stem}
    for _, runs, code in (one for one in CODE if one[0] == page):
        compiled = compile(code, name_of(page), "exec")
        if runs:
            exec(compiled, names)
    torch.set_num_threads(threads)


ENDS = ("begin", "end")


def test_every_table_between_marks_is_made_by_a_part() -> None:
    for page in PAGES:
        text = page.read_text()
        begun, ended = (re.findall(rf"^<!-- {end}: (\S+) -->$", text, re.M) for end in ENDS)
        assert begun == ended
        parts = [part for part, made in PARTS.items() if ROOT / made.page == page]
        assert {mark.partition("-")[0] for mark in begun} <= set(parts)
        for mark in begun:
            shown = text.partition(f"<!-- begin: {mark} -->\n")[2].partition("<!-- end:")[0]
            assert shown.startswith("*Made at commit "), mark
            assert len(shown.splitlines()) > 2, mark
    with pytest.raises(ValueError, match="no <!-- begin: nothing -->"):
        docs_figures.between("", "nothing", "")
    page = "a\n<!-- begin: x -->\nold\n<!-- end: x -->\nb"
    assert docs_figures.between(page, "x", "new") == page.replace("old", "new")


@pytest.mark.parametrize("name", PARTS)
def test_parts_of_the_docs_are_made_by_commands_that_are_accepted(name: str) -> None:
    for line in PARTS[name].commands:
        command, _, left = line.partition(" -> ")
        assert left
        script = ROOT / command.split()[1]
        if script.name == "-m":
            assert find_spec(command.split()[2]) is not None
            continue
        assert script.exists()
        if script.parent == ROOT:
            test_commands_are_accepted(ROOT, command.format(folder="x").partition(" ")[2])


@pytest.mark.parametrize("name", docs_tables.GALLERY)
def test_the_gallery_shows_a_task(name: str) -> None:
    """Its section has the command, the picture, and each feature by its name."""
    sections = (ROOT / "docs" / "gallery.md").read_text().split("\n## ")
    section = next(one for one in sections if f"`task={name}`" in one.splitlines()[0])
    assert f"python -m torchrl_pref.tasks {name}" in section
    for kind in ("png", "gif"):
        assert f"(gallery/{name}.{kind})" in section
        assert (ROOT / "docs" / "gallery" / f"{name}.{kind}").stat().st_size < 200_000
    for feature in TASKS[name]().feature_names:
        assert feature in section


def test_the_gallery_shows_a_file() -> None:
    section = (ROOT / "docs" / "gallery.md").read_text().partition("`task=files`")[2]
    assert "![" in section
    assert "(gallery/files.png)" in section
    assert (ROOT / "docs" / "gallery" / "files.png").stat().st_size < 200_000
    example = (ROOT / "examples" / "pendulum_file.py").read_text()
    features = re.search(r"^FEATURES = (.*)$", example, re.M)
    assert features is not None
    for feature in re.findall(r'"(\w+)"', features[1]):
        assert f"| {feature} |" in section
    made = [line.rpartition(" -> ")[2] for line in PARTS["gallery"].commands]
    assert made[-2:] == ["pendulum.csv", "files.png"]


def test_a_cell_of_the_protocol_is_a_table() -> None:
    """Two pools of five humans: the policy is .1 ahead of greedy, which faces three of them."""
    entries = []
    for key, level, humans in (("greedy_information", 0.5, 3), ("policy_query", 0.6, 5)):
        numbers = {n: torch.ones(humans) for n in ("information", "repeated", "offered")}
        values = {"alignment": torch.full((humans, 5), level), **numbers}
        values["seconds_to_choose"] = torch.tensor(0.001)
        entries += [
            Entry("heldout", "query/noisy/corners", pool, 0, key, values) for pool in ("0", "1")
        ]
    greedy, policy = docs_records.heldout_rows(Records(entries))
    assert greedy["RL minus it, after 4"] == "+0.100 [+0.100, +0.100]"
    assert greedy["strategy"].endswith("3 humans a pool")
    assert policy["strategy"] == "**RL**"
    assert policy["reaches 0.500 after"] == "0"
    assert docs_tables.table([greedy, policy]).startswith("| strategy ")


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.what)
def test_a_fault_can_be_planted(fault: Fault) -> None:
    """What ``benchmarks/faults.py`` changes stands there once, and the tests are there."""
    assert (ROOT / "torchrl_pref" / fault.file).read_text().count(fault.old) == 1
    for name in fault.tests.split():
        assert (ROOT / "tests" / name.partition("::")[0]).exists()
