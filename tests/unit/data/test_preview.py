"""The guess of a mapping: for typical files it is the mapping that a person would write."""

from datetime import datetime, timedelta

import numpy as np
import pytest

from hilcal.tables.files import decoded, guessed_encoding, open_grid
from hilcal.tables.mapped import seconds
from hilcal.tables.mapping import Mapping, load_mapping
from hilcal.tables.propose import propose
from hilcal.toml import check_section, read_toml
from tests.support.foreign_tables import campaign, lines, write
from tests.support.paths import ROOT
from tests.support.refusals import refusal

C = campaign()
N = len(C.q)
DEG = np.rad2deg(C.q)
MM = 1e3 * C.position
SIGMA = np.random.default_rng(1).uniform(0.01, 0.03, (N, 6))


POINTS = [f"P{k}" for k in range(N)]


def six(name):
    """The names of six columns."""
    return [name.format(k) for k in range(1, 7)]


def german():
    header = ["Punkt", *six("Achse {} [°]"), *(f"Mess {e} [mm]" for e in "XYZ")]
    header += ["Zuladung", "Lufttemperatur [°C]", "Bemerkung"]
    loads = ["ohne" if k % 2 else "Gewicht 10" for k in range(N)]
    return lines(header, POINTS, DEG, MM, loads, 20 + 0.1 * np.arange(N), ["ä"] * N, comma=True)


def rtde():
    header = ["timestamp", *(f"{what}_q_{k}" for what in ("target", "actual") for k in range(6))]
    header += ["tracker_x", "tracker_y", "tracker_z", "payload"]
    mass = np.where(np.arange(N) % 2, 0.0, 5.0)
    return lines(header, 8.0 * np.arange(N), C.q, C.q + 1e-5, C.position, mass, separator=" ")


def with_units_row():
    header = ["Pose", *six("theta{}"), "MeasX", "MeasY", "MeasZ", "UncX", "UncY", "UncZ"]
    units = ["-", *["deg"] * 6, *["mm"] * 6]
    text = "# exported\n" + ",".join(header) + "\n" + ",".join(units) + "\n"
    return text + lines(None, POINTS, DEG, MM, SIGMA[:, :3], separator=",")


def expanded():
    header = ["id", *six("q{}_rad"), "x_m", "y_m", "z_m", "U95_x", "U95_y", "U95_z", "date"]
    start, u95 = datetime(2024, 5, 31, 8), 2e-3 * SIGMA[:, :3]
    stamps = [(start + timedelta(minutes=k)).strftime("%d.%m.%Y %H:%M:%S") for k in range(N)]
    return lines(header, np.arange(N), C.q, C.position, u95, stamps, separator=",", digits=8)


def forces():
    header = [*six("joint_{}"), *("x", "y", "z", "rx", "ry", "rz", "Fx", "Fy", "Fz")]
    header += ["Mx", "My", "Mz"]
    wrench = np.where(np.arange(N)[:, None] % 2, 0.0, 10.0) * np.ones(6)
    return lines(header, C.q, C.position, C.attitude.as_rotvec(), wrench, separator=",")


def thousands():
    text = ";".join([*six("J{}"), "X", "Y", "Z", ""]) + "\n"
    for q, p in zip(DEG, MM, strict=True):
        cells = [f"{v:.4f}" for v in q] + [f"{v:,.4f}" for v in p]
        text += ";".join(c.replace(",", "'") for c in cells) + ";\n"
    return text


def ros():
    header = ["Goal x", "Goal y", "Goal z", "shoulder_pan_joint", "shoulder_lift_joint"]
    header += ["elbow_joint", *(f"wrist_{k}_joint" for k in (1, 2, 3))]
    header += [f"measurement_{what}{e}" for e in ("x", "y", "z") for what in ("", "std_")]
    header += [f"measurement_{what}{e}" for e in ("rx", "ry", "rz") for what in ("", "std_")]
    pairs = np.stack([MM, SIGMA[:, :3]], axis=2).reshape(N, 6)
    turned = np.stack([C.angles("XYZ"), SIGMA[:, 3:]], axis=2).reshape(N, 6)
    return lines(header, C.position, C.q, pairs, turned, comma=True)


