"""A study served at an address of this machine, and the link to it."""

from __future__ import annotations

import ipaddress
import json
import os
import re
import secrets
import socket
import sys
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import uvicorn

from torchrl_pref.errors import InputError
from torchrl_pref.storage.writing import replacing
from torchrl_pref.study.study import Study
from torchrl_pref.study.web import make_app

ADDRESS = "address.json"
"""In the folder of a study: its port and the key of its link, so that links that were handed out,
and pages that are open, find it when it goes on."""


class Address(NamedTuple):
    """Where a study was served before."""

    port: int = 0
    token: str | None = None


@contextmanager
def listening_at(folder: Path, host: str, port: int) -> Iterator[socket.socket]:
    """A socket to serve a study at, for the length of the block.

    Args:
        folder: of the study.
        host: an address of this machine.
        port: of the page; 0 is that of before where it is free, else any that is.

    Raises:
        InputError: nothing can be served there.
    """
    before = read_address(folder).port
    if port == 0 and before and _is_free(host, before):
        port = before
    try:
        listening = _bound(host, port)
    except OSError as error:
        raise InputError(
            f"host={host} port={port}: cannot be served there ({error.strerror or error}); type "
            "another port, or port=0 for any that is free, and host=127.0.0.1 or another address "
            "of this machine"
        ) from None
    with listening:
        yield listening


def serve(study: Study, listening: socket.socket, host: str, open_page: bool) -> None:
    """Serve a study until Ctrl-C or SIGTERM.

    Args:
        study: what people answer.
        listening: where, see :func:`listening_at`.
        host: the address; any but this machine's loopback is reached from outside, and then the
            link has a token.
        open_page: whether to open the page, where there is a display.
    """
    port, local = listening.getsockname()[1], is_loopback(host)
    key = read_address(study.folder).token or secrets.token_urlsafe(24)
    write_address(study.folder, Address(port, key))
    token = None if local else key
    hosts = ("127.0.0.1", "localhost", "[::1]", _in_link(host).lower())
    link = f"http://{_in_link(host)}:{port}/" + ("" if token is None else f"#token={token}")
    print(f"the study is at {link}", flush=True)
    if not local:
        print(
            "whoever has this link can take part: hand it to the participants alone; where they do "
            "not find this machine by its name, put its address in the name's place"
        )
    print("Ctrl-C ends it; it can be gone on with", flush=True)
    if open_page and has_display():
        webbrowser.open(link)
    study.think_ahead()
    config = uvicorn.Config(
        make_app(study, hosts if local else (), token),
        log_level="warning",
        lifespan="off",
        server_header=False,
        limit_concurrency=200,
        timeout_graceful_shutdown=3,
    )
    uvicorn.Server(config).run([listening])


def read_address(folder: Path) -> Address:
    """Where a study was served before, as far as that is known."""
    try:
        content = json.loads((folder / ADDRESS).read_text(encoding="utf-8"))
        port, token = int(content["port"]), str(content["token"])
    except (OSError, ValueError, TypeError, KeyError):  # it is made anew
        return Address()
    known = 0 < port < 2**16 and re.fullmatch(r"[\w-]{32}", token)
    return Address(port, token) if known else Address()


def write_address(folder: Path, address: Address) -> None:
    """Keep where a study is served, for whoever owns its folder alone."""
    with replacing(folder / ADDRESS) as partial:
        partial.touch(0o600)
        partial.write_text(json.dumps(address._asdict()), encoding="utf-8")


def _is_free(host: str, port: int) -> bool:
    """Whether a port can be listened to."""
    try:
        with _bound(host, port):
            return True
    except OSError:
        return False


def _bound(host: str, port: int) -> socket.socket:
    """A socket at an address."""
    found = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
    try:
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.bind((host, port))
        found.listen()  # so that who follows the link at once waits, and is not refused
    except BaseException:
        found.close()
        raise
    return found


def is_loopback(host: str) -> bool:
    """Whether nobody outside of this machine reaches an address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def has_display() -> bool:
    """Whether a browser could show something to somebody here."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _in_link(host: str) -> str:
    """The host as it stands in a link: where all addresses are served, a name of this machine."""
    if host in ("0.0.0.0", "::"):
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host
