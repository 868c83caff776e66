"""A lab with a KUKA and a measured table: from the table to corrected KRL points.

The arm that was measured has links that are some tenths of a millimetre and milliradian off. Its
corrected program, as other eyes read it, is executed as a controller does: by the nominal arm's
inverse kinematics, which the arm that was measured then follows.
"""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilcal.calibration.points import solutions
from hilcal.robot import se3
from hilcal.robot.chain import evaluate
from hilcal.robot.se3 import of_six
from hilcal.robot.urdf import arm_from_urdf
from tests.support.cli_cases import ok, refused
from tests.support.maker_arms import EXAMPLES, maker_arm
from tests.support.paths import ROOT

TOOL = np.array([0.1205, -0.0032, 0.21])  # the reflector at the tool's centre point
POSES = 60
GUIDE = ROOT / "docs" / "how-to" / "correct-a-program.md"
SEEN = se3.matrix(se3.rotation(np.array([0.02, -0.03, 2.1])), np.array([2.4, -1.6, -0.5]))
"""The arm's base as the tracker stands to it."""


def flanges(arm, q):
    chain = evaluate(arm, q)
    return se3.matrix(chain.rotation[-1], chain.position[-1])


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """The table, the nominal arm, and the arm as it is."""
    folder, rng = tmp_path_factory.mktemp("lab"), np.random.default_rng(3)
    nominal = maker_arm("krl", folder)
    (folder / "krl.urdf").rename(folder / "kuka.urdf")
    for name in ("weld.src", "weld.dat", "config.dat"):
        shutil.copy(EXAMPLES / name, folder)
    off = se3.matrix(*se3.exp(3e-4 * rng.standard_normal((7, 6))))
    off[[0, -1]] = np.eye(4)
    true = replace(nominal, links=nominal.links @ off)
    low, high = (
        np.radians([-60, -110, 60, -180, -80, -210]),
        np.radians([60, -30, 120, 60, 80, 170]),
    )
    q = low + rng.random((POSES, 6)) * (high - low)
    target_poses = SEEN @ flanges(true, q) @ se3.matrix(np.eye(3), TOOL)
    at = target_poses[:, :3, 3] + 1e-5 * rng.standard_normal((POSES, 3))
    lines = ["Punkt;A1;A2;A3;A4;A5;A6;X [mm];Y [mm];Z [mm]"]
    for k in range(POSES):
        numbers = [f"{v:.5f}" for v in (*np.degrees(q[k]), *(1e3 * at[k]))]
        lines.append(";".join([f"P{k}", *numbers]).replace(".", ","))
    (folder / "faro.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (cell,) = re.findall(r"^```toml\n(\[robot\].*?)^```$", GUIDE.read_text(), re.M | re.S)
    (folder / "CELL.toml").write_text(cell, encoding="utf-8")
    return folder, nominal, true


@pytest.mark.long
def test_the_guide_leads_from_a_table_to_corrected_krl_points(lab, capsys, monkeypatch):
    folder, nominal, true = lab
    monkeypatch.chdir(folder)
    (folder / "corrected").mkdir()
    (lines,) = re.findall(r"^```sh\n(.*?)^```$", GUIDE.read_text(), re.M | re.S)
    *first, last = [line.split()[1:] for line in lines.splitlines()]
    for arguments in first:
        ok(capsys, *arguments)
    without = [word for word in last if word not in ("--frames", "config.dat")]
    assert "TOOL_DATA[1] is not in the program; give it by --frames" in refused(capsys, 2, *without)
    assert not list(Path("corrected").iterdir())
    document = ok(capsys, *last, "--json").document
    assert [w["done"] for w in document["waypoints"]] == ["corrected"] * 7
    assert sorted(document["written"]) == ["corrected/weld.dat", "corrected/weld.src"]
    assert sorted(p.name for p in Path("corrected").iterdir()) == ["weld.dat", "weld.src"]
    assert "--force" in refused(capsys, 2, *last)
    base, tool = pose([800, -200, 150, 30, 0, 0]), pose([120.5, -3.2, 210, 10, 20, -30])
    before, after = points(Path("weld.dat")), points(Path("corrected/weld.dat"))
    to_base = se3.inverse(of_six(document["base_in_tracker"])) @ SEEN
    errors = []
    for name, frame in (("XP1", base), ("XP2", base), ("XP3", np.eye(4))):
        asked, commanded = frame @ before[name], frame @ after[name]
        near = next(
            np.array(p["q_command"]) for p in document["points"] if p["name"].startswith(name)
        )
        reached = [
            to_base @ flanges(true, solutions(nominal, tool, near[None], goal))[0] @ tool
            for goal in (asked, commanded)
        ]
        errors.append([np.linalg.norm((r - asked)[:3, 3]) for r in reached])
    was, now = np.array(errors).T
    assert was.min() > 3e-4
    assert np.all(now < [p["band_m"] for p in document["points"][:3]])
    assert now.max() < 0.1 * was.min()
    text = Path("corrected/weld.src").read_bytes().decode("latin-1")
    assert "; geprüft:" in text
    assert text.count("\r\n") == Path("weld.src").read_bytes().count(b"\r\n")


def test_into_the_labs_own_urdf(lab, capsys):
    """The same table: the URDF that the cell names, corrected, is the arm that was measured."""
    folder, _, true = lab
    run, user_file, cell = folder / "into.hilcal", folder / "mine.urdf", folder / "BASE.toml"
    stated = (
        'frame = "tracker"\nbase_xyz_m = [2.4, -1.6, -0.5]\nbase_rotvec_rad = [0.02, -0.03, 2.1]'
    )
    text = (folder / "CELL.toml").read_text()
    cell.write_text(text.replace('frame = "tracker"', stated), encoding="utf-8")
    more = ("--config", cell, "--preview", "-o", folder / "into.toml")
    ok(capsys, "import", folder / "faro.csv", *more)
    more = ("--config", cell, "--format", folder / "into.toml", "-o", run)
    ok(capsys, "import", folder / "faro.csv", *more)
    ok(capsys, "identify", run, "--effects", "link_geometry")
    text = f"<!-- bay 3 -->{(folder / 'kuka.urdf').read_text()}"
    user_file.write_text(text)
    assert "mine.urdf: the file exists" in refused(capsys, 2, "export", run, "--into", user_file)
    assert user_file.read_text() == text
    shown = ok(
        capsys, "export", run, "--into", user_file, "--matlab", folder / "arm.m", "--force"
    ).out
    assert "7 places changed (j1, j2, j3, j4, j5, j6, flange)" in " ".join(shown.split())
    assert user_file.read_text().startswith("<!-- bay 3 -->")
    assert (folder / "arm.m").read_text().startswith("function robot = arm()")
    q = np.radians([[10, -70, 100, 20, -60, 30], [-20, -80, 110, 15, 50, 160]])
    made = flanges(arm_from_urdf(user_file), q) @ se3.matrix(np.eye(3), TOOL)
    there = flanges(true, q) @ se3.matrix(np.eye(3), TOOL)
    assert np.linalg.norm((made - there)[:, :3, 3], axis=1).max() < 6e-5
    for given, words in (
        (("--urdf", folder / "n.urdf", "--tip-link", "x"), "--tip-link needs --into"),
        (("--into", folder / "no.urdf"), "no.urdf: no such file; valid: a URDF"),
        (
            ("--into", user_file, "--force", "--tip-link", "x"),
            "link 'x' is there 0 times; valid: base",
        ),
        (("--matlab", folder / "1.m"), "valid: a name that MATLAB calls"),
    ):
        assert words in refused(capsys, 2, "export", run, *given)


def pose(values):
    turn = Rotation.from_euler("ZYX", values[3:], degrees=True).as_matrix()
    return se3.matrix(turn, 1e-3 * np.array(values[:3]))


def points(path):
    """Points of a .dat file, as other eyes have them."""
    text = path.read_bytes().decode("latin-1")
    matches = re.findall(
        r"E6POS (\w+)=\{X (\S+?),Y (\S+?),Z (\S+?),A (\S+?),B (\S+?),C (\S+?),", text
    )
    return {name: pose([float(v) for v in values]) for name, *values in matches}
