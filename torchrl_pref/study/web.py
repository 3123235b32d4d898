"""The page of a study, and what it asks of the server: docs/study.md lists the requests.

Every answer to a request is a fixed sentence or comes from the study; nothing that a request holds
is said back, and nothing is run or read because a request names it.
"""

from __future__ import annotations

import json
import re
import secrets
from collections.abc import Callable
from importlib.resources import files
from typing import Any

from starlette.applications import Starlette
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from torchrl_pref.errors import InputError
from torchrl_pref.study.log import LogError
from torchrl_pref.study.participant import Participant
from torchrl_pref.study.study import Study

LARGEST_BODY = 4096
"""Bytes of a request: an answer has some hundred."""

LONGEST_SECONDS, MOST_REPLAYS = 1e6, 10**6

TYPES = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
    "png": "image/png",
    "jpg": "image/jpeg",
    "jpeg": "image/jpeg",
    "gif": "image/gif",
}

HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class Refused(Exception):
    """A request that is not fulfilled: status, and a sentence for the person."""

    def __init__(self, status: int, sentence: str, person: Participant | None = None) -> None:
        super().__init__(sentence)
        self.status, self.person = status, person


def make_app(study: Study, hosts: tuple[str, ...], token: str | None) -> ASGIApp:
    """The application that serves a study.

    Args:
        study: what it serves.
        hosts: names that the page may be asked for by, in the header Host, whatever the port, as
            of a tunnel; empty where a token is asked for.
        token: what each request but those for the page's own files must bring; None on loopback.
    """
    routes = [
        Route("/", _file("index.html")),
        *(Route(f"/static/{name}", _file(name)) for name in static_files()),
        Route("/api/study", _endpoint(study, token, _about)),
        Route("/api/state", _endpoint(study, token, _state)),
        Route("/api/picture/{name}", _endpoint(study, token, _picture)),
        Route("/api/join", _endpoint(study, token, _join), methods=["POST"]),
        Route("/api/answer", _endpoint(study, token, _answer), methods=["POST"]),
        Route("/api/undo", _endpoint(study, token, _undo), methods=["POST"]),
        Route("/api/stop", _endpoint(study, token, _stop), methods=["POST"]),
        Route("/api/go_on", _endpoint(study, token, _go_on), methods=["POST"]),
    ]
    handlers: dict[Any, Any] = {404: _not_here, 405: _not_here, 500: _failed}
    return guarded(Starlette(routes=routes, exception_handlers=handlers), hosts)


