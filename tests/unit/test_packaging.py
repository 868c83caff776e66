"""What is installed is what is in the tree."""

import hashlib
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

import hilcal

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_every_directory_with_code_is_a_package():
    modules = [path for top in ("hilcal", "drivers") for path in (ROOT / top).rglob("*.py")]
    missing = {path.parent for path in modules if not (path.parent / "__init__.py").is_file()}
    assert not missing  # setup.py would leave them out


def _pinned(lock):
    text = (ROOT / lock).read_text(encoding="utf-8")
    entries = [line for line in text.splitlines() if line and not line.startswith(("#", " "))]
    assert all("==" in entry and entry.endswith("\\") for entry in entries)
    assert "://" not in text
    assert "--index" not in text
    return {entry.split("==")[0].lower() for entry in entries}


def test_the_locks_pin_every_dependency_with_hashes_and_name_no_host():
    pinned, added = _pinned("requirements.lock"), _pinned("requirements-docs.lock")
    assert not pinned & added
    project = PROJECT["project"]
    extras = {**project["optional-dependencies"], "": project["dependencies"]}
    extras["build"] = PROJECT["build-system"]["requires"]
    del extras["all"]  # names the others
    for extra, requirements in extras.items():
        have = pinned | added if extra in ("docs", "release") else pinned
        for requirement in requirements:
            name = re.split(r"[<>=\[;]", requirement)[0].strip().lower()
            assert name in have, requirement


BUILD = """
import os, sys
from setuptools.build_meta import build_sdist, build_wheel
os.umask(0o022)
print(build_sdist("dist") if sys.argv[1] == "sdist" else build_wheel("dist"))
"""
NAME = f"hilcal-{hilcal.__version__}"
NOT_TRACKED = shutil.ignore_patterns(
    *(".git", ".venv", ".*_cache", "__pycache__", "*.egg-info", "dist", "build", "site", ".lock"),
    *(".hypothesis", ".benchmarks", "out", ".benchmark-envs", ".wheel", ".peers"),
    *("bench.json", "MUJOCO_LOG.TXT"),
)


def _built(what, source):
    """Build an sdist or a wheel from a folder, as tools for packages do, and return it."""
    done = subprocess.run(
        [sys.executable, "-c", BUILD, what],
        cwd=source,
        env={"SOURCE_DATE_EPOCH": "1700000000", "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return source / "dist" / done.stdout.splitlines()[-1]


def _sha256(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.slow
def test_two_builds_are_the_same_and_bring_what_they_should(tmp_path):
    sources = [tmp_path / "one", tmp_path / "elsewhere" / "other"]
    for source, mode in zip(sources, (0o644, 0o664), strict=True):
        shutil.copytree(
            ROOT, source, symlinks=True, ignore=NOT_TRACKED, copy_function=shutil.copyfile
        )
        for path in source.rglob("*.*"):
            if path.is_file():
                path.chmod(mode)  # as umasks of two people leave it
    packed = [_built("sdist", source) for source in sources]
    assert _sha256(packed[0]) == _sha256(packed[1])

    trees = []
    for k, archive in enumerate(packed):
        with tarfile.open(archive) as tar:
            tar.extractall(tmp_path / f"unpacked{k}", filter="data")
        (tree,) = (tmp_path / f"unpacked{k}").iterdir()
        trees.append(tree)
    names = {path.relative_to(sources[0]) for path in sources[0].rglob("*") if path.is_file()}
    brought = {path.relative_to(trees[0]) for path in trees[0].rglob("*")}
    built = {name for name in names if name.parts[0] in ("dist", "hilcal.egg-info")}
    assert names - built - brought == set()  # also what the tests need

    wheels = [_built("wheel", tree) for tree in trees]
    assert _sha256(wheels[0]) == _sha256(wheels[1])
    installed = tmp_path / "installed"
    with zipfile.ZipFile(wheels[0]) as wheel:
        wheel.extractall(installed)
    assert {path.name for path in installed.iterdir()} == {"hilcal", f"{NAME}.dist-info"}
    for top in ("hilcal", "drivers", "configs"):
        files = [path for kind in ("*.py", "*.toml") for path in (ROOT / top).rglob(kind)]
        target = installed / top if top == "hilcal" else installed / "hilcal" / top
        assert all((target / path.relative_to(ROOT / top)).is_file() for path in files)
    script = (
        "from hilcal.robot.catalogue import configs_dir, load_arm, robot_names\n"
        "print(configs_dir(), len([load_arm(name) for name in robot_names()]),"
        " (configs_dir() / 'cells' / 'demo_ur10e.toml').is_file())"
    )
    answer = subprocess.run(
        [sys.executable, "-c", script],
        env={"PYTHONPATH": str(installed)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    robots = len(list((ROOT / "configs" / "robots").glob("*.toml")))
    assert answer.stdout.split() == [str(installed / "hilcal" / "configs"), str(robots), "True"]


@pytest.mark.slow
@pytest.mark.parametrize("home", ["", "https://example.org/hilcal"])
def test_the_address_of_the_project_is_one_setting(home, tmp_path):
    source = tmp_path / "source"
    shutil.copytree(ROOT, source, symlinks=True, ignore=NOT_TRACKED)
    settings = (source / "pyproject.toml").read_text(encoding="utf-8")
    (source / "pyproject.toml").write_text(
        re.sub('^home = ".*"', f'home = "{home}"', settings, flags=re.M)
    )
    with zipfile.ZipFile(_built("wheel", source)) as wheel:
        (name,) = [name for name in wheel.namelist() if name.endswith("/METADATA")]
        head = wheel.read(name).decode().split("\n\n")[0]
    addresses = [line for line in head.splitlines() if "://" in line]
    assert addresses == ([f"Project-URL: Homepage, {home}"] if home else [])
    assert "Author: hilcal developers" in head
    assert f"Version: {hilcal.__version__}" in head