NUMBERS, QUATERNION = np.arange(1, N + 1), C.attitude.as_quat()[:, [3, 0, 1, 2]]
CASES = {
    "kuka": lines(
        ["Nr", *six("A{}"), *"XYZABC"], NUMBERS, DEG, MM, C.angles("ZYX"), separator="\t"
    ),
    "fanuc": lines(
        ["point", *"xyzwpr", *six("J{}")], NUMBERS, MM, C.angles("xyz"), DEG, separator=","
    ),
    "abb": lines(
        [*six("rax_{}"), *"xyz", "q1", "q2", "q3", "q4"], DEG, MM, QUATERNION, separator=","
    ),
    "without_header": lines(None, MM, DEG, separator=","),
    "numpy_savetxt": "# " + lines([*six("q{}"), *"xyz"], C.q, MM, separator=" ", digits=8),
    **{f.__name__: f() for f in (german, rtde, with_units_row, expanded, forces, thousands, ros)},
}
WANTED = read_toml(ROOT / "tests" / "data" / "mappings.toml")


@pytest.mark.parametrize("case", CASES)
def test_the_guess_is_the_mapping(case, tmp_path):
    encoding = "latin-1" if case == "german" else "utf-8"
    proposal = propose(write(tmp_path / "t.csv", CASES[case], encoding)).proposal
    expected = check_section(WANTED[case], Mapping, "wanted")
    assert proposal.mapping(Mapping).model_dump() == expected.model_dump()
    (tmp_path / "m.toml").write_text(proposal.to_toml("t.csv"))
    assert load_mapping(tmp_path / "m.toml", Mapping) == proposal.mapping(Mapping)


@pytest.mark.parametrize(
    ("text", "encoding", "guessed"),
    [
        ("位姿 关节1(度) x(毫米)", "gbk", "gb18030"),
        ("位姿 关节1(度) x(毫米)", "utf-8", "utf-8"),
        ("Größe in µm, 20 °C, Mañana déjà", "latin-1", "latin-1"),
        ("Größe – “Achse” in °, it’s 5–10 …", "cp1252", "cp1252"),
        ("測定点 関節1 座標x ﾌﾟﾗｽ", "cp932", "cp932"),
        ("x_mm", "ascii", "utf-8"),
    ],
)
def test_the_encoding_is_guessed(text, encoding, guessed):
    content = text.encode(encoding)
    assert guessed_encoding(content) == guessed
    assert decoded("t.csv", content, None) == text


def test_an_encoding_can_be_any_that_is_one(tmp_path):
    table = write(tmp_path / "t.csv", CASES["fanuc"].replace("point", "측정점"), "johab")
    mapping = {
        "file": {"encoding": "johab"},
        "pose": {"column": "측정점"},
        "joints": {"columns": six("J{}"), "unit": "deg"},
        "position": {"columns": [*"xyz"], "unit": "mm"},
    }
    stated = check_section(mapping, Mapping, "wanted")
    assert open_grid(table, stated.file).names[0] == "측정점"
    for name in ("gb99", "base64"):
        mapping["file"]["encoding"] = name
        refusal(f'encoding "{name}" is unknown', check_section, mapping, Mapping, "wanted")


def test_a_file_for_the_positions_and_one_for_the_joints(tmp_path):
    order = np.random.default_rng(0).permutation(N)
    write(tmp_path / "tracker.csv", lines(["Point", "X", "Y", "Z"], POINTS, MM, separator=","))
    shuffled = lines(["Name", *six("A{}")], [POINTS[k] for k in order], DEG[order], comma=True)
    write(tmp_path / "robot.csv", shuffled + "P999;0;0;0;0;0;0\n")
    proposed = propose(tmp_path / "tracker.csv", tmp_path / "robot.csv")
    second = proposed.proposal.mapping(Mapping).second_file
    assert (second.match, second.separator, second.decimal) == (("Point", "Name"), ";", ",")
    np.testing.assert_allclose(proposed.grid.numbers("A3"), DEG[:, 2], atol=1e-6)
    one = propose(tmp_path / "tracker.csv")
    assert one.proposal.missing == [
        "no joint angles: where they are in a file of their own, give it with --second"
    ]


def test_a_missing_point(tmp_path):
    p = MM.copy()
    p[3] = p[7] = -9999
    write(tmp_path / "t.csv", lines(["X", "Y", "Z", *six("A{}")], p, DEG))
    proposal = propose(tmp_path / "t.csv").proposal
    assert proposal.mapping(Mapping).file.missing == (-9999.0,)
    assert ("file", "-9999 stands for a missing point") in proposal.doubts


def test_lines_that_are_no_readings(tmp_path):
    text = "Tracker report\n\n" + lines([*six("A{}"), "X", "Y", "Z"], DEG, MM) + "end;of;file\n\n\n"
    proposed = propose(write(tmp_path / "t.csv", text))
    assert proposed.proposal.mapping(Mapping).file.header_row == 3
    assert len(proposed.grid.rows) == N
    assert any("are left out" in words for _, words in proposed.proposal.doubts)


