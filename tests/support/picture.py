"""Pictures of a recording, made without a screen by rerun's own headless viewer."""

import contextlib
import ctypes
import ctypes.util
import json
import os
import socket
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hilcal.present.viewer.recording import executable

_ICD_DIRS = ("/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d", "/etc/vulkan/icd.d")
_START_TIMEOUT = 60.0
_LOAD_TIMEOUT = 120.0
_SETTLE = 0.3


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


def vulkan_available():
    """Return whether the Vulkan loader and at least one driver description are installed."""
    named = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES") or ""
    files = [Path(p) for p in named.split(os.pathsep) if p]
    files = files or [file for d in _ICD_DIRS for file in Path(d).glob("*.json")]
    if not any(file.is_file() for file in files):
        return False
    try:
        ctypes.CDLL(ctypes.util.find_library("vulkan") or "libvulkan.so.1")
    except OSError:
        return False
    return True


needs_vulkan = pytest.mark.skipif(not vulkan_available(), reason="no Vulkan driver installed")


def pictures(rrd, shots, size=(1920, 1080), longest=None):
    """Draw a recording into PNG files, one per shot, with one start of the viewer."""
    problems = {}
    with opened(rrd, size) as (viewer, _):
        for shot in shots:
            _take(viewer, shot, longest)
            for v in viewer.get_state().views:
                view_problems = problems.setdefault(v.name or v.view_id, set())
                view_problems.update(
                    f"{r.severity}: {r.summary} {r.details or ''}" for r in v.reports
                )
    return tuple(
        ViewReport(name, tuple(sorted(view_problems))) for name, view_problems in problems.items()
    )


@contextlib.contextmanager
def opened(rrd, size):
    """A headless viewer that has shown a recording, and the number of its process."""
    with _headless(size) as (viewer, process):
        viewer.open([str(Path(rrd).resolve())])
        end = time.monotonic() + _LOAD_TIMEOUT
        while not (state := viewer.get_state()).views or state.loading:
            assert time.monotonic() < end, f"recording not loaded within {_LOAD_TIMEOUT:g} s"
            time.sleep(0.05)
        while True:  # the first picture compiles shaders and loads meshes: it may take its time
            try:
                viewer.take_screenshot(max_size=64)
            except TimeoutError:
                if time.monotonic() > end:
                    raise
            else:
                break
        yield viewer, process


def _take(viewer, shot, longest):
    if shot.timeline is not None:
        when = {} if shot.at is None else {"sequence": shot.at}
        viewer.set_time(shot.timeline, play_state="paused", **when)
        time.sleep(_SETTLE)
    view_id = None
    if shot.view is not None:
        view_id = next(v.view_id for v in viewer.get_state().views if v.name == shot.view)
        _bring_forward(viewer, view_id)
    Path(shot.png).write_bytes(viewer.take_screenshot(view_id, max_size=longest))


def _bring_forward(viewer, view_id):
    """Make a view the active one of its tabs: only what is on the window is drawn."""
    parts = viewer.get_blueprint().blueprint
    path = f"/view/{view_id}"
    for name, part in parts.items():
        container = part.get("ContainerBlueprint", {})
        if path in container.get("contents", ()) and container.get("active_tab", path) != path:
            changed = {**part, "ContainerBlueprint": {**container, "active_tab": path}}
            viewer.set_blueprint({**parts, name: changed}, of="recording")
            time.sleep(_SETTLE)
            return


@contextlib.contextmanager
def _headless(size):
    """Run a viewer of our own in a home of its own, with analytics off; end it afterwards."""
    with tempfile.TemporaryDirectory(prefix="hilcal-picture-") as home, socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
        probe.close()
        log = Path(home, "viewer.log")
        command = [executable(), "--headless", "--hide-welcome-screen", "--bind", "127.0.0.1"]
        command += ["--port", str(port), "--window-size", f"{size[0]}x{size[1]}"]
        env = _environment(Path(home))
        with log.open("wb") as sink:
            process = subprocess.Popen(command, env=env, stdout=sink, stderr=subprocess.STDOUT)
        try:
            yield _connect(process, port), process.pid
        except (ConnectionError, RuntimeError) as error:
            raise AssertionError(f"the viewer failed: {log.read_text(errors='replace')}") from error
        finally:
            process.terminate()
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _connect(process, port):
    from rerun.experimental import ViewerClient

    end = time.monotonic() + _START_TIMEOUT
    while True:
        if process.poll() is not None:
            raise ConnectionError(f"it exited with status {process.returncode}")
        try:
            with socket.create_connection(("127.0.0.1", port), 0.2):
                pass
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            client.get_state()
        except (OSError, RuntimeError) as error:
            if time.monotonic() > end:
                raise ConnectionError(f"it did not answer in {_START_TIMEOUT:g} s") from error
            time.sleep(0.05)
        else:
            return client


def _environment(home):
    config, run = home / "config", home / "run"
    for folder in (config / "rerun", run):
        folder.mkdir(parents=True, mode=0o700)
    (config / "rerun" / "analytics.json").write_text(
        json.dumps({"analytics_enabled": False, "analytics_id": "off", "metadata": {}})
    )
    return {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")} | {
        "HOME": str(home),
        "XDG_CONFIG_HOME": str(config),
        "XDG_DATA_HOME": str(home / "data"),
        "XDG_CACHE_HOME": str(home / "cache"),
        "XDG_RUNTIME_DIR": str(run),
        "RUST_LOG": "error",  # warnings pop up over the picture
        "NO_COLOR": "1",
    }


def pixels(png):
    """(height, width, channels) of a PNG."""
    with Image.open(png) as image:
        return np.asarray(image)


def contrast(a, b):
    """Ratio of relative luminances of two colours (0 to 255), as WCAG 2 defines it."""
    c = np.array([a, b]) / 255.0
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    low, high = sorted(linear @ [0.2126, 0.7152, 0.0722] + 0.05)
    return float(high / low)
