"""The log of a study: what happened, in order, in one SQLite file that only grows.

An event is on the disk before anybody is told that it happened, and nothing is ever rewritten:
taking an answer back is an event as well. Whatever is known follows from the log alone.
"""

from __future__ import annotations

import json
import sqlite3
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

from torchrl_pref.errors import InputError

FORMAT = 1
"""Of the file: ``PRAGMA user_version``."""

APPLICATION = 0x70726566
"""By which the file is known for a study's: ``PRAGMA application_id``, "pref" in ASCII."""

SCHEMA = f"""
CREATE TABLE event (
    number INTEGER PRIMARY KEY,
    at TEXT NOT NULL,
    participant TEXT NOT NULL,
    kind TEXT NOT NULL,
    once TEXT UNIQUE,
    content TEXT NOT NULL,
    digest TEXT NOT NULL
) STRICT;
CREATE TRIGGER never_changed BEFORE UPDATE ON event
    BEGIN SELECT RAISE(ABORT, 'events are never changed'); END;
CREATE TRIGGER never_removed BEFORE DELETE ON event
    BEGIN SELECT RAISE(ABORT, 'events are never removed'); END;
PRAGMA application_id = {APPLICATION};
PRAGMA user_version = {FORMAT};
"""


class LogError(Exception):
    """The log cannot be written now; nothing has changed. The message is for the person there."""


class Event(NamedTuple):
    """Something that happened."""

    number: int
    """Events are in this order, whatever the clock says."""
    at: str
    """The time by the clock of the machine, UTC, ISO 8601."""
    participant: str
    """Whom it is about; empty where it is about the study."""
    kind: str
    content: dict[str, Any]


def digest_of(*row: str | None) -> str:
    """By which it is noticed that an event is not as it was written: its SHA-256, shortened."""
    return sha256(json.dumps(row).encode()).hexdigest()[:16]


class Log:
    """The events of a study.

    Args:
        path: the file; it is made where it is not there.

    Attributes:
        last: the number of the newest event that was written here, or known when it was opened.

    Raises:
        InputError: it is no log of a study, it is spoiled, or it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.last = path, 0
        try:
            # Used by one thread at a time: whoever holds the study's lock.
            self._base = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
            try:
                self._open()
            except BaseException:
                self._base.close()
                raise
        except sqlite3.Error as error:
            raise InputError(
                f"{path}: cannot be used as the log of a study ({error}); restore a copy of it, or "
                "name another folder"
            ) from None

    def _open(self) -> None:
        """Make the file where it is new, else look whether it is a log."""
        ask = self._base.execute
        # WAL lets readers in beside the writer; FULL: no commit is lost when the power goes.
        ask("PRAGMA journal_mode = WAL")
        ask("PRAGMA synchronous = FULL")
        if ask("SELECT count(*) FROM sqlite_schema").fetchone()[0] == 0:
            self._base.executescript(f"BEGIN; {SCHEMA} COMMIT;")
        application, version = (
            ask(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version")
        )
        if application != APPLICATION or version != FORMAT:
            raise InputError(
                f"{self.path}: no log of a study in format {FORMAT}, the one of this version; "
                "expected the folder of a study that ask.py made"
            )
        damage = ask("PRAGMA quick_check(1)").fetchone()[0]
        if damage != "ok":
            raise InputError(f"{self.path}: is spoiled ({damage}); restore a copy of it")
        self.last = ask("SELECT coalesce(max(number), 0) FROM event").fetchone()[0]

    def append(
        self, participant: str, kind: str, content: dict[str, Any], once: str | None = None
    ) -> str | None:
        """Write down what happened; it is on the disk when this returns.

        Args:
            participant: whom it is about.
            kind: what happened.
            content: plain JSON.
            once: of events with the same, only the first is written.

        Returns:
            The time that was written with it; None where there is one with the same ``once``.

        Raises:
            LogError: it cannot be written, as on a full disk.
        """
        at = datetime.now(UTC).isoformat()
        event = at, participant, kind, once, json.dumps(content)
        row = (*event, digest_of(*event))
        try:
            done = self._base.execute(
                "INSERT INTO event (at, participant, kind, once, content, digest) "
                "VALUES (?, ?, ?, ?, ?, ?) "
                "ON CONFLICT (once) DO NOTHING",
                row,
            )
        except sqlite3.Error as error:
            raise LogError(
                f"The study cannot be written to now ({error}). Nothing that was saved is lost: "
                "try again once the disk has room."
            ) from None
        if done.rowcount != 1:
            return None
        self.last = done.lastrowid or self.last
        return at

    def events(self, participant: str | None = None) -> list[Event]:
        """What happened, in order; of one participant where one is named.

        Raises:
            InputError: the file is spoiled.
        """
        query = "SELECT number, at, participant, kind, once, content, digest FROM event"
        names = () if participant is None else (participant,)
        where = "" if participant is None else " WHERE participant = ?"
        try:
            found = self._base.execute(f"{query}{where} ORDER BY number", names).fetchall()
            for place, (number, *row, digest) in enumerate(found, 1):
                if digest != digest_of(*row) or (participant is None and number != place):
                    raise ValueError(f"event {number} is not as it was written")
            return [
                Event(number, at, who, kind, json.loads(content))
                for number, at, who, kind, _, content, _ in found
            ]
        except (sqlite3.Error, ValueError) as error:
            raise InputError(f"{self.path}: is spoiled ({error}); restore a copy of it") from None

    def close(self) -> None:
        """Let the file go."""
        self._base.close()
