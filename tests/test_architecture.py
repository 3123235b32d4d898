"""Imports point downward only, and Hydra stays out of the package (docs/design.md)."""

import ast
import re
from pathlib import Path

import torchrl_pref

PACKAGE = Path(torchrl_pref.__file__).parent

ORDER = [
    "errors",
    "tensors",
    "compiled",
    "processes",
    "storage",
    "config",
    "typed_code",
    "questions",
    "acquisition",
    "beliefs",
    "pool",
    "tasks",
    "humans",
    "envs",
    "strategies",
    "policies",
    "runs",
    "groups",
    "checkpoints",
    "problem",
    "build",
    "trial",
    "evaluation",
    "training",
    "pretrained",
    "learned",
    "saved_session",
    "asking",
    "session",
    "reward",
    "study",
    "sweeps",
]
"""Folders and modules of the package, from the ground up: each may use those before it."""


def sources() -> list[Path]:
    """Every module of the package."""
    return sorted(PACKAGE.rglob("*.py"))


def imports_of(path: Path) -> set[str]:
    """Full names of the modules that a file imports."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name}: relative import"
            names.add(node.module or "")
    return names


def test_every_module_has_its_place() -> None:
    modules = {path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in sources()}
    assert modules - {"__init__"} == set(ORDER)


def test_imports_point_downward() -> None:
    for path in sources():
        own = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        for imported in imports_of(path) if own != "__init__" else ():
            if imported.startswith("torchrl_pref."):
                other = imported.split(".")[1]
                assert ORDER.index(other) <= ORDER.index(own), f"{path} imports {imported}"
            assert imported != "torchrl_pref", f"{path} imports the package itself"


def test_no_environment_is_asked_of_what_class_it_is() -> None:
    """It may be a transformed one; ``is_feed`` asks its specs."""
    for path in sources():
        assert not re.search(r"isinstance\((self\.)?env, *(Query|Feed)", path.read_text()), path


def test_hydra_stays_in_the_scripts() -> None:
    for path in sources():
        tops = {name.split(".")[0] for name in imports_of(path)}
        assert not tops & {"hydra", "omegaconf"}, path.name


def test_nothing_loads_a_pickle() -> None:
    for path in sources():
        tree = ast.parse(path.read_text())
        assert not imports_of(path) & {"pickle", "dill", "cloudpickle", "joblib", "shelve"}
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            if ast.unparse(call.func) in ("torch.load", "np.load", "numpy.load"):
                safe = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords}
                assert safe.get("weights_only") == "True"
