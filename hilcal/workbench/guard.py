"""Who may talk to the workbench: the browser to which its address was given, on this machine.

The server is bound to the loopback address. That alone does not keep out the pages of other sites,
which the operator's own browser opens:

- a page whose name is made to resolve to 127.0.0.1 (DNS rebinding) sends its own name as Host: any
  Host but this server's own is refused;
- a page of another site, or of another port of this machine, sends its Origin with a WebSocket
  handshake and with every request that changes something, and Sec-Fetch-Site with all: they are
  refused unless they are of this server; a WebSocket must say its Origin;
- another user or program of this machine has not the cookie, a random secret that scripts cannot
  read and other sites do not send. It is given once, for the random token of the address that the
  command prints; every other request needs it. A token that nobody uses dies after a while.

A policy in every answer forbids the browser to load anything from elsewhere, or to show the page in
a frame of another site.
"""

import secrets
import time
from collections.abc import Awaitable, Callable, MutableMapping
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

PATHS = ("/_nicegui/", "/_nicegui_ws/", "/viewer/")
"""What is served beside the page; the rest does not exist."""
LOOPBACK = ("127.0.0.1", "::1")
TOKEN = "token"  # noqa: S105 (its name)
UNUSED_S = 600.0  # how long a token waits for its use, s; a choice
_ENTERED = b"""<!doctype html><title>hilcal</title><link rel="icon" href="data:,">
<meta http-equiv="refresh" content="0; url=/">"""
"""The page itself leads on: a browser that another page or a file sent here would not send a strict
cookie along with a redirection."""


class AccessGuard:
    """An ASGI application that passes on only what the operator's browser asks for."""

    def __init__(self, app: App, port: int, token: str) -> None:
        """Guard an application at a port; `token` is the secret of its address."""
        self.app, self._token = app, token
        self._secret = secrets.token_urlsafe(32)
        self._until = time.monotonic() + UNUSED_S
        self.entered = False
        self._hosts = tuple(f"{name}:{port}" for name in ("127.0.0.1", "localhost"))
        self.origins = tuple(f"http://{host}" for host in self._hosts)
        self._cookie = f"hilcal_workbench_{port}"
        sockets = " ".join(f"ws://{host}" for host in self._hosts)
        # Vue compiles templates and wasm is code, so both kinds of `eval` are needed.
        self._headers = [
            (
                b"content-security-policy",
                (
                    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' "
                    "'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; img-src 'self' data: "
                    f"blob:; font-src 'self' data:; connect-src 'self' data: blob: {sockets}; "
                    "worker-src 'self' blob:; frame-src 'self'; frame-ancestors 'self'; "
                    "base-uri 'none'; form-action 'none'; object-src 'none'"
                ).encode(),
            ),
            (b"referrer-policy", b"no-referrer"),
            (b"x-content-type-options", b"nosniff"),
            (b"cross-origin-opener-policy", b"same-origin"),
            (b"cross-origin-resource-policy", b"same-origin"),
        ]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        why = self._stranger(scope)
        if why is not None:
            await self._refuse(scope, send, 403, why)
        elif self._has_cookie(scope):
            if scope["path"] != "/" and not scope["path"].startswith(PATHS):
                await self._refuse(scope, send, 404, "nothing here")
            elif scope["path"] == "/" and scope["query_string"]:
                await self._answer(send, 303, (b"location", b"/"))
            else:
                await self.app(scope, receive, self._marked(send))
        elif not self._knows(scope):
            await self._refuse(scope, send, 403, "open the address that hilcal workbench printed")
        elif self.entered or self.abandoned:
            why = "has been opened" if self.entered else "was left unused for too long"
            await self._refuse(
                scope, send, 403, f"this address {why}; start hilcal workbench again"
            )
        else:
            self.entered = True
            cookie = f"{self._cookie}={self._secret}; HttpOnly; SameSite=Strict; Path=/"
            kind = (b"content-type", b"text/html; charset=utf-8")
            await self._answer(send, 200, (b"set-cookie", cookie.encode()), kind, body=_ENTERED)

    @property
    def abandoned(self) -> bool:
        """Whether nobody has used the token in its time, and so nobody ever will."""
        return not self.entered and time.monotonic() > self._until

    def _stranger(self, scope: Scope) -> str | None:
        """Say why a request is not of this server's own page on this machine; None where it is."""
        if (scope.get("client") or LOOPBACK)[0] not in LOOPBACK:
            return "only this machine may ask"
        if _heads(scope, b"host") not in [[host] for host in self._hosts]:
            return "not the name of this server"
        origins = _heads(scope, b"origin")
        if scope["type"] == "websocket" and len(origins) != 1:
            return "a socket of no page"
        if any(origin not in self.origins for origin in origins):
            return "not a page of this server"
        site = _heads(scope, b"sec-fetch-site")
        visited = _heads(scope, b"sec-fetch-mode") == ["navigate"] and scope["path"] == "/"
        if any(s not in ("same-origin", "none") for s in site) and not visited:
            return "not a page of this server"
        return None

    def _has_cookie(self, scope: Scope) -> bool:
        jar = SimpleCookie()
        try:
            jar.load("; ".join(_heads(scope, b"cookie")))
        except CookieError:
            return False
        found = jar.get(self._cookie)
        return found is not None and _same(found.value, self._secret)

    def _knows(self, scope: Scope) -> bool:
        """Whether a visit of the page brings the token."""
        if scope["type"] != "http" or (scope["method"], scope["path"]) != ("GET", "/"):
            return False
        given = parse_qs(scope["query_string"].decode("latin-1")).get(TOKEN, [""])
        return _same(given[0], self._token)

    async def _answer(
        self, send: Send, status: int, *heads: tuple[bytes, bytes], body: bytes = b""
    ) -> None:
        head = {"type": "http.response.start", "status": status}
        await send({**head, "headers": [*heads, *self._headers]})
        await send({"type": "http.response.body", "body": body})

    async def _refuse(self, scope: Scope, send: Send, status: int, why: str) -> None:
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": why})
            return
        kind = (b"content-type", b"text/plain; charset=utf-8")
        await self._answer(send, status, kind, body=f"{why}\n".encode())

    def _marked(self, send: Send) -> Send:
        async def marked(message: Message) -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message.get("headers", ()), *self._headers]}
            await send(message)

        return marked


def _heads(scope: Scope, name: bytes) -> list[str]:
    """Return the headers of a name, of which there may be several."""
    return [value.decode("latin-1") for key, value in scope["headers"] if key.lower() == name]


def _same(a: str, b: str) -> bool:
    return secrets.compare_digest(a.encode(), b.encode())
