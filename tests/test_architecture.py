"""Imports point downward only, and Hydra stays out of the package (docs/design.md)."""

import ast
from pathlib import Path

import torchrl_pref

PACKAGE = Path(torchrl_pref.__file__).parent

LAYERS = [
    {"errors", "compiled", "per_belief", "writing"},
    {"checks", "files", "memory", "runs", "sampler_cpu", "scoring_cpu", "tensors"},
    {"responses", "resampling_cpu"},
    {"acquisition", "resampling", "settings"},
    {"sampler", "features"},
    {"belief", "gridworld"},
    {"queries", "humans", "objectives", "sessions"},
    {"contents", "envs", "restore"},
    {"strategies"},
    {"scorer", "attention"},
    {"policies"},
    {"collection", "evaluation"},
    {"progress"},
    {"checkpoint", "training"},
    {"experiment"},
    {"comparison", "pretrained"},
    {"heldout", "learning_curve", "reports"},
    {"heldout_report", "sweeps", "training_report"},
]
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}


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


def test_every_module_has_a_layer() -> None:
    modules = {path.stem for path in PACKAGE.glob("*.py")} - {"__init__"}
    assert modules == set(LEVEL)


def test_imports_point_downward() -> None:
    for name, level in LEVEL.items():
        for imported in imports_of(PACKAGE / f"{name}.py"):
            if imported.startswith("torchrl_pref."):
                other = imported.split(".")[1]
                assert LEVEL[other] < level, f"{name} imports {other}"
            assert imported != "torchrl_pref", f"{name} imports the package itself"


def test_hydra_stays_in_the_scripts() -> None:
    for path in PACKAGE.glob("*.py"):
        tops = {name.split(".")[0] for name in imports_of(path)}
        assert not tops & {"hydra", "omegaconf"}, path.name


def test_nothing_loads_a_pickle() -> None:
    for path in PACKAGE.glob("*.py"):
        tree = ast.parse(path.read_text())
        assert not imports_of(path) & {"pickle", "dill", "cloudpickle", "joblib", "shelve"}
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            if ast.unparse(call.func) in ("torch.load", "np.load", "numpy.load"):
                safe = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords}
                assert safe.get("weights_only") == "True"