def guarded(app: ASGIApp, hosts: tuple[str, ...]) -> ASGIApp:
    """The application behind its door: whom it answers, and the headers of all that it says."""

    async def door(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await app(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                named = [(key.lower().encode(), value.encode()) for key, value in HEADERS.items()]
                message = {**message, "headers": [*message["headers"], *named]}
            await send(message)

        refusal = refuse_foreign(Request(scope), hosts)
        await (app if refusal is None else refusal)(scope, receive, with_headers)

    return door


def refuse_foreign(request: Request, hosts: tuple[str, ...]) -> Response | None:
    """What is said to requests that other pages make, or that come under another name."""
    host, origin = request.headers.get("host", ""), request.headers.get("origin")
    name = host.lower().rpartition(":")[0] if re.search(r":\d+$", host) else host.lower()
    if hosts and name not in hosts:  # a foreign name that leads here (DNS rebinding)
        return _sentence(421, "This study is not served under that name.")
    site = request.headers.get("sec-fetch-site", "same-origin")
    # https, where a server with a certificate stands before this one.
    own = f"http://{host.lower()}", f"https://{host.lower()}"
    foreign = origin is not None and origin.lower() not in own
    if request.method not in ("GET", "HEAD") and (foreign or site not in ("same-origin", "none")):
        return _sentence(403, "Only the page of this study may do that.")
    return None


def static_files() -> dict[str, bytes]:
    """The files of the page, by name."""
    folder = files("torchrl_pref.study") / "static"
    return {
        one.name: one.read_bytes() for one in folder.iterdir() if one.name.split(".")[-1] in TYPES
    }


def _file(name: str) -> Callable[[Request], Response]:
    content = static_files()[name]
    return lambda request: Response(content, media_type=TYPES[name.split(".")[-1]])


def _sentence(status: int, sentence: str, state: dict[str, Any] | None = None) -> JSONResponse:
    return JSONResponse({"error": sentence, "state": state}, status)


def _not_here(request: Request, error: Exception) -> Response:
    return _sentence(404, "There is nothing here.")


def _failed(request: Request, error: Exception) -> Response:
    return _sentence(500, "Something went wrong here; nothing that was saved is lost.")


Handler = Callable[[Study, dict[str, Any]], Any]
"""From the study and what a request says to plain JSON, or a response."""


def _endpoint(study: Study, token: str | None, handler: Handler) -> Callable[[Request], Any]:
    """A handler with what all have in common: the token, the body, the study's turn."""

    def work(said: dict[str, Any]) -> Response:
        with study.turn():
            try:
                try:
                    result = handler(study, said)
                except Refused as error:
                    state = None if error.person is None else study.state(error.person)
                    return _sentence(error.status, str(error), state)
                if isinstance(result, Participant):
                    after = BackgroundTask(study.think_of, result)  # once the reply is sent
                    return JSONResponse(study.state(result), background=after)
            except LogError as error:
                return _sentence(503, str(error))
            return result if isinstance(result, Response) else JSONResponse(result)

    async def endpoint(request: Request) -> Response:
        brought = request.headers.get("x-study-token", "").encode()
        if token is not None and not secrets.compare_digest(brought, token.encode()):
            return _sentence(401, "This link lacks the key of the study; ask for the whole link.")
        try:
            said = {**request.query_params, **request.path_params}
            if request.method == "POST":
                said = await _read(request)
            return await run_in_threadpool(work, said)
        except Refused as error:
            return _sentence(error.status, str(error))
        except ClientDisconnect:
            return Response(status_code=400)

    return endpoint


async def _read(request: Request) -> dict[str, Any]:
    """The JSON of a request.

    Raises:
        Refused: it is too large, or no JSON object.
    """
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise Refused(415, "Expected JSON, with Content-Type: application/json.")
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > LARGEST_BODY:
            raise Refused(413, "That is too much at once.")
    try:
        said = json.loads(body)
    except (ValueError, RecursionError):
        raise Refused(400, "Expected JSON.") from None
    if not isinstance(said, dict):
        raise Refused(400, "Expected a JSON object.")
    return said


def _field(said: dict[str, Any], name: str, kinds: tuple[type, ...]) -> Any:
    """A field of a request.

    Raises:
        Refused: it is missing, or of another type.
    """
    value = said.get(name)
    if name not in said or type(value) not in kinds:
        raise Refused(400, f"The request lacks its {name}, or it is of another type.")
    return value


def _person(study: Study, said: dict[str, Any]) -> Participant:
    """The participant whom a request is about.

    Raises:
        Refused: there is none.
    """
    person = study.people.get(_field(said, "code", (str,)))
    if person is None:
        raise Refused(404, "Nobody of that code has begun; begin again from the first page.")
    return person


def _about(study: Study, said: dict[str, Any]) -> dict[str, Any]:
    settings = study.materials.settings["study"]
    return {
        "title": settings["title"],
        "instructions": study.instructions,
        "consent": settings["consent"],
        "questions": study.materials.n_questions,
        "participants": "open" if settings["participants"] is None else "named",
    }


def _join(study: Study, said: dict[str, Any]) -> Participant:
    code = _field(said, "code", (str,))
    if study.may_join(code) and study.lacks_consent(code) and said.get("consent") is not True:
        raise Refused(403, "Nobody can begin who has not agreed to take part.")
    person = study.join(code)
    if person is None:
        raise Refused(
            404,
            "No participant is called that. A code has up to 32 letters, digits, - and _; it may "
            "have to be the one that you were given.",
        )
    return person


def _state(study: Study, said: dict[str, Any]) -> Participant:
    return _person(study, said)


def _answer(study: Study, said: dict[str, Any]) -> Participant:
    person = _person(study, said)
    key, answer = _field(said, "key", (str,)), _field(said, "answer", (int, type(None)))
    seconds = _field(said, "seconds", (int, float))
    replays = _field(said, "replays", (int,))
    if not 0 <= seconds <= LONGEST_SECONDS or not 0 <= replays <= MOST_REPLAYS:
        raise Refused(400, "The request has impossible numbers.")
    try:
        taken = person.answer(key, answer, float(seconds), replays)
    except InputError:
        raise Refused(400, "There is no such answer to this question.", person) from None
    if not taken:
        raise Refused(
            409, "That question was answered or changed elsewhere; this is the present one.", person
        )
    return person


def _undo(study: Study, said: dict[str, Any]) -> Participant:
    person = _person(study, said)
    if not person.undo(_field(said, "key", (str,))):
        raise Refused(409, "There is no such answer, or it was taken back already.", person)
    return person


def _stop(study: Study, said: dict[str, Any]) -> Participant:
    person = _person(study, said)
    person.stop()
    return person


def _go_on(study: Study, said: dict[str, Any]) -> Participant:
    person = _person(study, said)
    person.go_on()
    return person


def _picture(study: Study, said: dict[str, Any]) -> Response:
    path = study.scenes.path(said["name"])
    if path is None:
        raise Refused(404, "There is no such picture.")
    try:
        with open(path, "rb") as file:
            content = file.read()
    except OSError:
        raise Refused(404, "The file of this picture is gone.") from None
    return Response(content, media_type=TYPES[path.rsplit(".", 1)[-1].lower()])