def test_the_header_again_and_figures_of_all_rows_at_the_end(tmp_path):
    start = datetime(2024, 5, 28, 14)
    times = [(start + timedelta(hours=4 * k)).strftime("%d.%m.%Y %H:%M:%S") for k in range(N)]
    header = ["Nr", *six("A{}"), "X", "Y", "Z", "Zeit"]
    rows = lines(header, POINTS, DEG, MM, times, comma=True).splitlines()
    rows[10:10] = rows[:1]
    rows.append(";".join(["Mittel", *[""] * 6, "1,0", "2,0", "3,0", ""]))
    proposed = propose(write(tmp_path / "t.csv", "\n".join(rows)))
    assert proposed.proposal.mapping(Mapping).time.format == "%d.%m.%Y %H:%M:%S"
    assert ("file", f"rows 11 are left out: {NOT_READINGS}") in proposed.proposal.doubts


NOT_READINGS = "they repeat the header or are not of the table's length"


@pytest.mark.parametrize(("name", "section"), [
    ("Load [lbf]", {"hung_mass": {"column": "Load [lbf]", "unit": "lbf"}}),
    ("Weight (N)", {"hung_mass": {"column": "Weight (N)", "unit": "N"}}),
    ("mass_g", {"hung_mass": {"column": "mass_g", "unit": "g"}}),
    ("Fz [N]", {"wrench": {"columns": ["Fz [N]"], "unit": "N"}}),
])  # fmt: skip
def test_a_load_in_one_column_is_read_in_its_unit(name, section, tmp_path):
    load = np.where(np.arange(N) % 2, 0.0, 50.0)
    text = lines([*six("A{}"), "X", "Y", "Z", name], DEG, MM, load)
    sections = propose(write(tmp_path / "t.csv", text)).proposal.sections
    assert {k: v for k, v in sections.items() if k in ("hung_mass", "wrench", "load")} == section


@pytest.mark.parametrize(("angles", "from_zero"), [(DEG % 360, True), (DEG, False)])
def test_angles_counted_from_zero_are_noticed(angles, from_zero, tmp_path):
    text = lines([*six("A{}"), "X", "Y", "Z"], angles, MM)
    mapping = propose(write(tmp_path / "t.csv", text)).proposal.mapping(Mapping)
    assert mapping.joints.from_zero is from_zero


def test_columns_of_several_units_are_said_so(tmp_path):
    header = ["A1 [rad]", *six("A{} [deg]")[1:], "X [mm]", "Y [mm]", "Z [m]"]
    text = lines(header, C.q[:, :1], DEG[:, 1:], MM[:, :2], C.position[:, 2:])
    doubts = propose(write(tmp_path / "t.csv", text)).proposal.doubts
    convert = "a mapping has one unit, convert the others; all read as"
    assert ("joints", f"columns in rad, deg: {convert} deg") in doubts
    assert ("position", f"columns in mm, m: {convert} mm") in doubts


def test_distances_without_a_name_are_from_one_point(tmp_path):
    text = lines([*six("A{}"), "Bar length [mm]"], DEG, np.linalg.norm(MM, axis=1))
    distance = propose(write(tmp_path / "t.csv", text)).proposal.mapping(Mapping).distance
    assert (distance.column, distance.name, distance.unit) == ("Bar length [mm]", "A", "mm")


def test_a_force_of_unknown_direction_is_not_called_nameless(tmp_path):
    text = lines([*six("A{}"), "X", "Y", "Z", "Fx [N]"], DEG, MM, np.arange(N) * 1.5)
    unused = dict(propose(write(tmp_path / "t.csv", text)).proposal.unused)
    assert unused["Fx [N]"].startswith("a force; [wrench] takes")


def test_only_text(tmp_path):
    path = write(tmp_path / "t.csv", "name,colour\nbob,red\n")
    refusal("no columns of numbers", propose, path)


@pytest.mark.parametrize("name", ["enc{}", "J{}", "motor {} position", "axis{}_counts"])
def test_encoder_counts_are_recognised(name, tmp_path):
    per_turn = np.array([52428800, -52428800, 52428800, 10485760, -10485760, 10485760])
    counts = np.rint(C.q / (2 * np.pi) * per_turn).astype(int) + 12345
    header = ["Punkt", *six(name), "X [mm]", "Y [mm]", "Z [mm]"]
    text = lines(header, POINTS, counts, MM, separator=",")
    proposal = propose(write(tmp_path / "a.csv", text), joints=6).proposal
    assert "joints" not in proposal.sections
    assert "position" in proposal.sections
    (sentence,) = proposal.missing
    assert "look like encoder counts" in sentence
    assert "counts per turn" in sentence
    assert {why for _, why in proposal.unused} == {"looks like encoder counts"}


