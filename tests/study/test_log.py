"""The log of a study: it only grows, and says what it cannot."""

from __future__ import annotations

import sqlite3
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import pytest

from torchrl_pref.errors import InputError
from torchrl_pref.study.log import Log, LogError


@pytest.fixture
def log(tmp_path: Path) -> Log:
    return Log(tmp_path / "study.db")


def test_events_are_there_after_the_file_was_opened_again(log: Log) -> None:
    log.append("P1", "joined", {"text": "ä \"' ; DROP TABLE event", "numbers": [1, 2.5, None]})
    log.append("P2", "joined", {})
    log.close()
    again = Log(log.path)
    first, second = again.events()
    assert first.content == {"text": "ä \"' ; DROP TABLE event", "numbers": [1, 2.5, None]}
    assert (first.participant, second.participant) == ("P1", "P2")
    assert first.number < second.number
    assert [event.participant for event in again.events("P2")] == ["P2"]


def test_events_are_in_their_order_whatever_the_clock_says(
    log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    days = iter(datetime(2026, 1, day, tzinfo=UTC) for day in (2, 1))
    clock = SimpleNamespace(now=lambda zone: next(days))
    monkeypatch.setattr("torchrl_pref.study.log.datetime", clock)
    for said in (0, 1):
        log.append("P1", "answer", {"said": said})
    assert [event.content["said"] for event in log.events("P1")] == [0, 1]


def test_what_may_be_once_is_once(log: Log) -> None:
    assert log.append("P1", "answer", {"said": 0}, "answer 1")
    assert log.append("P1", "answer", {"said": 1}, "answer 1") is None
    assert log.append("P1", "answer", {"said": 1}, "answer 2")
    assert [event.content["said"] for event in log.events()] == [0, 1]


def test_nothing_is_changed_or_removed(log: Log) -> None:
    log.append("P1", "joined", {})
    other = sqlite3.connect(log.path, isolation_level=None)
    for change in ("UPDATE event SET participant = 'P2'", "DELETE FROM event"):
        with pytest.raises(sqlite3.IntegrityError, match="never"):
            other.execute(change)
    other.close()
    assert [event.participant for event in log.events()] == ["P1"]


def test_each_event_is_synced_to_the_disk(log: Log) -> None:
    for name, value in (("journal_mode", "wal"), ("synchronous", 2)):
        assert log._base.execute(f"PRAGMA {name}").fetchone()[0] == value


def test_a_full_disk_is_said_and_loses_nothing(log: Log) -> None:
    log.append("P1", "joined", {})
    pages = log._base.execute("PRAGMA page_count").fetchone()[0]
    log._base.execute(f"PRAGMA max_page_count = {pages}")
    with pytest.raises(LogError, match="try again once the disk has room"):
        log.append("P1", "answer", {"text": "x" * 20_000}, "answer 1")
    assert len(log.events()) == 1
    log._base.execute("PRAGMA max_page_count = 100000")
    assert log.append("P1", "answer", {"text": "x" * 20_000}, "answer 1")
    assert len(log.events()) == 2


@pytest.mark.parametrize("content", [b"no database, but text of some length" * 40, b"PK\x03\x04"])
def test_other_files_are_refused_and_stay(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "study.db"
    path.write_bytes(content)
    with pytest.raises(InputError, match="cannot be used as the log of a study"):
        Log(path)
    assert path.read_bytes() == content


def test_another_database_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "study.db"
    other = sqlite3.connect(path)
    other.execute("CREATE TABLE notes (text TEXT)")
    other.commit()
    other.close()
    with pytest.raises(InputError, match="no log of a study in format 1"):
        Log(path)


@pytest.mark.parametrize("seed", range(12))
def test_spoiled_bytes_are_noticed_or_harmless(log: Log, seed: int) -> None:
    """Never a traceback, and never other events than were written."""
    for number in range(40):
        log.append("P1", "answer", {"said": number % 2, "padding": "x" * 300}, f"answer {number}")
    events = log.events()
    log.close()
    whole = bytearray(log.path.read_bytes())
    place = (seed * 7919 + 1013) % len(whole)
    whole[place] ^= 0x55
    log.path.write_bytes(whole)
    try:
        again = Log(log.path)
        found = again.events()
    except InputError:
        return
    assert found == events


@pytest.mark.parametrize("change", ["content = replace(content, '1', '0')", "at = 'never'"])
def test_an_event_that_was_written_over_is_noticed(log: Log, change: str) -> None:
    """Even by somebody who knows how to go past the triggers."""
    log.append("P1", "answer", {"said": 1}, "answer 1")
    log.append("P1", "answer", {"said": 1}, "answer 2")
    log.close()
    with sqlite3.connect(log.path) as base:
        base.execute("DROP TRIGGER never_changed")
        base.execute(f"UPDATE event SET {change} WHERE number = 2")
    base.close()
    with pytest.raises(InputError, match="event 2 is not as it was written"):
        Log(log.path).events()


def test_an_event_that_was_removed_is_noticed(log: Log) -> None:
    for number in range(3):
        log.append("P1", "answer", {"said": number})
    log.close()
    with sqlite3.connect(log.path) as base:
        base.execute("DROP TRIGGER never_removed")
        base.execute("DELETE FROM event WHERE number = 2")
    base.close()
    with pytest.raises(InputError, match="event 3 is not as it was written"):
        Log(log.path).events()
