"""What is installed is what is in the tree."""

import ast
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_every_directory_with_code_is_a_package() -> None:
    modules = [path for top in ("hilcal", "drivers") for path in (ROOT / top).rglob("*.py")]
    missing = {path.parent for path in modules if not (path.parent / "__init__.py").is_file()}
    assert not missing  # setup.py would leave them out


def test_a_class_has_a_name_of_its_own() -> None:
    """In the whole tree, so that a reader finds it by its name alone."""
    places: dict[str, list[str]] = {}
    for top in ("hilcal", "drivers"):
        for path in (ROOT / top).rglob("*.py"):
            for node in ast.parse(path.read_text(encoding="utf-8")).body:
                if isinstance(node, ast.ClassDef):
                    places.setdefault(node.name, []).append(str(path.relative_to(ROOT)))
    assert {name: at for name, at in places.items() if len(at) > 1} == {}


def test_the_lock_pins_every_dependency_with_hashes_and_names_no_host() -> None:
    text = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    entries = [line for line in text.splitlines() if line and not line.startswith(("#", " "))]
    assert all("==" in entry and entry.endswith("\\") for entry in entries)
    assert "://" not in text
    assert "--index" not in text
    pinned = {entry.split("==")[0].lower() for entry in entries}
    project = PROJECT["project"]
    wanted = [*project["dependencies"], *project["optional-dependencies"]["dev"]]
    for requirement in [*wanted, *PROJECT["build-system"]["requires"]]:
        name = requirement.replace("=", ">").replace("<", ">").split(">")[0].strip().lower()
        assert name in pinned


@pytest.mark.slow
def test_a_built_wheel_brings_its_configurations(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    source = tmp_path / "source"
    source.mkdir()
    for name in (
        "setup.py",
        "pyproject.toml",
        "README.md",
        "LICENSE",
        "configs",
        "hilcal",
        "drivers",
    ):
        subprocess.run(["cp", "-r", ROOT / name, source], check=True)
    subprocess.run([*command, "--wheel-dir", tmp_path, source], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    installed = tmp_path / "installed"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(installed)
    for top in ("hilcal", "drivers", "configs"):
        files = [path for kind in ("*.py", "*.toml") for path in (ROOT / top).rglob(kind)]
        target = installed / "hilcal" / "configs" if top == "configs" else installed / top
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
    assert answer.stdout.split() == [str(installed / "hilcal" / "configs"), "9", "True"]