def test_angles_beside_encoder_counts_are_read(tmp_path):
    counts = np.rint(1e6 * C.q).astype(int)
    header = [*six("enc{}"), *six("q{} [°]"), "X [mm]", "Y [mm]", "Z [mm]"]
    text = lines(header, counts, DEG, MM, separator=",")
    proposal = propose(write(tmp_path / "a.csv", text), joints=6).proposal
    assert proposal.sections["joints"]["columns"] == six("q{} [°]")
    assert not proposal.missing


@pytest.mark.parametrize("names", [
    ("{}_des", "{}_real"), ("{} theor.", "{} mesuré"), ("X", "T{}"), ("理论{}", "实测{}"),
])  # fmt: skip
def test_commanded_positions_are_not_taken_for_measured_ones(names, tmp_path):
    nominal, measured = ([name.replace("X", "{}").format(e) for e in "XYZ"] for name in names)
    text = lines([*nominal, *six("A{}"), *measured], MM + 3.0, DEG, MM)
    proposal = propose(write(tmp_path / "t.csv", text)).proposal
    plain = names[1] == "T{}"  # the names do not tell: said
    assert proposal.sections["position"]["columns"] == (nominal if plain else measured)
    assert any("are used, not 'TX'" in words for _, words in proposal.doubts) is plain


@pytest.mark.parametrize("repeated", [False, True])
def test_names_over_several_columns_tell_those_of_one_name_apart(repeated, tmp_path):
    header = ["Nr", *six("A{}"), *"XYZ", *"XYZ"]
    over = [*[""] * 7, *["Nominal [mm]", *2 * ["Nominal [mm]" * repeated]]]
    over += ["Measured [mm]", *2 * ["Measured [mm]" * repeated]]
    text = ";".join(over) + "\n" + lines(header, POINTS, DEG, MM + 3.0, MM)
    mapping = propose(write(tmp_path / "t.csv", text)).proposal.mapping(Mapping)
    assert mapping.position.columns == tuple(f"Measured [mm] {e}" for e in "XYZ")
    assert (mapping.file.group_row, mapping.file.header_row) == (1, 2)


@pytest.mark.parametrize(("names", "figure", "section"), [
    (("sx", "sy", "sz"), 2.5, {"std": "um"}),
    (("sx", "sy", "sz"), 0.02, {"std": "mm"}),
    (("sx", "sy", "sz"), 2e-5, {"std": "m"}),
    (("sx_um", "sy_um", "sz_um"), 0.5, {"std": "um"}),
    (("sx [mm²]", "sy [mm²]", "sz [mm²]"), 4e-4, {"std": "mm"}),
    (("cov_xx [um^2]", "cov_xy [um^2]", "cov_xz [um^2]", "cov_yy [um^2]", "cov_yz [um^2]",
      "cov_zz [um^2]"), 4.0, {"covariance": "um"}),
    (("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz"), 4.0, {"covariance": "um"}),
    (("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz"), 4e-4, {"covariance": "mm"}),
    (("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz"), 4e-10, {"covariance": "m"}),
    (("Sxx", "Sxy", "Sxz", "Syy", "Syz", "Szz"), 4e-4, {"covariance": "mm"}),
    (("C11", "C12", "C13", "C22", "C23", "C33"), 4e-4, {"covariance": "mm"}),
])  # fmt: skip
def test_uncertainties_are_in_their_own_unit(names, figure, section, tmp_path):
    figures = np.tile([figure, *[figure * (len(names) == 3)] * 2, *[figure] * 3][: len(names)], N)
    header = [*six("A{}"), "X [mm]", "Y [mm]", "Z [mm]", *names]
    text = lines(header, DEG, MM, figures.reshape(N, -1), digits=12)
    sections = propose(write(tmp_path / "t.csv", text)).proposal.sections
    units = {k: v["unit"] for k, v in sections.items() if k in ("std", "covariance")}
    assert units == section
    assert sections.get("std", {}).get("kind", "std") == "variance" if "²" in names[0] else "std"


