"""The workbench's server: NiceGUI on the loopback address, behind the guard."""

import contextlib
import os
import secrets
import signal
import socket
import tempfile
import threading
import webbrowser
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

from hilcal.errors import InputError
from hilcal.optional import needed_by
from hilcal.workbench.session import WorkbenchSession

HOST = "127.0.0.1"
PORT = 8787  # default port; a choice
GRACE = 2  # most time that an open page may delay the end, s


def require_nicegui() -> None:
    """Raise MissingPackageError if NiceGUI is not installed."""
    with needed_by("the workbench"):
        import nicegui  # noqa: F401


def _listening(port: int | None) -> socket.socket:
    """Listen at a loopback port; None: at the default port or, if it is occupied, at any port."""
    for candidate in (PORT, 0) if port is None else (port,):
        sock = socket.socket()
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            sock.bind((HOST, candidate))
        except (OSError, OverflowError) as error:
            sock.close()
            why = str(error)
            continue
        sock.listen(128)
        return sock
    raise InputError(f"--port {port}: {why}; choose a free port of this machine")


def _quiet_environment() -> None:
    """Keep NiceGUI from its own storage and from other machines."""
    folder = Path(tempfile.gettempdir()) / f"hilcal-no-storage-{secrets.token_hex(8)}"
    os.environ["NICEGUI_STORAGE_PATH"] = str(folder)
    for name in ("NICEGUI_REDIS_URL", "NICEGUI_HOST", "NICEGUI_PORT", "NICEGUI_PROTOCOL"):
        os.environ.pop(name, None)


@contextlib.contextmanager
def _forwarding_page(url: str) -> Iterator[Path]:
    """Yield a page, readable by its user only, that forwards a browser to an address.

    Every user of the machine can read the arguments of all processes: a browser that is started
    with the address itself would reveal its token.
    """
    runtime = Path(os.environ.get("XDG_RUNTIME_DIR", ""))
    place = runtime if runtime.is_absolute() and os.access(runtime, os.W_OK) else None
    with tempfile.TemporaryDirectory(prefix="hilcal-workbench-", dir=place) as folder:  # mode 0700
        file = Path(folder) / "open.html"
        file.touch(mode=0o600)
        page = f'<!doctype html><meta http-equiv="refresh" content="0; url={url}">'
        file.write_text(page, encoding="ascii")
        yield file


def serve(
    session: WorkbenchSession, port: int | None, announce: Callable[[str], None], *, browser: bool
) -> bool:
    """Serve the workbench of a campaign until Ctrl-C; return whether somebody opened it.

    The server also ends when its token expires unused. It calls `announce` with its address once it
    serves; `browser` opens the address in the default browser. Raises InputError if NiceGUI is not
    installed, or the port is not available.
    """
    require_nicegui()
    _quiet_environment()
    import logging

    import uvicorn
    from fastapi import FastAPI
    from nicegui import core, ui

    from hilcal.workbench.guard import TOKEN, AccessGuard
    from hilcal.workbench.page import install

    # The page shows errors of clicks; the library's log is for its developers.
    logging.getLogger("nicegui").setLevel(logging.CRITICAL)
    with _listening(port) as sock:
        number, token = int(sock.getsockname()[1]), secrets.token_urlsafe(32)
        app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
        install(app, session)
        ui.run_with(
            app,
            title=f"{session.path.name} – hilcal workbench",
            dark=None,
            tailwind=False,
            show_welcome_message=False,
            reconnect_timeout=10.0,
        )
        guard = AccessGuard(app, number, token)
        core.sio.eio.cors_allowed_origins = list(guard.origins)
        url = f"http://{HOST}:{number}/?{TOKEN}={token}"

        class Server(uvicorn.Server):
            @contextlib.contextmanager
            def capture_signals(self) -> Iterator[None]:
                def end(number: int, frame: FrameType | None) -> None:
                    self.should_exit = True

                kinds = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
                handlers = [signal.signal(kind, end) for kind in kinds]
                try:
                    yield
                finally:
                    for kind, handler in zip(kinds, handlers, strict=True):
                        signal.signal(kind, handler)

            async def startup(self, sockets: list[socket.socket] | None = None) -> None:
                await super().startup(sockets)
                announce(url)
                if browser:
                    page = opening.enter_context(_forwarding_page(url)).as_uri()
                    threading.Thread(target=webbrowser.open, args=(page,), daemon=True).start()

            async def on_tick(self, counter: int) -> bool:
                if guard.entered:
                    opening.close()
                return await super().on_tick(counter) or guard.abandoned

        config = uvicorn.Config(
            guard,
            log_level="critical",
            access_log=False,
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=GRACE,
            lifespan="on",
        )
        with contextlib.ExitStack() as opening:
            Server(config).run(sockets=[sock])
        return not guard.abandoned
