"""Access control of the workbench: only a browser on this machine that opened the printed address.

The server is bound to the loopback address. This alone does not exclude pages of other sites in the
operator's browser:

- A page whose name resolves to 127.0.0.1 (DNS rebinding) sends its own name as Host. Any Host but
  this server's is refused.
- A page of another site, or of another port of this machine, sends its Origin with a WebSocket
  handshake and with every request that changes something, and Sec-Fetch-Site with all requests.
  Origins and sites other than this server are refused; a WebSocket must state its Origin.
- Another user or program of this machine does not have the cookie, a random secret that scripts
  cannot read and other sites do not send. The cookie is given once, for the random token of the
  address that the command prints; every other request needs it. An unused token expires.

A policy in every answer forbids the browser to load anything from other hosts, and other sites to
show the page in a frame.
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
"""Paths that are served in addition to the page."""
LOOPBACK = ("127.0.0.1", "::1")
TOKEN = "token"  # noqa: S105 (its name)
UNUSED_S = 600.0  # time until an unused token expires, s; a choice
_FORWARD = b"""<!doctype html><title>hilcal</title><link rel="icon" href="data:,">
<meta http-equiv="refresh" content="0; url=/">"""
"""A page that forwards to the workbench. After an HTTP redirection a browser that came from another
page or a file would not send a strict cookie."""


class AccessGuard:
    """An ASGI application that passes on only requests of the operator's browser."""

    def __init__(self, app: App, port: int, token: str) -> None:
        """Guard an application at a port; `token` is the secret in its address."""
        self.app, self._token = app, token
        self._secret = secrets.token_urlsafe(32)
        self._until = time.monotonic() + UNUSED_S
        self.entered = False
        self._hosts = tuple(f"{name}:{port}" for name in ("127.0.0.1", "localhost"))
        self.origins = tuple(f"http://{host}" for host in self._hosts)
        self._cookie = f"hilcal_workbench_{port}"
        sockets = " ".join(f"ws://{host}" for host in self._hosts)
        # Vue compiles templates and the viewer is wasm: both kinds of `eval` are needed.
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
        why = self._foreign(scope)
        if why is not None:
            await self._refuse(scope, send, 403, why)
        elif self._has_cookie(scope):
            if scope["path"] != "/" and not scope["path"].startswith(PATHS):
                await self._refuse(scope, send, 404, "nothing here")
            elif scope["path"] == "/" and scope["query_string"]:
                await self._answer(send, 303, (b"location", b"/"))
            else:
                await self.app(scope, receive, self._with_policy(send))
        elif not self._has_token(scope):
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
            await self._answer(send, 200, (b"set-cookie", cookie.encode()), kind, body=_FORWARD)

    @property
    def abandoned(self) -> bool:
        """Whether the token expired unused, so that nobody can open the page any more."""
        return not self.entered and time.monotonic() > self._until

    def _foreign(self, scope: Scope) -> str | None:
        """Return why a request is not from this server's page on this machine; None if it is."""
        if (scope.get("client") or LOOPBACK)[0] not in LOOPBACK:
            return "only this machine may ask"
        if _header_values(scope, b"host") not in [[host] for host in self._hosts]:
            return "not the name of this server"
        origins = _header_values(scope, b"origin")
        if scope["type"] == "websocket" and len(origins) != 1:
            return "a WebSocket without a page"
        if any(origin not in self.origins for origin in origins):
            return "not a page of this server"
        site = _header_values(scope, b"sec-fetch-site")
        visited = _header_values(scope, b"sec-fetch-mode") == ["navigate"] and scope["path"] == "/"
        if any(s not in ("same-origin", "none") for s in site) and not visited:
            return "not a page of this server"
        return None

    def _has_cookie(self, scope: Scope) -> bool:
        jar = SimpleCookie()
        try:
            jar.load("; ".join(_header_values(scope, b"cookie")))
        except CookieError:
            return False
        cookie = jar.get(self._cookie)
        return cookie is not None and _same(cookie.value, self._secret)

    def _has_token(self, scope: Scope) -> bool:
        if scope["type"] != "http" or (scope["method"], scope["path"]) != ("GET", "/"):
            return False
        tokens = parse_qs(scope["query_string"].decode("latin-1")).get(TOKEN, [""])
        return _same(tokens[0], self._token)

    async def _answer(
        self, send: Send, status: int, *headers: tuple[bytes, bytes], body: bytes = b""
    ) -> None:
        head = {"type": "http.response.start", "status": status}
        await send({**head, "headers": [*headers, *self._headers]})
        await send({"type": "http.response.body", "body": body})

    async def _refuse(self, scope: Scope, send: Send, status: int, why: str) -> None:
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": why})
            return
        kind = (b"content-type", b"text/plain; charset=utf-8")
        await self._answer(send, status, kind, body=f"{why}\n".encode())

    def _with_policy(self, send: Send) -> Send:
        async def send_with_policy(message: Message) -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message.get("headers", ()), *self._headers]}
            await send(message)

        return send_with_policy


def _header_values(scope: Scope, name: bytes) -> list[str]:
    return [value.decode("latin-1") for key, value in scope["headers"] if key.lower() == name]


def _same(a: str, b: str) -> bool:
    return secrets.compare_digest(a.encode(), b.encode())