@pytest.mark.parametrize(("name", "section"), [
    ("X [cm]", {"position": "cm"}), ("Temp_F", {"air": "degF"}), ("Temperature", {"air": "degF"}),
    ("time_us", {"time": "us"}), ("stamp_ns", {"time": "ns"}),
    ("负载(千克)", {"hung_mass": "kg"}), ("T [°F]", {"air": "degF"}),
    ("T_air [°F]", {"air": "degF"}), ("t", {"time": "s"}),
])  # fmt: skip
def test_stated_units_are_not_left_out(name, section, tmp_path):
    axes = [name.replace("X", e) for e in "XYZ"] if "X" in name else list("XYZ")
    other = 70.0 + 0.1 * np.arange(N) if "X" not in name else POINTS
    text = lines([*six("A{}"), *axes, name if "X" not in name else "Nr"], DEG, MM / 10, other)
    sections = propose(write(tmp_path / "t.csv", text)).proposal.sections
    assert {k: sections[k]["unit"] for k in section} == section


START = datetime(2024, 5, 31, 23, 15)


@pytest.mark.parametrize("forms", [
    ("%d-%b-%Y %H:%M:%S",), ("%m/%d/%Y %H:%M",), ("%Y/%m/%d %H:%M",), ("%H:%M:%S",),
    ("%Y-%m-%d", "%H:%M:%S"), ("%d.%m.%Y", "%H:%M:%S"), ("%m/%d/%Y", "%I:%M:%S %p"),
])  # fmt: skip
def test_times_over_midnight(forms, tmp_path):
    stamps = [START + timedelta(minutes=5 * k) for k in range(N)]
    names = ["Date", "Time"][-len(forms) :]
    texts = [[t.strftime(form) for t in stamps] for form in forms]
    text = lines([*names, *six("A{}"), "X", "Y", "Z"], *texts, DEG, MM)
    proposed = propose(write(tmp_path / "t.csv", text))
    values, midnights = seconds(proposed.grid, proposed.proposal.mapping(Mapping).time)
    np.testing.assert_allclose(values, 300.0 * np.arange(N))
    assert midnights == (forms == ("%H:%M:%S",))


def test_standard_deviations_without_an_axis_follow_their_position(tmp_path):
    pairs = np.stack([MM, SIGMA[:, :3]], axis=2).reshape(N, 6)
    text = lines([*six("A{}"), "X", "std", "Y", "std", "Z", "std"], DEG, pairs)
    std = propose(write(tmp_path / "t.csv", text)).proposal.sections["std"]
    assert std["columns"] == ["std", "std (2)", "std (3)"]


@pytest.mark.parametrize("numbers", [True, False])
def test_names_of_rows_are_not_those_of_poses(numbers, tmp_path):
    """Each pose is read unloaded and loaded; the rows are numbered."""
    names = np.arange(1, 2 * N + 1) if numbers else [f"M{k}" for k in range(2 * N)]
    twice = (np.repeat(values, 2, axis=0) for values in (DEG, MM))
    text = lines(["No.", *six("A{}"), "X", "Y", "Z", "Load"], names, *twice, N * ["none", "5 kg"])
    proposal = propose(write(tmp_path / "t.csv", text)).proposal
    assert "pose" not in proposal.sections
    assert [words.split(":")[0] for about, words in proposal.doubts if about == "pose"] == [
        "'No.' names rows, not poses"
    ]


@pytest.mark.parametrize("whole", [True, False])
def test_reflectors_row_by_row(whole, tmp_path):
    """Every pose has a row of each reflector under each load; names that it lacks are others."""
    label, loads = N * ["A", "B", "A", "B"], N * ["none", "none", "5 kg", "5 kg"]
    label[-1] = label[-1] if whole else "A"
    four = (np.repeat(values, 4, axis=0) for values in (DEG, MM))
    header = ["Pose", "Point", "Load", *six("A{}"), "X", "Y", "Z"]
    text = lines(header, [p for p in POINTS for _ in range(4)], label, loads, *four)
    sections = propose(write(tmp_path / "t.csv", text)).proposal.sections
    assert sections["pose"]["column"] == "Pose"
    assert ("target" in sections) is whole


def test_distances_that_stand_side_by_side_are_said_not_to_be_read(tmp_path):
    text = lines([*six("A{}"), "distance 1", "distance 2"], DEG, MM[:, :2])
    doubts = propose(write(tmp_path / "t.csv", text)).proposal.doubts
    (said,) = [words for about, words in doubts if about == "distance" and "row" in words]
    assert said == "a row has one, not 'distance 2': write each in a row of its own"
