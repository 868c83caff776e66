"""Programs of four makers: points are where Pinocchio and SciPy have them, all other text stays.

The examples were written after the makers' published syntax. Their Cartesian numbers are of
Pinocchio's forward kinematics of `Q`, with SciPy's rotations.
"""

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from hilcal.calibration.programs.fanuc_inform import INFORM, LS
from hilcal.calibration.programs.krl import KRL
from hilcal.calibration.programs.languages import flags_of, form_mismatch, read_program, resolve
from hilcal.calibration.programs.program import UNSTATED, Language, Program, ProgramPoint
from hilcal.calibration.programs.rapid import RAPID
from hilcal.errors import InputError
from hilcal.robot import se3
from hilcal.robot.catalogue import load_arm
from hilcal.robot.chain import evaluate
from hilcal.types import Floats
from tests.support.maker_arms import EXAMPLES, maker_arm, urdf_of
from tests.support.refusals import check, refusal, refusals
from tests.support.rows import first

DELTA = 1e-3 * np.array([0.7, -0.4, 0.9, -1.1, 0.5, -0.8])


def place(kind, values):
    """A pose in mm by SciPy: "ZYX" and "xyz" angles in degrees, or a quaternion, w first."""
    turn = (
        Rotation.from_quat(np.roll(values[3:], -1))
        if kind == "wxyz"
        else Rotation.from_euler(kind, values[3:], degrees=True)
    )
    return se3.matrix(turn.as_matrix(), 1e-3 * np.array(values[:3]))


@dataclass(frozen=True)
class Example:
    """A program, the joint values that it means, and one of its poses for other eyes."""

    file: str
    frames: str | None
    language: Language
    q: tuple[tuple[float, ...], ...]
    kind: str
    pose: str
    at: int
    frame: Floats
    tool: Floats
    atol: float


EXAMPLE = {
    "krl": Example(
        "weld.src",
        "config.dat",
        KRL,
        (
            (10, -70, 100, 20, -60, 30),
            (-20, -80, 110, 15, 50, 160),  # on a straight line T = 35 is not looked at
            (25, -60, 95, -170, 40, 100),
            (5, -75, 100, 10, 60, 0),
            (12, -72, 102, 18, -58, 28),
            (14, -74, 104, 16, -56, 26),
            (14, -74, 104, 16, -56, 26),
        ),
        "ZYX",
        r"XP1=\{X (\S+),Y (\S+),Z (\S+),A (\S+),B (\S+),C ([^,]+),",
        0,
        place("ZYX", [800, -200, 150, 30, 0, 0]),
        place("ZYX", [120.5, -3.2, 210, 10, 20, -30]),
        1e-8,
    ),
    "rapid": Example(
        "weld.mod",
        None,
        RAPID,
        (
            (0, -10.5, 20, 0, 30, 0),
            (10, 20, 15, 30, 40, -100),
            (-15, 25, 5, -20, -50, 170),
            (4.9999999, 8.043691, 14.6296544, 0.4466837, 52.3264061, 0.3305581),  # Offs
            (5, 10, 20, 0.5, 45, 0.25),
            (2.6023405, 11.0143368, 12.9875339, 6.1665176, 52.3497838, -20.5280617),  # RelTool
            (7, 12, 18, 10, 45, 5),
        ),
        "wxyz",
        r"p10:=\[\[(\S+?),(\S+?),(\S+?)\],\[(\S+?),(\S+?),(\S+?),(\S+?)\]",
        1,
        place("wxyz", [300, 50, 100, 0.5**0.5, 0, 0, 0.5**0.5])
        @ place("xyz", [10, -20, 30, 0, 0, 0]),
        place("wxyz", [0, 20, 150, 0.9659258262890683, 0, 0.25881904510252074, 0]),
        1e-8,
    ),
    "fanuc": Example(
        "weld.ls",
        "fanuc.toml",
        LS,
        (
            (10, 20, -15, 30, -60, 40),
            (-12, 25, -20, 20, -50, -30),
            (20, 15, -25, -40, 55, 100),
            (0, -10.5, 15, 0, -75, 0),
        ),
        "xyz",
        r"P\[1\]\{[^}]*?X =\s*(\S+)\s*mm,\s*Y =\s*(\S+)\s*mm,\s*Z =\s*(\S+)\s*mm,"
        r"\s*W =\s*(\S+)\s*deg,\s*P =\s*(\S+)\s*deg,\s*R =\s*(\S+)\s*deg",
        0,
        place("xyz", [400, 100, -50, 0, 0, 35]),
        place("xyz", [15, -8, 120, 5, -10, 20]),
        1e-5,
    ),
    "inform": Example(
        "weld.jbi",
        "yaskawa.toml",
        INFORM,
        (
            (0, -5, 10, 0, -70, 0),
            (15, 10, -20, 25, -60, 40),
            (-10, 15, -15, -30, -55, 60),
            (20, 12, -18, 120, 60, -40),
            (22, 14, -20, 118, 62, -42),
        ),
        "xyz",
        r"C00001=(\S+?),(\S+?),(\S+?),(\S+?),(\S+?),(\S+)",
        1,
        place("xyz", [350, -100, 20, 0, 0, -20]),
        place("xyz", [0, 30, 140, 0, 15, 0]),
        3e-6,
    ),
}


