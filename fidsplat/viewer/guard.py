"""Origin check and content security policy of the viewer's server.

Any page in a browser can open a WebSocket to any address, including this machine's, and viser does not check
the origin of the page: another site could move markers of an open scene. Browsers send the origin of the page
and the requested host; both are checked. Other programs send no origin and are accepted.
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


def refusal(origin: str | None, host: str | None, listens: str) -> str:
    """Reason to refuse a request; empty if it is accepted.

    Args:
        origin, host: headers of the request; a browser sends both.
        listens: address that the server listens on. If it is local, other host names are refused, against
            DNS rebinding.
    """
    if origin is None:
        return ""
    try:
        site, name = urlsplit(origin).netloc, urlsplit(f"//{host}").hostname
    except ValueError:
        return "the origin of this page must be a valid address"
    if site.lower() != (host or "").lower():
        return "this page is from another site"
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
    """Start a WebSocket server by `make`, with an origin check that answers other sites with status 403.

    viser has no setting for the check, so websockets' `serve` is replaced while the server starts. Raises
    FidsplatError if viser does not call it.
    """
    from websockets.asyncio import server

    policy()  # fails before the server listens
    with _LOCK:
        serve, started = server.serve, []

        def guarding(*words: Any, process_request: Callable[..., Any] | None = None, **options: Any) -> Any:
            started.append(True)
            return serve(*words, process_request=partial(_answer, listens, process_request), **options)

        server.serve = guarding  # type: ignore[misc, assignment]
        try:
            guard = make()
        finally:
            server.serve = serve  # type: ignore[misc]
    if not started:
        guard.stop()
        raise FidsplatError(
            "this version of viser starts its server in a way that fidsplat cannot guard against pages of "
            "other sites; pip install 'viser==1.1.1'"
        )
    return guard


async def _answer(listens: str, further: Callable[..., Any] | None, connection: Any, request: Any) -> Any:
    """The response to a request: a refusal, or the server's response with security headers."""
    headers = request.headers
    if why := refusal(headers.get("Origin"), headers.get("Host"), listens):
        return connection.respond(HTTPStatus.FORBIDDEN, f"{why}\n")
    found = None if further is None else further(connection, request)
    response = await found if inspect.isawaitable(found) else found
    if response is not None:
        response.headers["Content-Security-Policy"] = policy()
        response.headers["X-Content-Type-Options"] = "nosniff"
    return response


@cache
def policy() -> str:
    """The content security policy of the page: only viser's scripts run, and frames are forbidden, so that
    injected markup cannot run code.

    viser's page is one file: a loader, and a program that the loader decodes from its attributes. Raises
    FidsplatError if the page of this viser version has another form.
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
            f"viser must be version 1.1.1, for whose page fidsplat has a content security policy, got "
            f"{viser.__version__} with another page; pip install 'viser==1.1.1'"
        ) from error
    hashes = [b64encode(sha256(text).digest()).decode() for text in (loader.encode(), program[int(style) :])]
    scripts = " ".join(f"'sha256-{digest}'" for digest in hashes)
    return (
        "default-src 'self' data: blob:; connect-src 'self' data: blob: ws: wss:; "
        f"style-src 'unsafe-inline'; script-src {scripts} 'unsafe-eval'; worker-src data: blob:; "
        "frame-src 'none'; object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
    )


def _decoded(text: str, alphabet: str) -> bytes:
    """Decode text in the base of an alphabet: five digits to four bytes, and d remaining digits to d - 1."""
    table = np.zeros(128, np.uint64)
    table[[ord(letter) for letter in alphabet]] = np.arange(len(alphabet))
    values, base = table[np.frombuffer(text.encode("ascii"), np.uint8)], np.uint64(len(alphabet))
    most = len(values) // 5 * 5
    powers = base ** np.arange(4, -1, -1, dtype=np.uint64)
    rest = int(values[most:] @ powers[5 - len(values[most:]) :]) if len(values) > most else 0
    left = max(len(values) - most - 1, 0)
    return (values[:most].reshape(-1, 5) @ powers).astype(">u4").tobytes() + rest.to_bytes(left, "big")
