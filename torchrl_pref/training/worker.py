"""A process that asks the sessions of one part of a training, and what is said to it and by it."""

from __future__ import annotations

import atexit
import io
import signal
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

import torch

from torchrl_pref.compiled import share_out
from torchrl_pref.errors import InputError
from torchrl_pref.processes import spawning, track_resources
from torchrl_pref.typed_code import allow, allowed

if TYPE_CHECKING:
    from torchrl_pref.training.parts import Part

Message = dict[str, Any]
"""Plain data and tensors."""


class Worker:
    """A process that asks the sessions of one part.

    Args:
        make: makes the part there; it and what it is made of must be such as can be pickled.
        threads: that it may use.
        state: of the part, to go on from.
    """

    def __init__(self, make: Callable[[], Part], threads: int, state: Message) -> None:
        # It is read once the process has started, which takes seconds that nobody has to wait for.
        self.untold = [{"state": state}]
        context = get_context("spawn")
        self.connection, theirs = context.Pipe()
        arguments = (theirs, make, threads, torch.get_num_threads(), allowed())
        self.process = context.Process(target=_serve, args=arguments, daemon=True)
        with spawning(), _signals_for_us():
            self.process.start()
        theirs.close()
        # Where nobody closes it: at the end multiprocessing asks its processes to stop, and waits.
        atexit.register(self.process.kill)

    def tell(self, message: Message) -> None:
        """Say what is to be done next."""
        self.untold.append(message)
        try:
            while self.untold:
                _send(self.connection, self.untold.pop(0))
        except OSError:
            raise self._ended() from None

    def answer(self) -> Message:
        """What came of it.

        Raises:
            InputError: something that came in cannot be used, or the process has ended.
            RuntimeError: whatever else went wrong there.
        """
        try:
            answer = _receive(self.connection)
        except (EOFError, OSError):
            raise self._ended() from None
        if "refused" in answer:
            raise InputError(answer["refused"])
        if "failed" in answer:
            raise RuntimeError(f"in a process that asks training sessions:\n{answer['failed']}")
        return answer

    def close(self) -> None:
        """End the process; it ends too when this one does, however that comes."""
        self.connection.close()
        self.process.kill()  # by itself it would take a second, and it has nothing to put away
        self.process.join()
        atexit.unregister(self.process.kill)

    def _ended(self) -> InputError:
        self.process.join(10)
        status = self.process.exitcode
        why = "what it said is above; a script needs the line if __name__ == '__main__':"
        if status is None or status <= 0:
            why = "-9 is what a system does that runs out of memory"
        return InputError(
            f"a process that asks part of the training's sessions has ended (status {status}; "
            f"{why}); go on by resume=<run folder>, with the environment variable "
            "NUMBA_NUM_THREADS=1 if one process is to ask all"
        )


@contextmanager
def _signals_for_us() -> Iterator[None]:
    """A process that is started in the block is not reached by Ctrl-C, which a terminal sends to
    all, nor by SIGTERM: the training stops when its update is done, and needs all parts for it."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    track_resources()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(
    connection: Connection,
    make: Callable[[], Part],
    threads: int,
    torch_threads: int,
    typed: frozenset[str],
) -> None:
    """Ask the sessions of a part as told, until nobody tells any more."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    for reference in typed:
        allow(reference)
    torch.set_num_threads(torch_threads)
    share_out(threads)
    part: Part | None = None
    while True:
        try:
            message = _receive(connection)
            try:
                part = part or make()
                answer = _follow(part, message)
            except InputError as error:
                answer = {"refused": str(error)}
            except Exception:
                answer = {"failed": traceback.format_exc()}
            if answer is not None:
                _send(connection, answer)
        except (EOFError, OSError):  # whoever told is gone
            return


def _follow(part: Part, message: Message) -> Message | None:
    """Do what a message says; what is to be answered."""
    if "state" in message:
        part.load_state_dict(message["state"])
        return None
    if "before" in message:
        part.sessions.policy.weights.load_state_dict(message["weights"])
        return {"batch": part.collect(message["before"]).to_dict()}
    return {"state": part.state_dict()}


def _send(connection: Connection, message: Message) -> None:
    buffer = io.BytesIO()
    torch.save(message, buffer)
    connection.send_bytes(buffer.getvalue())


def _receive(connection: Connection) -> Message:
    message: Message = torch.load(io.BytesIO(connection.recv_bytes()), weights_only=True)
    return message
