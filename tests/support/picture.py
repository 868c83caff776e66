"""Pictures of a recording, made without a screen by rerun's own headless viewer."""

import contextlib
import ctypes
import ctypes.util
import functools
import json
import os
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from PIL import Image

from hilcal.present.viewer.recording import executable

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

_ICD_DIRS = ("/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d", "/etc/vulkan/icd.d")
_START_TIMEOUT, _LOAD_TIMEOUT, _SETTLE = 60.0, 120.0, 0.3
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Shot:
    """One picture to take: of one view, by name, or of the whole window."""

    png: Path
    timeline: str | None = None
    at: int | None = None
    view: str | None = None


@dataclass(frozen=True, slots=True)
class ViewReport:
    """A view of the viewer, and every warning or error that it reported."""

    name: str
    problems: tuple[str, ...]


def vulkan_available() -> bool:
    """Return whether the Vulkan loader and at least one driver description are installed."""
    named = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES")
    drivers = any(any(Path(d).glob("*.json")) for d in _ICD_DIRS)
    if named:
        drivers = any(Path(p).is_file() for p in named.split(os.pathsep))
    try:
        ctypes.CDLL(ctypes.util.find_library("vulkan") or "libvulkan.so.1")
    except OSError:
        return False
    return drivers


def pictures(
    rrd: Path,
    shots: Sequence[Shot],
    size: tuple[int, int] = (1920, 1080),
    longest: int | None = None,
) -> tuple[ViewReport, ...]:
    """Draw a recording into PNG files, one per shot, with one start of the viewer.

    `size` is of the window, points; `longest` the longest side of the pictures, pixels. Returns the
    views with what they reported: no problems in a sound recording.
    """
    problems: dict[str, set[str]] = {}
    with opened(rrd, size) as (viewer, _):
        for shot in shots:
            _take(viewer, shot, longest)
            for v in viewer.get_state().views:
                found = problems.setdefault(v.name or v.view_id, set())
                found.update(f"{r.severity}: {r.summary} {r.details or ''}" for r in v.reports)
    return tuple(ViewReport(name, tuple(sorted(found))) for name, found in problems.items())


@contextlib.contextmanager
def opened(rrd: Path, size: tuple[int, int]) -> Iterator[tuple["ViewerClient", int]]:
    """A headless viewer that has shown a recording, and the number of its process."""

    def loaded() -> None:
        state = viewer.get_state()
        if not state.views or state.loading:
            raise TimeoutError("the recording is not loaded")

    with _headless(size) as (viewer, process):
        viewer.open([str(Path(rrd).resolve())])
        _until(loaded, _LOAD_TIMEOUT)
        # the first picture compiles shaders and loads meshes: it may take its time
        _until(lambda: viewer.take_screenshot(max_size=64), _LOAD_TIMEOUT)
        yield viewer, process


def _until(do: Callable[[], T], seconds: float) -> T:
    """Try until it works."""
    end = time.monotonic() + seconds
    while True:
        try:
            return do()
        except (OSError, RuntimeError):
            if time.monotonic() > end:
                raise
            time.sleep(0.05)


def _take(viewer: "ViewerClient", shot: Shot, longest: int | None) -> None:
    if shot.timeline is not None:
        at = {} if shot.at is None else {"sequence": shot.at}
        viewer.set_time(shot.timeline, play_state="paused", **at)
        time.sleep(_SETTLE)
    view_id = None
    if shot.view is not None:
        (view_id,) = (v.view_id for v in viewer.get_state().views if v.name == shot.view)
        _bring_forward(viewer, f"/view/{view_id}")
    shoot = functools.partial(viewer.take_screenshot, view_id, max_size=longest)
    Path(shot.png).write_bytes(_until(shoot, _LOAD_TIMEOUT))


def _bring_forward(viewer: "ViewerClient", path: str) -> None:
    """Make a view the active one of its tabs: only what is on the window is drawn."""
    parts = viewer.get_blueprint().blueprint
    for name, part in parts.items():
        container = part.get("ContainerBlueprint", {})
        if path in container.get("contents", ()) and container.get("active_tab", path) != path:
            changed = {**part, "ContainerBlueprint": {**container, "active_tab": path}}
            viewer.set_blueprint({**parts, name: changed}, of="recording")
            time.sleep(_SETTLE)
            return


@contextlib.contextmanager
def _headless(size: tuple[int, int]) -> Iterator[tuple["ViewerClient", int]]:
    """Run a viewer of our own in a home of its own, with analytics off; end it afterwards."""
    from rerun.experimental import ViewerClient

    with tempfile.TemporaryDirectory(prefix="hilcal-picture-") as home:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        command = [executable(), "--headless", "--hide-welcome-screen", "--bind", "127.0.0.1"]
        command += ["--port", str(port), "--window-size", f"{size[0]}x{size[1]}"]

        def connected() -> ViewerClient:
            assert process.poll() is None, f"the viewer failed: {log.read_text(errors='replace')}"
            socket.create_connection(("127.0.0.1", port), 0.2).close()
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            client.get_state()
            return client

        log = Path(home, "viewer.log")
        with log.open("wb") as sink:
            env = _environment(Path(home))
            process = subprocess.Popen(command, env=env, stdout=sink, stderr=subprocess.STDOUT)
        try:
            yield _until(connected, _START_TIMEOUT), process.pid
        finally:
            process.terminate()
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _environment(home: Path) -> dict[str, str]:
    for name in ("config/rerun", "run"):
        (home / name).mkdir(parents=True, mode=0o700)
    off = {"analytics_enabled": False, "analytics_id": "off", "metadata": {}}
    (home / "config" / "rerun" / "analytics.json").write_text(json.dumps(off))
    env = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    return env | {
        "HOME": str(home),
        "XDG_CONFIG_HOME": str(home / "config"),
        "XDG_DATA_HOME": str(home / "data"),
        "XDG_CACHE_HOME": str(home / "cache"),
        "XDG_RUNTIME_DIR": str(home / "run"),
        "RUST_LOG": "error",  # warnings pop up over the picture
        "NO_COLOR": "1",
    }


def pixels(png: Path) -> np.ndarray:
    """(height, width, 3) of a PNG."""
    with Image.open(png) as image:
        return np.asarray(image.convert("RGB"))
