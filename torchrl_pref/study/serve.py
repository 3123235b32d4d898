"""A study served at an address of this machine, and the link to it."""

from __future__ import annotations

import ipaddress
import os
import secrets
import socket
import sys
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager

import uvicorn

from torchrl_pref.errors import InputError
from torchrl_pref.study.study import Study
from torchrl_pref.study.web import make_app


@contextmanager
def listening_at(host: str, port: int) -> Iterator[socket.socket]:
    """A socket to serve a study at, for the length of the block.

    Args:
        host: an address of this machine.
        port: of the page; 0 is any that is free.

    Raises:
        InputError: nothing can be served there.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM)
    with listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((host, port))
            listening.listen()  # so that who follows the link at once waits, and is not refused
        except OSError as error:
            raise InputError(
                f"host={host} port={port}: cannot be served there ({error.strerror or error}); "
                "type another port, or port=0 for any that is free"
            ) from None
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
    token = None if local else secrets.token_urlsafe(24)
    hosts = tuple(f"{name}:{port}" for name in ("127.0.0.1", "localhost", "[::1]"))
    link = f"http://{_in_link(host)}:{port}/" + ("" if token is None else f"#token={token}")
    print(f"the study is at {link}", flush=True)
    if not local:
        print("whoever has this link can take part: hand it to the participants alone")
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
