"""The server of a study: what it says, to whom, and what it does not let happen."""

from __future__ import annotations

import gc
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from starlette.testclient import TestClient
from study_helpers import client_of, materials_of, study_of, write_table

from torchrl_pref.errors import InputError
from torchrl_pref.study.log import LogError
from torchrl_pref.study.materials import check_images
from torchrl_pref.study.serve import Address, listening_at, read_address, serve, write_address
from torchrl_pref.study.study import Study

JSON = {"content-type": "application/json"}

IMAGES = "task=files task.path={}/runs.csv task.images=picture pool.size=20"
"""A study about what ``write_table`` leaves."""


@pytest.fixture
def study(tmp_path: Path) -> Iterator[Study]:
    made = study_of(tmp_path)
    yield made
    made.close()


@pytest.fixture
def client(study: Study) -> TestClient:
    return client_of(study)


def joined(client: TestClient, code: str = "P1") -> dict[str, Any]:
    return client.post("/api/join", json={"code": code}).json()


def body_of(state: dict[str, Any], answer: Any = 0, **other: Any) -> dict[str, Any]:
    """What the page sends for an answer to the open question."""
    body = {"code": state["code"], "key": state["question"]["key"], "answer": answer}
    return {**body, "seconds": 1.5, "replays": 1, **other}


def test_nobody_begins_without_their_consent(tmp_path: Path) -> None:
    study = study_of(tmp_path, "study.consent=true")
    client = client_of(study)
    for more in ({}, {"consent": False}, {"consent": 1}, {"consent": "true"}):
        assert client.post("/api/join", json={"code": "P1", **more}).status_code == 403
    assert not study.people
    assert client.post("/api/join", json={"code": "P1", "consent": True}).status_code == 200
    assert client.post("/api/join", json={"code": "P1"}).status_code == 200  # as after a reload
    assert [e.content["consented"] for e in study.log.events() if e.kind == "joined"] == [True]
    study.close()


def test_a_person_answers_and_sees_what_was_learned(study: Study, client: TestClient) -> None:
    about = client.get("/api/study").json()
    assert about == {
        "title": "Which do you like better?",
        "instructions": [],
        "consent": False,
        "questions": 6,
        "participants": "open",
    }
    state = joined(client)
    assert state["phase"] == "question"
    assert state["budget"] == 6
    seen = []
    while state["phase"] == "question":
        question = state["question"]
        assert len(question["options"]) == 2
        assert question["options"][0]["frames"]
        seen.append(question["key"])
        state = client.post("/api/answer", json=body_of(state)).json()
    assert state["end"] == {"reason": "budget"}
    assert len(set(seen)) == 6
    assert state == client.get("/api/state", params={"code": "P1"}).json()
    learned = state["learned"]
    assert len(learned["history"]) == 7
    assert learned["sureness"] == learned["history"][-1] > learned["history"][0]
    assert len(learned["names"]) == len(learned["mean"]) == 4
    assert learned["rationality"]["low"] < learned["rationality"]["high"]
    json.dumps(state, allow_nan=False)


def test_an_answer_is_undone_and_the_study_is_stopped(client: TestClient) -> None:
    state = joined(client)
    for answer in (0, 1, None):
        state = client.post("/api/answer", json=body_of(state, answer)).json()
    assert [one["label"] for one in state["answers"]] == ["A", "B", "cannot say"]
    undone = client.post("/api/undo", json={"code": "P1", "key": state["answers"][0]["key"]}).json()
    assert undone["question"]["again"]
    assert [one["label"] for one in undone["answers"]] == ["B", "cannot say"]
    stopped = client.post("/api/stop", json={"code": "P1"}).json()
    assert stopped["end"] == {"reason": "stopped"}
    assert client.post("/api/stop", json={"code": "P1"}).json()["end"] == {"reason": "stopped"}
    again = client.post("/api/go_on", json={"code": "P1"}).json()
    assert again["question"]["options"] == undone["question"]["options"]
    assert again["question"]["again"]


def test_two_tabs_do_not_answer_twice(study: Study, client: TestClient) -> None:
    state = joined(client)
    first = client.post("/api/answer", json=body_of(state, 0))
    again = client.post("/api/answer", json=body_of(state, 0))
    other = client.post("/api/answer", json=body_of(state, 1))
    assert (first.status_code, again.status_code, other.status_code) == (200, 200, 409)
    assert first.json() == again.json() == other.json()["state"]
    assert study.people["P1"].session.n_answered == 1