@pytest.fixture(scope="session")
def arms(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arms")
    return {maker: maker_arm(maker, folder) for maker in EXAMPLE}


@cache
def flange(maker, q):
    """Pose of the flange by Pinocchio."""
    model = pin.buildModelFromXML(urdf_of(maker))
    data = model.createData()
    pin.framesForwardKinematics(model, data, np.array(q))
    return np.array(data.oMf[model.getFrameId("tool0")].homogeneous)


def read(maker, arms, folder=EXAMPLES, **more):
    e = EXAMPLE[maker]
    frames = None if e.frames is None else EXAMPLES / e.frames
    return read_program(folder / e.file, arms[maker], frames=frames, **more)


def copied(maker, folder, change):
    """Write the example, all of its files changed."""
    stem = EXAMPLE[maker].file.partition(".")[0]
    suffixes = (".src", ".dat") if maker == "krl" else (Path(EXAMPLE[maker].file).suffix,)
    for suffix in suffixes:
        text = (EXAMPLES / f"{stem}{suffix}").read_bytes().decode("latin-1")
        (folder / f"{stem}{suffix}").write_bytes(change(text).encode("latin-1"))


@pytest.fixture(scope="module")
def examples(arms):
    """Each maker's example, read."""
    return {maker: read(maker, arms) for maker in EXAMPLE}


@pytest.mark.parametrize("maker", EXAMPLE)
def test_points_are_where_pinocchio_has_them(maker, examples):
    q = np.degrees(examples[maker].q)
    # numbers of three decimals leave that much near a singular wrist
    np.testing.assert_allclose(q, EXAMPLE[maker].q, atol=1e-3)


@pytest.mark.parametrize("ends", first(1, ["\r\n", "\n"]))
@pytest.mark.parametrize("maker", EXAMPLE)
def test_without_a_correction_every_byte_stays(maker, ends, arms, tmp_path):
    copied(maker, tmp_path, lambda text: text.replace("\r\n", ends))
    resolved = read(maker, arms, tmp_path)
    noise = 1e-11 * np.random.default_rng(0).standard_normal(resolved.q.shape)
    for suffix, content in resolved.corrected(resolved.q + noise).items():
        assert content == (tmp_path / f"weld{suffix}").read_bytes()


@pytest.mark.parametrize(("maker", "head"), [("krl", "DEF weld"), ("rapid", "MODULE Weld")])
def test_a_program_that_begins_with_a_byte_order_mark_is_not_corrected_twice(
    maker, head, arms, tmp_path
):
    copied(maker, tmp_path, lambda t: t[max(t.find(head), 0) :].replace("PROC", "TRAP"))
    path = tmp_path / EXAMPLE[maker].file
    path.write_text(f"\ufeff{path.read_text('latin-1')}", encoding="utf-8", newline="")
    resolved = read(maker, arms, tmp_path)
    path.write_bytes(resolved.corrected(resolved.q + DELTA)[path.suffix])
    refusal(r"line 1: it is corrected already", read, maker, arms, tmp_path)


@pytest.mark.parametrize("maker", EXAMPLE)
def test_a_corrected_program_means_the_corrected_joint_values(maker, arms, examples, tmp_path):
    """By its own reading, and one pose by other eyes: a pattern, SciPy and Pinocchio."""
    e, resolved = EXAMPLE[maker], examples[maker]
    wanted = resolved.q + DELTA
    numbers = re.compile(r"(?<![A-Za-z\d])[-+]?\s*(\d+\.?\d*|\.\d+)(E\+?\d+)?")
    for suffix, content in resolved.corrected(wanted).items():
        (tmp_path / f"weld{suffix}").write_bytes(content)
        old = (EXAMPLES / f"weld{suffix}").read_bytes().decode("latin-1").split("\r\n")
        text = content.decode("latin-1")
        assert text.count("corrected by hilcal") == (suffix != ".dat")
        if suffix != ".dat":
            refusal(r"line \d+: it is corrected already", read, maker, arms, tmp_path)
        mark = r"  [;!] corrected by hilcal|(  11:  !|')corrected by hilcal( ;)?\r\n"
        text = re.sub(mark, "", text)
        (tmp_path / f"weld{suffix}").write_bytes(text.encode("latin-1"))
        new = text.split("\r\n")
        assert len(old) == len(new)
        for a, b in zip(old, new, strict=True):
            if "Offs(" not in a and "RelTool(" not in a:
                assert re.sub(r"\s", "", numbers.sub("0", a)) == re.sub(
                    r"\s", "", numbers.sub("0", b)
                )
        changed = [a for a, b in zip(old, new, strict=True) if a != b]
        assert len(changed) == {"src": 3, "dat": 4, "mod": 7, "ls": 8, "jbi": 5}[suffix[1:]]
        if m := re.search(e.pose, "\n".join(new)):
            pose = e.frame @ place(e.kind, [float(v) for v in m.groups()]) @ se3.inverse(e.tool)
            there = flange(maker, tuple((np.radians(e.q[e.at]) + DELTA).tolist()))
            np.testing.assert_allclose(pose, there, atol=10 * e.atol)
    again = read(maker, arms, tmp_path)
    np.testing.assert_allclose(again.q, wanted, atol=3e-5 if maker in ("fanuc", "inform") else 1e-7)


def test_offs_and_reltool_move_as_abb_defines_them():
    """Offs in the object frame; RelTool in the tool's: about x, the new y, the new z."""
    e = EXAMPLE["rapid"]
    offs, p30, relative = (
        se3.inverse(e.frame) @ flange("rapid", tuple(np.radians(e.q[k]).tolist())) @ e.tool
        for k in (3, 4, 5)
    )
    np.testing.assert_allclose(offs[:3, 3] - p30[:3, 3], [0, 0, 0.04], atol=1e-7)
    np.testing.assert_allclose(offs[:3, :3], p30[:3, :3], atol=1e-7)
    step = place("XYZ", [5, 0, -30, 4, 0, -15])
    np.testing.assert_allclose(relative, p30 @ step, atol=1e-7)


@pytest.mark.parametrize("maker", first(1, list(EXAMPLE)))
@pytest.mark.long
def test_flags_tell_every_branch_and_turn(maker, arms):
    arm, language = arms[maker], EXAMPLE[maker].language
    assert form_mismatch(arm, language) == ""
    q = np.random.default_rng(5).uniform(0.9 * arm.q_min, 0.9 * arm.q_max, (12, 6))
    q[:, 4] = np.where(np.abs(q[:, 4]) < 0.2, 0.5, q[:, 4])
    chain = evaluate(arm, q)
    poses = se3.matrix(chain.rotation[-1], chain.position[-1])
    near = np.array([0, 0, 0, 1, 0, 0, 0]) if maker == "rapid" else np.zeros(6)
    points = tuple(
        ProgramPoint(k, f"{k}", values=language.numbers(pose, near), flags=tuple(flags.tolist()))
        for k, (pose, flags) in enumerate(zip(poses, flags_of(arm, language, q), strict=True))
    )
    joint_values, doubts, said = resolve(Program(language, (), (), points), arm, None)
    assert not any(doubts)
    assert not said
    np.testing.assert_allclose(joint_values, q, atol=1e-6)


def test_a_joint_that_passes_zero_changes_its_turn(examples):
    krl = examples["krl"]
    q = krl.q.copy()
    q[0, 3], q[2, 0] = -0.01, -0.02  # joint 4 of XP1, joint 1 of XP3
    dat = krl.corrected(q)[".dat"].decode("latin-1")
    assert re.search(r"XP1=.*,S 2,T 26,E1", dat)  # 18 + 8
    assert re.search(r"XP3=.*,S 'B010',T 11\}", dat)  # 10 + 1
    rapid = examples["rapid"]
    q = rapid.q.copy()
    q[1, 5] = np.radians(-89.9)  # from quadrant -2 to -1
    assert re.search(r"p10:=.*\],\[0,0,-1,0\],\[9E9", rapid.corrected(q)[".mod"].decode())
    inform = examples["inform"]
    q = inform.q.copy()
    q[3, 3] = np.radians(89.0)  # no flip becomes flip
    refusal(r"C00003 \(line 17\): .* another configuration", inform.corrected, q)


@refusals("makers")
def test_what_is_not_understood_is_refused_by_line(case, given, arms, tmp_path):
    """A maker, what stands in its example, and what is written in its place."""
    maker, old, new = given.split("\n")[:3]
    copied(maker, tmp_path, lambda text: text.replace(old, new.replace("<new line>", "\r\n")))
    with pytest.raises(InputError) as error:
        read(maker, arms, tmp_path)
    check(case, str(error.value).replace(f"{tmp_path}/", ""))


@pytest.mark.parametrize(
    ("maker", "old", "new", "left"),
    [
        ("krl", "gripper_open( )", "PTP_REL {A1 5}", ["line 31"]),
        ("krl", "LIN XP2 C_DIS", "LIN XP2:XP3 C_DIS", ["line 28", "XP3 (weld.dat line 12)"]),
        ("rapid", "Offs(p30,0,0,40)", "Offs(p30,0,0,z)", ["line 19", "p30 (line 8)"]),
        ("fanuc", "CNT100    ;", "CNT100 Offset,PR[1]    ;", ["P[2] (line 25)"]),
        ("fanuc", "X =    -2.992", "X =  9000.000", ["P[1] (line 19)"]),  # out of reach
    ],
)
def test_what_is_left_and_all_that_it_counts_from_stay_as_they_are(
    maker, old, new, left, arms, tmp_path
):
    copied(maker, tmp_path, lambda text: text.replace(old, new))
    resolved = read(maker, arms, tmp_path, leave=True)
    assert [p.name for p in resolved.program.points if p.not_corrected] == left
    for suffix, content in resolved.corrected(resolved.q + DELTA).items():
        before = (tmp_path / f"weld{suffix}").read_bytes().split(b"\r\n")
        for p in resolved.program.points:
            if p.not_corrected and (p.name.startswith("line") != (suffix == ".dat")):
                assert content.split(b"\r\n")[p.line - 1] == before[p.line - 1]


def test_tool_and_base_of_a_spline_block_hold_within_it_alone(arms, tmp_path):
    """Its header sets them for its points; a tool outside of the arm is refused there, too."""

    def weld(statements):
        lines = "\r\n".join(statements)
        copied("krl", tmp_path, lambda t: t.replace("LIN XP2 C_DIS C_DIS", lines))
        points = read("krl", arms, tmp_path, leave=True).program.points
        return next(p for p in points if p.name.startswith("XP2"))

    for word in ("SPLINE", "PTP_SPLINE"):
        block = [f"{word} WITH $BASE = $NULLFRAME", "SPL XP2", "ENDSPLINE"]
        np.testing.assert_array_equal(weld(block).frame, np.eye(4))
        assert "another tool or base" in weld([*block, "LIN XP2"]).not_corrected
    outer = ["SPLINE WITH $IPO_MODE = #TCP", *block[1:]]
    refusal(r"\$IPO_MODE = #TCP' changes what points mean", weld, outer)


def test_frames_on_some_ways_only_are_not_known(arms, tmp_path):
    """What a branch or a loop sets is not taken for what holds behind it."""
    copied(
        "krl",
        tmp_path,
        lambda t: t.replace("PTP home1", "IF $IN[1] THEN\r\n$BASE = $NULLFRAME\r\nENDIF"),
    )
    refusal(
        "block that ends in line 39 sets them in some branches only", read, "krl", arms, tmp_path
    )
    copied(
        "krl",
        tmp_path,
        lambda t: t.replace("PTP home1", "LOOP").replace("$OUT[7]=TRUE", "BAS(#BASE,0)\r\nENDLOOP"),
    )
    refusal("the loop of line 37 sets them later", read, "krl", arms, tmp_path)


@pytest.mark.parametrize(
    ("statement", "changed", "left"),
    [
        ("BASE_DATA[2].X = 500.0", "BASE_DATA[2]", ["XP1", "XP2", "line 39", "line 40"]),
        ("BASE_DATA[i].X = 500.0", "BASE_DATA[2]", ["XP1", "XP2", "line 39", "line 40"]),
        (
            "TOOL_DATA[ 1 ] = measured()",
            "TOOL_DATA[1]",
            ["XP1", "XP2", "XP3", "line 39", "line 40"],
        ),
        ("FP2.BASE_NO = 3", "FP2", ["XP2"]),
        ("TOOL_DATA[3].X = 5.0", "", []),
    ],
)
def test_points_of_a_frame_that_the_program_changes_are_left(
    statement, changed, left, arms, tmp_path
):
    copied("krl", tmp_path, lambda t: t.replace("PTP XP1", f"PTP XP1\r\n{statement}"))
    uncorrected = [
        p for p in read("krl", arms, tmp_path, leave=True).program.points if p.not_corrected
    ]
    assert [p.name.partition(" (")[0] for p in uncorrected] == left
    assert all(p.not_corrected.endswith(f"changes {changed}") for p in uncorrected)


def test_a_base_that_the_program_sets_after_its_use_is_unknown(arms, tmp_path):
    values = "BASE_DATA[5]={X 1,Y 2,Z 3,A 0,B 0,C 0}"
    copied(
        "krl", tmp_path, lambda t: t.replace("PTP home1", f"BAS(#BASE,5)\r\nPTP home1\r\n{values}")
    )
    points = read("krl", arms, tmp_path, leave=True).program.points
    left = {p.not_corrected for p in points if p.not_corrected}
    assert left == {"line 39 sets BASE_DATA[5], after its use"}


def test_a_frame_of_the_program_is_a_base_and_no_point(arms, tmp_path):
    numbers = "{X 800,Y -200,Z 150,A 30,B 0,C 0}"
    lines = f"DECL INT i\r\nDECL FRAME table={numbers}"
    copied(
        "krl", tmp_path, lambda t: t.replace("DECL INT i", lines).replace("BASE_DATA[2]", "table")
    )
    assert not any(p.not_corrected for p in read("krl", arms, tmp_path).program.points)


def test_a_form_that_is_written_into_the_program_replaces_the_one_before(arms, tmp_path):
    form = "FDAT_ACT={TOOL_NO 1,BASE_NO 3,IPO_FRAME #BASE}"
    copied("krl", tmp_path, lambda t: t.replace("FDAT_ACT=FP2", form))
    points = read("krl", arms, tmp_path, leave=True).program.points
    (left,) = [p for p in points if p.not_corrected]
    assert left.name.startswith("XP2")


def test_a_base_that_the_program_sets_is_not_that_of_the_frames_file(arms, tmp_path):
    copied(
        "krl", tmp_path, lambda t: t.replace("PTP XP1", "BASE_DATA[2]={X 1,Y 2,Z 3,A 0,B 0,C 0}")
    )
    frames = tmp_path / "frames.toml"
    frames.write_text("tools.1 = [0, 0, 100, 0, 0, 0]\nbases.2 = [800, -200, 150, 30, 0, 0]\n")
    points = read_program(tmp_path / "weld.src", arms["krl"], frames=frames, leave=True)
    (xp2,) = [p for p in points.program.points if p.name.startswith("XP2")]
    assert xp2.not_corrected == "line 20 sets BASE_DATA[2], which --frames states, too"


def test_an_arm_of_another_form_has_its_branches_from_the_point_before(tmp_path):
    """A UR arm: no spherical wrist, so that S and cfx are not read, and that is said."""
    arm = load_arm("ur10e")
    q = np.radians([[0, -80, 100, -110, -90, 10], [5, -85, 105, -108, -88, 12]])
    chain = evaluate(arm, q)
    poses = se3.matrix(chain.rotation[-1], chain.position[-1])
    points = tuple(
        ProgramPoint(k + 1, f"line {k + 1}", values=KRL.numbers(pose, np.zeros(6)), flags=flags)
        for k, (pose, flags) in enumerate(
            zip(poses, [(0, 1, *(UNSTATED,) * 6), (1, 0, *(UNSTATED,) * 6)], strict=True)
        )
    )
    program = Program(KRL, (), (), points)
    joint_values, doubts, said = resolve(program, arm, q[0] + 0.05)
    assert not any(doubts)
    np.testing.assert_allclose(joint_values, q, atol=1e-8)
    assert (
        "2 points state a shape of the arm, which is defined only for KRL arms of the usual form"
        in said[0]
    )
    assert "give --near" in resolve(program, arm, None)[1][0]


@pytest.mark.parametrize("b", [90.0, -90.0, 89.99999, 90.0 - 1e-9, 0.0])
@pytest.mark.parametrize("language", [KRL, LS])
def test_angles_are_those_that_were_there_at_every_pitch(language, b):
    given = np.array([100.0, 200.0, 300.0, 170.0, b, -175.0])
    pose = language.pose(given)
    numbers = language.numbers(pose, given)
    np.testing.assert_allclose(language.pose(numbers), pose, atol=1e-12)
    if b == 0.0:
        np.testing.assert_allclose(numbers, given, atol=1e-9)
    turned = pose @ se3.matrix(se3.rotation(np.array([1e-3, 2e-3, -1e-3])), np.zeros(3))
    near = language.numbers(turned, given)
    np.testing.assert_allclose(language.pose(near), turned, atol=1e-12)
    kind = "ZYX" if language is KRL else "xyz"
    np.testing.assert_allclose(place(kind, near.tolist()), turned, atol=1e-12)
