"""Who may speak to a viewer's server: its own pages, and programs that are no browser.

A browser lets any page open a WebSocket to any address, this machine's among them, and viser does not ask
which page it was: another site in the same browser could move markers in an open scene. Browsers name the
page's origin, and the host that was asked for, so both are checked.
"""

from __future__ import annotations

import inspect
import ipaddress
import json
import re
import socket
import threading
from base64 import b64encode
from collections.abc import Callable
from functools import cache, partial
from hashlib import sha256
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from fidsplat.util.errors import FidsplatError

_LOCK = threading.Lock()


def refused(origin: str | None, host: str | None, listens: str) -> str:
    """Why a request is refused; empty where it is not.

    Args:
        origin, host: headers of the request; a browser sends both.
        listens: address that the server listens on. On this machine's own, pages that were asked for by
            another name are refused: their name was made to point here.
    """
    if origin is None:
        return ""
    try:
        site, name = urlsplit(origin).netloc, urlsplit(f"//{host}").hostname
    except ValueError:
        return "this page says of itself what is no address"
    if site.lower() != (host or "").lower():
        return "this page is of another site"
    if not _ours(name or "", listens):
        return "this machine is known by another name; open the address that fidsplat view printed"
    return ""


def _ours(name: str, listens: str) -> bool:
    if name in ("localhost", listens.lower()):
        return True
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        return not _local(listens) and name in (socket.gethostname().lower(), socket.getfqdn().lower())
    return address.is_loopback or not _local(listens)


def _local(listens: str) -> bool:
    try:
        return ipaddress.ip_address(listens).is_loopback
    except ValueError:
        return listens.lower() == "localhost"


def guarded(make: Callable[[], Any], listens: str) -> Any:
    """The server of websockets that `make` starts and returns, which answers pages of others with 403. viser
    has no setting for it, so what it starts its server with is exchanged meanwhile.

    Raises:
        FidsplatError: what was started is not guarded, and was stopped.
    """
    from websockets.asyncio import server

    policy()  # before anything listens
    with _LOCK:
        serve, started = server.serve, []

        def guarding(*words: Any, process_request: Callable[..., Any] | None = None, **options: Any) -> Any:
            started.append(True)
            return serve(*words, process_request=partial(_answer, listens, process_request), **options)

        server.serve = guarding  # type: ignore[misc, assignment]
        try:
            made = make()
        finally:
            server.serve = serve  # type: ignore[misc]
    if not started:
        made.stop()
        raise FidsplatError(
            "this version of viser starts its server in a way that fidsplat cannot guard against pages of "
            "other sites; pip install 'viser==1.1.1'"
        )
    return made


async def _answer(listens: str, further: Callable[..., Any] | None, connection: Any, request: Any) -> Any:
    """The refusal of a request, or what the server itself says to it."""
    headers = request.headers
    if why := refused(headers.get("Origin"), headers.get("Host"), listens):
        return connection.respond(HTTPStatus.FORBIDDEN, f"{why}\n")
    found = None if further is None else further(connection, request)
    response = await found if inspect.isawaitable(found) else found
    if response is not None:
        response.headers["Content-Security-Policy"] = policy()
        response.headers["X-Content-Type-Options"] = "nosniff"
    return response


@cache
def policy() -> str:
    """The content security policy of the page: it runs viser's own scripts alone, and shows no other pages.
    Markup that got into the page runs nothing.

    viser's page is one file: a loader, and the program, which the loader decodes from its attributes.

    Raises:
        FidsplatError: the page is built in another way.
    """
    import viser
    import zstandard

    try:
        page = (Path(viser.__file__).parent / "client" / "build" / "index.html").read_text("utf-8")
        ((facts, loader),) = re.findall(r"<script ([^>]*)>(.*?)</script>", page, re.DOTALL)
        packed, style, code = re.findall(r'data-(?:p|ss|cs)="([^"]*)"', facts)
        (alphabet,) = re.findall(r'const A=("(?:[^"\\]|\\.)*")', loader)
        size = int(style) + int(code)
        program = zstandard.ZstdDecompressor().decompress(_decoded(packed, json.loads(alphabet)), size)
    except (OSError, ValueError, zstandard.ZstdError) as error:
        raise FidsplatError(
            "the page of this version of viser is of a form for which fidsplat has no content security "
            "policy; pip install 'viser==1.1.1'"
        ) from error
    hashes = [b64encode(sha256(text).digest()).decode() for text in (loader.encode(), program[int(style) :])]
    scripts = " ".join(f"'sha256-{each}'" for each in hashes)
    return (
        "default-src 'self' data: blob:; connect-src 'self' data: blob: ws: wss:; "
        f"style-src 'unsafe-inline'; script-src {scripts} 'unsafe-eval'; worker-src data: blob:; "
        "frame-src 'none'; object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
    )


def _decoded(text: str, alphabet: str) -> bytes:
    """The packed bytes: four of every five digits, and d - 1 of d further digits."""
    table = np.zeros(128, np.uint64)
    table[[ord(letter) for letter in alphabet]] = np.arange(len(alphabet))
    values, base = table[np.frombuffer(text.encode("ascii"), np.uint8)], np.uint64(len(alphabet))
    most = len(values) // 5 * 5
    powers = base ** np.arange(4, -1, -1, dtype=np.uint64)
    rest = int(values[most:] @ powers[5 - len(values[most:]) :]) if len(values) > most else 0
    left = max(len(values) - most - 1, 0)
    return (values[:most].reshape(-1, 5) @ powers).astype(">u4").tobytes() + rest.to_bytes(left, "big")
