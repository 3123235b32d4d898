"""Sessions in parts, each in a process of its own or all in turn."""

from __future__ import annotations

import copy
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from itertools import count
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import same, settings_of, trainer_of

from torchrl_pref import compiled
from torchrl_pref.config.memory import FEWEST, sizes_of_parts
from torchrl_pref.errors import InputError
from torchrl_pref.training import parts
from torchrl_pref.training.parts import Part, SessionParts, seeds_of_part
from torchrl_pref.training.worker import Worker

GENERATORS = ("env_generator", "global_generator")

ROOT = Path(__file__).parents[2]

PARTS: dict[str, Any] = {"sessions": 2 * FEWEST, "processes": 2}


@pytest.fixture(autouse=True)
def _threads() -> Iterator[None]:
    before = compiled.n_threads()
    yield
    compiled.share_out(before)


@pytest.mark.parametrize(
    ("sessions", "processes", "sizes"),
    [
        (512, 2, [256, 256]),
        (2 * FEWEST - 1, 2, [2 * FEWEST - 1]),
        (200, 3, [67, 67, 66]),
        (4, 8, [4]),
    ],
)
def test_parts_are_alike_and_worth_a_process(
    sessions: int, processes: int, sizes: list[int]
) -> None:
    assert sizes_of_parts(sessions, processes) == sizes


def trained(threads: int, updates: int, folder: Path, state: Any = None) -> dict[str, Any]:
    """The state of a training after so many updates; it has that many threads."""
    compiled.share_out(threads)
    trainer, _ = trainer_of(settings_of(**PARTS, updates=updates))
    if state is not None:
        trainer.load_state_dict(state)
    saved: list[dict[str, Any]] = []
    trainer.run(folder, lambda: saved.append(copy.deepcopy(trainer.state_dict())))
    assert same(saved[-1], trainer.state_dict())
    assert compiled.n_threads() == threads
    return saved[-1]


def test_processes_of_their_own_or_none_change_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All parts in turn all along, or begun with a process for each."""
    started = []

    def start(*arguments: Any) -> Worker:
        started.append(Worker(*arguments))
        return started[-1]

    monkeypatch.setattr(parts, "Worker", start)
    in_turn = trained(1, 4, tmp_path)
    assert not started
    begun = trained(2, 3, tmp_path)
    assert len(started) == 1
    assert not started[0].process.is_alive()
    apart = trained(1, 4, tmp_path, begun)
    for name in ("update", "weights", "optimizer", "sessions", *GENERATORS):
        assert same(in_turn[name], apart[name]), name


def test_each_part_has_its_own_humans_and_luck() -> None:
    trainer, _ = trainer_of(settings_of(**PARTS))
    sessions = trainer.sessions
    assert isinstance(sessions, SessionParts)
    (part,) = sessions.others
    omegas = [of.hidden["human"]["omega"] for of in (sessions.first, part.sessions)]
    assert not (omegas[0].unsqueeze(1) == omegas[1]).all(-1).any()
    before = torch.get_rng_state()
    luck = part.luck
    part.collect(1)
    assert torch.equal(before, torch.get_rng_state())
    assert not torch.equal(luck, part.luck)
    # What a generator does not know of a seed must not be all that tells parts apart.
    seeds = {s % 2**32 for run in range(5) for part in range(5) for s in seeds_of_part(run, part)}
    assert len(seeds) == 5 + 2 * 5 * 4


@pytest.mark.parametrize("spoiled", ["all", "part", "actions"])
def test_a_state_that_lacks_a_part_is_refused(spoiled: str) -> None:
    trainer, _ = trainer_of(settings_of(**PARTS))
    state = trainer.sessions.state_dict()
    if spoiled == "all":
        del state["others"]
    elif spoiled == "part":
        del state["others"][0]
    else:
        state["others"][0]["actions"] = torch.zeros(3)
    with pytest.raises(InputError, match="state"):
        trainer.sessions.load_state_dict(state)


def test_a_part_goes_on_from_what_it_was_a_moment_ago() -> None:
    """Also where it was asked since: what the policy wrote is not in the state."""
    trainer, _ = trainer_of(settings_of(**PARTS))
    sessions = trainer.sessions
    assert isinstance(sessions, SessionParts)
    (part,) = sessions.others
    part.collect(0)
    state = copy.deepcopy(part.state_dict())
    once = part.collect(1)
    part.load_state_dict(state)
    assert same(once.to_dict(), part.collect(1).to_dict())


def test_what_is_sent_to_a_process_is_little_and_takes_no_shared_memory() -> None:
    trainer, task = trainer_of(settings_of(**PARTS))
    assert task.train.trajectories is not None
    assert isinstance(trainer.sessions, SessionParts)
    (make,) = trainer.sessions.makes
    assert isinstance(make, partial)
    _, sent, *_ = make.args
    assert sent.train.trajectories is None
    ForkingPickler.dumps(sent.train)
    assert not sent.train.features.is_shared()
    there = ForkingPickler.loads(ForkingPickler.dumps(task.train))
    assert torch.equal(there.features, task.train.features)
    assert torch.equal(there.trajectories, task.train.trajectories)
    assert there.feature_names == task.train.feature_names


ALONE = """
import os, signal
from torchrl_pref.training.worker import Worker
worker = Worker(list, 1, {})
for number in (signal.SIGINT, signal.SIGTERM):
    os.kill(worker.process.pid, number)
worker.tell({})
try:
    worker.answer()
except RuntimeError as error:
    print("answered:", error)
"""


def test_signals_are_not_for_a_worker_and_one_left_open_ends() -> None:
    """In a process that has started no other: the first start lets signals through."""
    command = [sys.executable, "-c", ALONE]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=ROOT)
    assert "answered: in a process" in done.stdout, done.stderr
    assert done.returncode == 0


TRIES = count()


def never_made() -> Part:
    """Refuses at first, and fails at the second try."""
    if next(TRIES):
        raise ZeroDivisionError("no such part")
    raise InputError("human=lost: nobody of that name")


def test_what_goes_wrong_in_another_process_is_told() -> None:
    worker = Worker(never_made, 1, {})
    worker.tell({})
    with pytest.raises(InputError, match="nobody of that name"):
        worker.answer()
    with pytest.raises(RuntimeError, match="ZeroDivisionError: no such part"):
        worker.answer()
    worker.process.kill()
    with pytest.raises(InputError, match=r"status -9.*resume=.*NUMBA_NUM_THREADS"):
        worker.answer()
    worker.close()
