"""The machine code of compiled functions is kept where it can be."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

FAR_FROM_HERE = """
from torchrl_pref.compiled import compiled

@compiled
def double(x: float) -> float:
    return 2.0 * x

print(double(21.0))
"""


@pytest.mark.parametrize("writable", [True, False], ids=["kept", "nowhere"])
def test_a_tree_and_a_home_that_cannot_be_written(writable: bool, tmp_path: Path) -> None:
    """A file where each cache folder would be stands for what may not be written: root may
    write everywhere else."""
    source = tmp_path / "double.py"
    source.write_text(FAR_FROM_HERE)
    if not writable:
        (tmp_path / "__pycache__").write_text("")
    file = tmp_path / "file"
    file.write_text("")
    places = {"NUMBA_CACHE_DIR": f"{file}/x", "XDG_CACHE_HOME": f"{file}/x", "HOME": f"{file}/x"}
    environment = {**os.environ, **places, "PYTHONPATH": str(Path(__file__).parent.parent)}
    done = subprocess.run(
        [sys.executable, source], env=environment, capture_output=True, text=True, timeout=120
    )
    assert (done.stdout, done.returncode) == ("42.0\n", 0), done.stderr
    kept = [path.name for path in tmp_path.rglob("double.double-*")]
    assert bool(kept) == writable
