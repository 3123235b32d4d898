"""The machine code of compiled functions is kept where it can be; loops in threads."""

import hashlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from numba import config

from torchrl_pref.acquisition.functions import information_gain
from torchrl_pref.acquisition.scoring import score_queries
from torchrl_pref.beliefs import elementary_cpu, slice_cpu
from torchrl_pref.beliefs.elementary_cpu import cos_sin_single, exp_minus, log, log_single
from torchrl_pref.beliefs.lengths_cpu import SLICE_DIGEST
from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.beliefs.slice_cpu import ELEMENTARY_DIGEST
from torchrl_pref.compiled import FEWEST, over_sessions, share_out
from torchrl_pref.questions.choice import evidence_of_gaps
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann, Optimal

FAR_FROM_HERE = """
from torchrl_pref.compiled import compiled

@compiled
def double(x: float) -> float:
    return 2.0 * x

print(double(21.0))
"""


@pytest.fixture
def threads_back() -> Iterator[None]:
    """As many threads after the test as before."""
    yield
    share_out(config.NUMBA_NUM_THREADS)


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("n_sessions", [0, 1, 2 * FEWEST, 7 * FEWEST + 3])
def test_every_session_is_visited_once(threads: int, n_sessions: int, threads_back: None) -> None:
    share_out(threads)
    visits = np.zeros(n_sessions)

    def loop(first: int, last: int, visits: np.ndarray, by: float) -> None:
        visits[first:last] += by

    over_sessions(loop, n_sessions, visits, 2.0)
    assert (visits == 2).all()


def test_what_fails_in_a_thread_is_told(threads_back: None) -> None:
    share_out(2)

    def loop(first: int, last: int) -> None:
        if first > 0:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        over_sessions(loop, 2 * FEWEST)


def test_when_the_first_part_fails_the_others_are_waited_for(threads_back: None) -> None:
    share_out(2)
    done: list[int] = []

    def loop(first: int, last: int) -> None:
        if first == 0:
            raise ZeroDivisionError
        time.sleep(0.05)
        done.append(first)

    with pytest.raises(ZeroDivisionError):
        over_sessions(loop, 2 * FEWEST)
    assert done == [FEWEST]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no forks here")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_a_fork_has_threads_of_its_own(threads_back: None) -> None:
    share_out(2)
    over_sessions(lambda first, last: None, 2 * FEWEST)
    child = os.fork()
    if child == 0:
        status = 1
        try:
            signal.alarm(20)  # without threads of its own it would wait for ever
            over_sessions(lambda first, last: None, 2 * FEWEST)
            status = 7
        finally:
            os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7


@pytest.mark.parametrize("model", [Boltzmann(4.5), Optimal()], ids=str)
def test_no_number_depends_on_the_threads(model: ResponseModel, threads_back: None) -> None:
    def followed(threads: int) -> list[torch.Tensor]:
        share_out(threads)
        generator, belief = torch.Generator().manual_seed(0), Belief(model)
        samples = belief.prior(5 * FEWEST, 3, generator)
        gaps = torch.randn(5 * FEWEST, 1, 1, 3, generator=generator)
        queries = torch.randn(5 * FEWEST, 4, 2, 3, generator=generator)
        update = belief.update(
            samples, torch.full((len(gaps),), 100.0), evidence_of_gaps(gaps), generator
        )
        return [*update, score_queries(update.samples, queries, model, information_gain)]

    for one, three in zip(followed(1), followed(3), strict=True):
        assert torch.equal(one, three)


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


def test_logarithms_and_angles_are_those_of_the_library() -> None:
    luck = np.random.default_rng(0)
    numbers = np.exp(luck.uniform(-700, 700, 10_001))
    near_one = 1 + luck.uniform(-1e-3, 1e-3, 10_001)
    for some in (numbers, near_one, np.array([1.0, 0.5, 2.0])):
        assert np.allclose([log(x) for x in some], np.log(some), rtol=1e-15, atol=1e-18)
    with np.errstate(divide="ignore"):
        odd = np.array([0.0, np.inf, np.nan])
        assert np.array_equal([log(x) for x in odd], np.log(odd), equal_nan=True)
    single = [log_single(x) for x in (0.0, 1e-40, 0.25, 3.0)]
    assert np.allclose(single, np.log([1e-30, 1e-30, 0.25, 3.0]), rtol=1e-7)
    angles = np.concatenate([luck.uniform(-2 * np.pi, 2 * np.pi, 10_001), np.pi * np.arange(-2, 3)])
    cosine, sine = np.array([cos_sin_single(x) for x in angles]).T
    rounded = angles.astype(np.float32).astype(np.float64)
    assert np.allclose(cosine, np.cos(rounded), rtol=6e-8, atol=1e-12)
    assert np.allclose(sine, np.sin(rounded), rtol=6e-8, atol=1e-12)
    for x in (0.0, 0.3, 5.0, 60.0):
        assert exp_minus(x) == pytest.approx(np.exp(-x), rel=1e-4, abs=2e-7)


@pytest.mark.parametrize(
    ("called", "digest"),
    [(elementary_cpu, ELEMENTARY_DIGEST), (slice_cpu, SLICE_DIGEST)],
    ids=["elementary_cpu", "slice_cpu"],
)
def test_moves_are_compiled_anew_when_the_file_that_they_call_changes(
    called: ModuleType, digest: str
) -> None:
    """The digest in the file that calls it is that of the file: put it there after a change."""
    source = Path(str(called.__file__)).read_bytes()
    assert hashlib.sha256(source).hexdigest().startswith(digest)
    assert len(digest) == 12