def test_a_full_disk_loses_nothing(
    study: Study, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = joined(client)
    append, room = study.log.append, [1]

    def nearly_full(*event: Any) -> Any:
        if not room:
            raise LogError("This could not be saved (full). Nothing is lost: try again.")
        room.pop()
        return append(*event)

    monkeypatch.setattr(study.log, "append", nearly_full)
    # The answer is saved, and what is shown next is not.
    full = client.post("/api/answer", json=body_of(state, 1))
    assert full.status_code == 503
    assert "Nothing is lost" in full.json()["error"]
    assert client.get("/api/state", params={"code": "P1"}).status_code == 503
    monkeypatch.setattr(study.log, "append", append)
    after = client.post("/api/answer", json=body_of(state, 1))
    assert after.status_code == 200
    assert after.json()["answered"] == 1
    assert after.json()["phase"] == "question"


HOSTILE: list[Any] = [
    "'; DROP TABLE event; --",
    "<script>alert(1)</script>",
    "../../etc/passwd",
    "\x00",
    "a" * 2000,
    -1,
    10**30,
    True,
    [],
    {},
    [[0]],
    {"$gt": ""},
    "𝕏",
    None,
    ...,
]
"""Values that nobody sends; of the dots, the field is left out."""

HARMLESS = {("answer", None)}
"""What of these means something: that the person cannot say."""


def hostile_requests(state: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Path and body of requests that must change nothing."""
    fields = {
        "answer": body_of(state),
        "undo": {"code": "P1", "key": state["question"]["key"]},
        "join": {"code": "P1"},
        "stop": {"code": "P1"},
        "go_on": {"code": "P1"},
    }
    for path, good in fields.items():
        for field in good:
            for value in HOSTILE:
                if not isinstance(value, list | dict) and (field, value) in HARMLESS:
                    continue
                body = {name: each for name, each in good.items() if name != field}
                yield path, body if value is ... else {**body, field: value}


def test_a_hundred_hostile_requests_change_nothing(study: Study, client: TestClient) -> None:
    state = joined(client)
    n_events, requests = len(study.log.events()), list(hostile_requests(state))
    assert len(requests) > 140
    for path, body in requests:
        response = client.post(f"/api/{path}", json=body)
        assert response.status_code in (400, 404, 409), (path, body)
        assert response.json()["error"].endswith(".")
        for value in HOSTILE[:5]:
            assert str(value) not in response.text
    assert client.get("/api/state", params={"code": "P1"}).json() == state
    assert len(study.log.events()) == n_events


@pytest.mark.parametrize(
    ("content", "headers", "status"),
    [
        (b"{", JSON, 400),
        (b"", JSON, 400),
        (b"[1]", JSON, 400),
        (b'"text"', JSON, 400),
        (b"\xff\xfe", JSON, 400),
        (b"[" * 4000, JSON, 400),
        (b'{"code": "' + b"x" * 10**6 + b'"}', JSON, 413),
        (b"1" * 4090, JSON, 400),
        (b'{"code": "P1"}', {"content-type": "text/plain"}, 415),
        (b"code=P1", {"content-type": "application/x-www-form-urlencoded"}, 415),
        (b'{"code": "P1"}', {}, 415),
        (b'{"code": "P1"}', {**JSON, "origin": "http://evil.example"}, 403),
        (b'{"code": "P1"}', {**JSON, "origin": "null"}, 403),
        (b'{"code": "P1"}', {**JSON, "origin": "http://127.0.0.1:9999"}, 403),
        (b'{"code": "P1"}', {**JSON, "sec-fetch-site": "cross-site"}, 403),
        (b'{"code": "P1"}', {**JSON, "host": "evil.example"}, 421),
        (b'{"code": "P1"}', {**JSON, "host": "127.0.0.1.evil.example:8000"}, 421),
        (b'{"code": "P1"}', {**JSON, "host": "evil.example:8000"}, 421),
        (b'{"code": "P1"}', {**JSON, "host": "[::2]:8000"}, 421),
    ],
)
def test_what_no_page_of_ours_sends_is_refused(
    study: Study, client: TestClient, content: bytes, headers: dict[str, str], status: int
) -> None:
    response = client.post("/api/join", content=content, headers=headers)
    assert response.status_code == status
    assert not study.people
    assert "evil" not in response.text


def test_the_page_of_the_study_itself_may_post(client: TestClient) -> None:
    headers = {"origin": "http://127.0.0.1:8000", "sec-fetch-site": "same-origin"}
    assert client.post("/api/join", json={"code": "P1"}, headers=headers).status_code == 200


@pytest.mark.parametrize(
    "path",
    [
        "/static/../web.py",
        "/static/%2e%2e/web.py",
        "/static/..%2f..%2fsession.py",
        "/static//etc/passwd",
        "/static/",
        "/static/missing.js",
        "/api/picture/0",
        "/api/picture/-1",
        f"/api/picture/{'9' * 5000}",
        "/api/picture/../../../etc/passwd",
        "/api/state?code=P9",
        "/api/state?code=%3Cscript%3E",
        "/api",
        "/docs",
        "/study.db",
        "/config.yaml",
    ],
)
def test_only_what_is_named_is_served(client: TestClient, path: str) -> None:
    response = client.get(path)
    assert response.status_code == 404
    assert "script>" not in response.text
    assert "Traceback" not in response.text


def test_methods_are_what_they_are(client: TestClient) -> None:
    for path in ("/api/join", "/api/answer", "/api/undo", "/api/stop", "/api/go_on"):
        assert client.get(path).status_code in (404, 405)
    for method in ("PUT", "DELETE", "PATCH", "TRACE"):
        assert client.request(method, "/api/state").status_code in (403, 404, 405)


def test_everything_that_is_said_has_its_headers(client: TestClient) -> None:
    for path in ("/", "/api/study", "/missing", "/api/state"):
        headers = client.get(path).headers
        assert headers["content-security-policy"].startswith(
            "default-src 'none'; script-src 'self'"
        )
        assert "unsafe" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["cache-control"] == "no-store"
        assert "server" not in headers


def test_outside_of_this_machine_nothing_is_told_without_the_token(study: Study) -> None:
    client = client_of(study, token="secret")
    for headers in ({}, {"x-study-token": "wrong"}, {"x-study-token": "é".encode("latin-1")}):
        assert client.get("/api/study", headers=headers).status_code == 401
        assert client.post("/api/join", json={"code": "P1"}, headers=headers).status_code == 401
    assert not study.people
    headers = {"x-study-token": "secret"}
    assert client.post("/api/join", json={"code": "P1"}, headers=headers).status_code == 200


def test_a_defect_of_ours_shows_no_trace(
    study: Study, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(code: str) -> None:
        raise RuntimeError("secret detail of /home/somebody")

    monkeypatch.setattr(study, "join", broken)
    response = client.post("/api/join", json={"code": "P1"})
    assert response.status_code == 500
    assert "secret" not in response.text


def test_thinking_ahead_changes_nothing(tmp_path: Path) -> None:
    """What is thought out beforehand is what would have been found out afterwards."""
    states = []
    for name in ("quick", "slow"):
        folder = tmp_path / name
        folder.mkdir()
        study = study_of(folder, "question=weak", "setup.budget=8")
        if name == "quick":
            study.think_ahead()
        client = client_of(study)
        state = joined(client)
        for turn in range(8):
            if name == "quick":
                until = time.monotonic() + 60
                while len(study.people["P1"].foreseen) < 4:
                    assert time.monotonic() < until, "nothing is thought ahead"
                    time.sleep(0.001)
            state = client.post(
                "/api/answer", json=body_of(state, [0, 2, 1, None][turn % 4])
            ).json()
        states.append(state)
        study.close()
    assert states[0] == states[1]


@pytest.mark.parametrize("origin", ["http://localhost:9000", "https://localhost:9000"])
def test_a_tunnel_or_a_server_with_a_certificate_may_stand_before_it(
    client: TestClient, origin: str
) -> None:
    headers = {**JSON, "host": "localhost:9000", "origin": origin}
    reply = client.post("/api/join", content=b'{"code": "P1"}', headers=headers)
    assert reply.status_code == 200


def test_pictures_have_the_same_name_after_a_restart(tmp_path: Path) -> None:
    write_table(tmp_path)
    typed = IMAGES.format(tmp_path).split()
    (tmp_path / "study").mkdir()
    found: dict[str, bytes] = {}
    for code in ("P1", "P2", "P1"):  # in another order than they were first seen
        study = study_of(tmp_path / "study", *typed)
        client = client_of(study)
        state = joined(client, code)
        for scene in (*state["question"]["options"], state["learned"]["best"]):
            url = scene["frames"][0][0]["url"]
            content = client.get(url).content
            assert content.startswith(b"\x89PNG")
            assert found.setdefault(url, content) == content
        study.close()


def test_an_image_that_cannot_be_seen_is_refused_before_anybody_is_asked(tmp_path: Path) -> None:
    write_table(tmp_path)
    typed = IMAGES.format(tmp_path).split()
    check_images(materials_of(*typed))
    spoiled = tmp_path / "5.png"
    spoiled.write_bytes(spoiled.read_bytes()[:45])
    materials = materials_of(*typed)  # of a study that is exported they may be spoiled by now
    with pytest.raises(InputError, match=r"5\.png: cannot be shown"):
        check_images(materials)


def test_a_study_is_found_at_the_same_link_when_it_goes_on(tmp_path: Path) -> None:
    assert read_address(tmp_path) == Address()
    known = Address(43210, "x" * 32)
    write_address(tmp_path, known)
    assert read_address(tmp_path) == known
    assert (tmp_path / "address.json").stat().st_mode & 0o077 == 0
    with listening_at(tmp_path, "127.0.0.1", 0) as listening:
        port = listening.getsockname()[1]
    write_address(tmp_path, Address(port, "x" * 32))
    with listening_at(tmp_path, "127.0.0.1", 0) as listening:
        assert listening.getsockname()[1] == port
        with listening_at(tmp_path, "127.0.0.1", 0) as other:  # it is taken
            assert other.getsockname()[1] != port
    for spoiled in ("", "[]", '{"port": 1}', '{"port": 99999, "token": "x"}', '{"port": null}'):
        (tmp_path / "address.json").write_text(spoiled)
        assert read_address(tmp_path) == Address()


def test_nobody_waits_until_all_that_was_imported_is_gone_through_for_garbage(
    study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    left_alone: list[int] = []
    monkeypatch.setattr(
        uvicorn.Server, "run", lambda self, sockets: left_alone.append(gc.get_freeze_count())
    )
    with listening_at(study.folder, "127.0.0.1", 0) as listening:
        serve(study, listening, "127.0.0.1", open_page=False)
    gc.unfreeze()
    assert left_alone[0] > 10_000
