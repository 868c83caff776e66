"""`hilcal import` of tables as people have them: one line for whatever is wrong."""

from collections.abc import Callable

import numpy as np
import pytest

from hilcal.cell import cell_from_config
from hilcal.config import load_config
from hilcal.robot.catalogue import configs_dir, load_arm
from hilcal.robot.chain import evaluate
from hilcal.store.campaign_file import CampaignFile
from tests.support.cli_cases import ok, refused
from tests.support.foreign_tables import CELL, OFFSET, campaign, lines, write

C = campaign(12)
NAMES = [f"A{k}" for k in range(1, 7)]
HEADER = ["Point", *NAMES, "X", "Y", "Z", "sX", "sY", "sZ", "T", "M"]
GOOD = lines(
    HEADER, [f"P{k}" for k in range(12)], np.rad2deg(C.q), 1e3 * C.position,
    np.full((12, 3), 0.02), np.full(12, 20.5), np.where(np.arange(12) % 2, 0.0, 5.0),
)  # fmt: skip
MAPPING = """
[file]
separator = ";"
[position]
columns = ["X", "Y", "Z"]
unit = "mm"
[joints]
columns = ["A1", "A2", "A3", "A4", "A5", "A6"]
unit = "deg"
[pose]
column = "Point"
[std]
columns = ["sX", "sY", "sZ"]
unit = "mm"
[air]
column = "T"
[hung_mass]
column = "M"
"""


def cell(row, column, value):
    """The text with one cell changed; rows as an editor counts them."""

    def change(text):
        rows = [line.split(";") for line in text.splitlines()]
        rows[row - 1][HEADER.index(column)] = value
        return "\n".join(";".join(r) for r in rows) + "\n"

    return change


def scaled(column, factor):
    def change(text):
        rows = [line.split(";") for line in text.splitlines()]
        k = HEADER.index(column)
        for r in rows[1:]:
            r[k] = f"{factor * float(r[k]):.9g}"
        return "\n".join(";".join(r) for r in rows) + "\n"

    return change


def all_of(*changes):
    def change(text):
        for one in changes:
            text = one(text)
        return text

    return change


def same(text):
    return text


def swap(old, new):
    return lambda text: text.replace(old, new)


STD = ("sX", "sY", "sZ")
BAD: dict[str, tuple[Callable[[str], str], Callable[[str], str], tuple[str, ...]]] = {
    "text for a number": (cell(4, "X", "abc"), same, ("row 4", "column 'X'",
        "'abc' is not a number", "missing")),
    "a comma as decimal mark": (cell(4, "A2", "1,5"), same, ("row 4", "column 'A2'",
        "with '.' as decimal mark")),
    "infinite": (cell(4, "X", "inf"), same, ("row 4", "column 'X'", "not a number")),
    "a row that is too long": (swap("P3;", "P3;;;"), same, ("row 5 has 17 cells", "skip_rows")),
    "a row that is too short": (swap("P3;", ""), same, ("row 5 has 14 cells", "15")),
    "no such column": (same, swap('"A6"', '"A7"'), ("no column 'A7'", "Point")),
    "a column beyond the last": (same, swap('"A6"', "77"), ("column 77", "there are 15")),
    "joints in radians": (same, swap('"A6"]\nunit = "deg"', '"A6"]\nunit = "rad"'), ("row 2",
        "column 'A1'", "looks like degrees")),
    "positions in metres": (same, swap('"Z"]\nunit = "mm"', '"Z"]\nunit = "m"'), ("row 2",
        "column 'X'", "looks like millimetres")),
    "unknown unit": (same, swap('unit = "deg"', 'unit = "grad"'), ("[joints] unit", '"deg"')),
    "unknown section": (same, swap("[air]", "[aire]"), ("aire", 'did you mean "air"')),
    "unknown key": (same, swap('column = "T"', 'colum = "T"'), ("[air]", "colum", "column")),
    "no position": (same,
        lambda t: t.replace('[position]\ncolumns = ["X", "Y", "Z"]\nunit = "mm"\n', ""),
        ("no reading", "[position]", "[distance]")),
    "five joints": (same, swap(', "A6"]', "]"), ("5 columns of joints", "has 6 joints")),
    "negative standard deviation": (cell(3, "sY", "-0.02"), same, ("row 3", "column 'sY'",
        "0 or more")),
    "no standard deviation": (cell(3, "sY", ""), same, ("row 3", "column 'sY'", "no value")),
    "absurd precision": (all_of(*(scaled(c, 1e-12) for c in STD)), same, ("row 2",
        "no instrument reaches")),
    "millimetres as metres": (same, swap('"sZ"]\nunit = "mm"', '"sZ"]\nunit = "m"'), ("row 2",
        "standard deviation of 0.02 m")),
    "larger than the workspace": (all_of(*(scaled(c, 1e5) for c in STD)), same, ("row 2",
        "standard deviation of 2 m")),
    "a negative mass": (cell(3, "M", "-5"), same, ("row 3", "column 'M'", "0 or more")),
    "kelvin": (scaled("T", 14.3), same, ("row 2", "column 'T'", "°C")),
    "two poses of one name": (swap("P3;", "P2;"), same, ("row 5", "pose 'P2'",
        "give another pose another name")),
    "no header there": (same, swap('separator = ";"', 'separator = ";"\nheader_row = 99'), ("99",)),
    "another separator": (same, swap('";"', '"tab"'), ("no column", "Point;A1")),
    "same marks": (same, swap('";"', '","\ndecimal = ","'), ("separator and decimal",)),
    "a sheet of text": (same, swap('";"', '";"\nsheet = "a"'), ("sheet",)),
    "both forces": (same, lambda t: t + '[wrench]\ncolumns = ["X", "Y", "Z"]\n', ("[wrench]",
        "[hung_mass]")),
    "time": (same, lambda t: t + '[time]\ncolumn = "Point"\nunit = "iso"\n', ("row 2", "'P0'")),
    "most rows lack a value": (
        all_of(*(cell(row, "X", "") for row in range(2, 12))), same, ("column 'X'", "10 of 12")),
    "quaternion": (same,
        lambda t: t + '[orientation]\ncolumns = ["A1", "A2", "A3", "A4"]\n' 'convention = "abb"\n',
        ("row 2", "quaternion of length 1")),
    "orientation in degrees": (same,
        lambda t: t + '[orientation]\ncolumns = ["A1", "A2", "A3"]\nconvention = "kuka"\n',
        ("row 2", "column 'A1'", "looks like degrees", "[orientation] unit")),
    "unknown convention": (same,
        lambda t: t + '[orientation]\ncolumns = ["A1", "A2", "A3"]\n' 'convention = "kuka-abc"\n',
        ('did you mean "kuka"', "intrinsic-zyx")),
    "a second file that is not given": (same, lambda t: t + "[second_file]\n",
        ("[second_file] without path", "--second")),
    "no readings": (lambda t: t.splitlines()[0] + "\n", same, ("no readings below row 1",)),
    "empty": (lambda t: "", same, ("the file is empty",)),
    "quotes": (cell(3, "T", '"x'), same, ("not delimited text",)),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_what_is_wrong_is_one_line(case, tmp_path, capsys):
    change, remap, named = BAD[case]
    table = write(tmp_path / "t.csv", change(GOOD))
    mapping = write(tmp_path / "m.toml", remap(MAPPING))
    out = tmp_path / "run.hilcal"
    line = refused(capsys, 2, "import", table, "--config", CELL, "--format", mapping, "-o", out)
    assert "t.csv" in line or "m.toml" in line
    assert all(part in line for part in named), line
    assert not out.exists()


def imported(capsys, tmp_path, text, mapping=MAPPING, name="t.csv"):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    out = tmp_path / "run.hilcal"
    out.unlink(missing_ok=True)
    given = write(tmp_path / "m.toml", mapping)
    arguments = ("import", path, "--config", CELL, "--format", given, "-o", out, "--json")
    return ok(capsys, *arguments).document


def values(tmp_path):
    with CampaignFile.open(tmp_path / "run.hilcal") as file:
        return file.readings()


def test_a_good_table(tmp_path, capsys):
    d = imported(capsys, tmp_path, GOOD)
    assert (d["n_readings"], d["n_poses"], set(d["loads"])) == (12, 12, {"none", "5kg"})
    x = values(tmp_path)
    np.testing.assert_allclose(x.value, C.position, atol=1e-8)
    np.testing.assert_allclose(x.states.wrench[0], [0, 0, -5 * 9.80665, 0, 0, 0])
    np.testing.assert_allclose(x.covariance[0], (2e-5) ** 2 * np.eye(3), rtol=1e-9, atol=1e-18)


@pytest.mark.parametrize("computed", [False, True])
def test_positions_computed_from_the_joints_are_noticed(computed, tmp_path, capsys):
    """Commanded positions in the place of measured ones: the nominal arm fits them too well."""
    flange = evaluate(load_arm(load_config(CELL).robot.model), C.q)
    target = flange.position[-1] + flange.rotation[-1] @ OFFSET
    rows = [line.split(";") for line in GOOD.splitlines()]
    for row, position in zip(rows[1:], 1e3 * target, strict=True):
        row[7:10] = [f"{x:.2f}" for x in position] if computed else row[7:10]
    d = imported(capsys, tmp_path, "\n".join(map(";".join, rows)) + "\n")
    assert d["computed_positions"] is computed


def test_of_two_sets_of_positions_the_computed_one_is_left(tmp_path, capsys):
    """Names that say nothing, and the nominal positions first: they fit better than an arm can."""
    flange = evaluate(load_arm(load_config(CELL).robot.model), C.q)
    target = 1e3 * (flange.position[-1] + flange.rotation[-1] @ OFFSET)
    off = np.random.default_rng(1).normal(scale=0.5, size=target.shape)
    names = ["xn", "yn", "zn", "xm", "ym", "zm"]
    table = lines([*NAMES, *names], np.rad2deg(C.q), target, target + off)
    path, cell = write(tmp_path / "t.csv", table), tmp_path / "CELL.toml"
    cell.write_text('[robot]\nmodel = "ur10e"\n')
    d = ok(capsys, "import", path, "--preview", "--config", cell, "--json").document
    assert d["mapping"]["position"]["columns"] == ["xm", "ym", "zm"]
    why = {u["column"]: u["why"] for u in d["unused"]}
    assert why == dict.fromkeys(names[:3], "computed from the joint values")


def test_several_files_and_a_folder_are_joined_by_a_line(tmp_path, capsys):
    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_text(GOOD)
    for given in ([tmp_path], [tmp_path / "a.csv", tmp_path / "b.csv"]):
        said = refused(capsys, 2, "import", *given, "--config", CELL, "-o", tmp_path / "x.hilcal")
        assert "FNR > 1" in said
        assert ".csv > all.csv" in said


def test_copied_rows_are_said_and_counted_once(tmp_path, capsys):
    """A block that was pasted twice, once under other names; a reading made again scatters."""
    _, *rows = GOOD.splitlines()
    pasted = [*rows[:3], *(row.replace("P", "Q", 1) for row in rows[4:6])]
    again = rows[7].split(";")
    again[HEADER.index("X")] = f"{float(again[HEADER.index('X')]) + 0.01:.6f}"
    d = imported(capsys, tmp_path, "\n".join([GOOD.strip(), *pasted, ";".join(again)]) + "\n")
    assert d["n_readings"] == 13
    said = " ".join(d["notes"])
    assert "5 of 18 rows are copies of others to the last digit (the first is of P0/5kg)" in said


def test_repeats_side_by_side_are_of_one_target(tmp_path, capsys):
    """`--preview` says so, since they agree; reflectors are further apart."""
    names = [f"{axis}{k}" for k in (1, 2) for axis in "xyz"]
    q, cell = np.rad2deg(C.q), tmp_path / "CELL.toml"
    cell.write_text('[robot]\nmodel = "ur10e"\n')
    for off, said in ((1e-2, "repeats of one target"), (50.0, "several targets")):
        table = lines([*NAMES, *names], q, 1e3 * C.position, 1e3 * C.position + off)
        path, to = write(tmp_path / "t.csv", table), tmp_path / "m.toml"
        preview = ("import", path, "--preview", "--config", cell, "-o", to, "--force")
        assert said in ok(capsys, *preview).out
        if said.startswith("repeats"):
            out = tmp_path / "run.hilcal"
            given = ("import", path, "--config", cell, "--format", to, "-o", out, "--json")
            assert ok(capsys, *given).document["n_readings"] == 24


def test_rows_that_are_means_of_others_are_said(tmp_path, capsys):
    """Three repeats of each pose and their mean, as sheets have them; the repeats alone pass."""
    name, *rows = GOOD.splitlines()
    rng, place = np.random.default_rng(1), slice(HEADER.index("X"), HEADER.index("Z") + 1)
    out = []
    for row in rows:
        cells = row.split(";")
        repeats = np.array(cells[place], dtype=float) + 0.01 * rng.standard_normal((3, 3))
        for position in (*repeats, repeats.mean(axis=0)):
            cells[place] = [f"{x:.4f}" for x in position]
            out.append(";".join(cells))
    said = "12 of 48 rows are the mean of the others of their state (the first is of P0/5kg)"
    assert said in " ".join(imported(capsys, tmp_path, "\n".join([name, *out]) + "\n")["notes"])
    alone = [row for k, row in enumerate(out) if k % 4 != 3]
    d = imported(capsys, tmp_path, "\n".join([name, *alone]) + "\n")
    assert "mean of the others" not in " ".join(d["notes"])


def test_the_same_table_with_all_that_is_in_the_wild(tmp_path, capsys):
    imported(capsys, tmp_path, GOOD)
    plain = values(tmp_path)
    head, *rows = GOOD.splitlines()
    wild = f"{head};;\r\n;deg;deg;deg;deg;deg;deg;mm;mm;mm;mm;mm;mm;C;kg;;\n\n"
    wild += "".join(f"{row};;\r\n" for row in rows) + "\r\n\r\n"
    wild = wild.replace(";0.000000;;\r", ";-;;\r").replace(";5.000000;;\r", ";5;;\r")
    mapping = MAPPING.replace('";"', '";"\nunits_row = 2')
    imported(capsys, tmp_path, b"\xef\xbb\xbf" + wild.encode(), mapping)
    np.testing.assert_array_equal(values(tmp_path).value, plain.value)
    np.testing.assert_array_equal(values(tmp_path).states.wrench, plain.states.wrench)


def repeated_position(text):
    """Row 6 has the position of row 5."""
    for c in ("X", "Y", "Z"):
        text = cell(6, c, text.splitlines()[4].split(";")[HEADER.index(c)])(text)
    return text


def rounded_joints(text):
    return lines(
        HEADER, [f"P{k}" for k in range(12)], np.round(np.rad2deg(C.q), 1), 1e3 * C.position,
        np.full((12, 3), 0.02), np.full(12, 20.5), np.zeros(12),
    )  # fmt: skip


NOTED: dict[str, tuple[Callable[[str], str], Callable[[str], str], int, tuple[str, ...]]] = {
    "rows without a value": (all_of(cell(4, "X", "-9999"), cell(6, "Z", "n/a")),
        swap('";"', '";"\nmissing = [-9999]'), 10,
        ("2 of 12 rows left out (4, 6): no value in X, Z",)),
    "points that were not measured": (
        all_of(cell(4, "X", "0.000"), cell(4, "Y", "0"), cell(4, "Z", "-0.0")), same, 11,
        ("1 of 12 rows left out (4): no value in X, Y, Z",
         "positions of exactly 0, 0, 0 (1 of 12 rows) count as missing")),
    "a position that was not measured again": (repeated_position, same, 12,
        ("rows 6 read exactly the position of the row before",)),
    "rounded joints": (rounded_joints, same, 12, ("joint angles are rounded to 0.1 deg",)),
    "variances that look like standard deviations": (same,
        swap('"sZ"]', '"sZ"]\nkind = "variance"'), 12,
        ("read as standard deviations the figures would be 20 µm",)),
}  # fmt: skip
"""Changes of table and mapping, how many readings there are then, and what is said."""


@pytest.mark.parametrize("case", NOTED)
def test_what_is_odd_is_noted(case, tmp_path, capsys):
    change, remap, count, said = NOTED[case]
    d = imported(capsys, tmp_path, change(GOOD), remap(MAPPING))
    assert d["n_readings"] == count
    assert all(any(part in note for note in d["notes"]) for part in said), d["notes"]


def test_signs_that_programs_write(tmp_path, capsys):
    text = cell(3, "X", "\u22121\u00a0234.5")(GOOD)
    mapping = MAPPING.replace('";"', '";"\nthousands = " "')
    imported(capsys, tmp_path, text, mapping)
    assert values(tmp_path).value[1, 0] == pytest.approx(-1.2345)


def test_zero_standard_deviations_are_the_instruments(tmp_path, capsys):
    text = GOOD
    for c in STD:
        text = cell(3, c, "0.000")(cell(7, c, "1e-9")(text))
    d = imported(capsys, tmp_path, text)
    assert any("2 of 12 rows state a standard deviation of zero" in n for n in d["notes"])
    x = values(tmp_path)
    assert np.sqrt(x.covariance[1].diagonal()).min() > 5e-6


def test_expanded_uncertainty_of_a_point(tmp_path, capsys):
    std = '[std]\nvalues = [0.06]\nunit = "mm"\nkind = "expanded"\nk = 3\nof = "point"\n'
    mapping = MAPPING.replace('[std]\ncolumns = ["sX", "sY", "sZ"]\nunit = "mm"\n', std)
    imported(capsys, tmp_path, GOOD, mapping)
    expected = (2e-5) ** 2 / 3 * np.eye(3)
    np.testing.assert_allclose(values(tmp_path).covariance[5], expected, rtol=1e-9, atol=1e-20)


def exchange(tmp_path, orientation):
    """An exchange table of 40 poses, and the cell of an arm whose frames are not stated."""
    c = campaign(40)
    names = [f"q{k}_rad" for k in range(1, 7)]
    header = ["pose", "load", *names, "x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad"]
    text = lines(header, [f"P{k}" for k in range(40)], ["none"] * 40, c.q, c.position,
                 orientation(c), separator=",")  # fmt: skip
    cell = write(tmp_path / "CELL.toml", '[robot]\nmodel = "ur10e"\n[tracker]\nframe = "tracker"\n')
    return write(tmp_path / "t.csv", text), cell


@pytest.mark.long
def test_attitudes_of_another_convention_are_told_from_a_wrong_arm(tmp_path, capsys):
    path, cell = exchange(tmp_path, lambda c: np.radians(c.angles("xyz")))
    d = ok(capsys, "import", path, "--config", cell, "-o", tmp_path / "x.hilcal", "--json").document
    assert "the positions fit by themselves, but not the attitudes" in d["description"]["message"]
    assert [c["kind"] for c in d["description"]["explanations"][0]["changes"]] == ["attitudes"]
    preview = ok(capsys, "import", path, "--preview", "--config", cell, "--json").document
    assert preview["mapping"]["orientation"]["convention"] == "fixed-xyz"


def test_a_tracker_whose_frame_is_stated_as_the_base_is_told_to_be_one(tmp_path, capsys):
    path, cell = exchange(tmp_path, lambda c: c.attitude.as_rotvec())
    cell.write_text(cell.read_text().replace('"tracker"', '"base"'))
    d = ok(capsys, "import", path, "--config", cell, "-o", tmp_path / "x.hilcal", "--json").document
    assert d["description"]["message"].endswith('in CELL.toml: [tracker] frame = "tracker"')


def test_the_preview_writes_nothing_unless_asked(tmp_path, capsys):
    path = write(tmp_path / "t.csv", GOOD)
    d = ok(capsys, "import", path, "--preview", "--json").document
    assert list(tmp_path.iterdir()) == [path]
    assert d["mapping"]["position"] == {"columns": ["X", "Y", "Z"], "unit": "mm"}
    mapping = tmp_path / "m.toml"
    words = ok(capsys, "import", path, "--preview", "--config", CELL, "-o", mapping).out
    assert "12 readings of 12 poses" in words
    out = tmp_path / "run.hilcal"
    ok(capsys, "import", path, "--config", CELL, "--format", mapping, "-o", out)
    assert "exists" in refused(capsys, 2, "import", path, "--preview", "-o", mapping)
    again = ("import", path, "--config", CELL, "--format", mapping, "-o", out)
    assert "give --force" in refused(capsys, 2, *again)


def test_the_preview_says_what_is_wrong_with_the_description(tmp_path, capsys):
    c = campaign(30)
    q = np.rad2deg(c.q) * [1, 1, 1, -1, 1, 1]
    path = write(tmp_path / "t.csv", lines([*NAMES, "X", "Y", "Z"], q, 1e3 * c.position))
    cell = tmp_path / "CELL.toml"
    cell.write_text('[robot]\nmodel = "ur10e"\n')
    d = ok(capsys, "import", path, "--preview", "--config", cell, "--json").document
    assert "joint 4 turns the other way" in d["outcome"][-1]


@pytest.mark.parametrize("name", ["spatial-analyzer", "spatial-analyzer-points", "polyworks",
                                  "tracker-pilot"])  # fmt: skip
def test_shipped_mappings(name, tmp_path, capsys):
    points = [f"P{k}" for k in range(12)]
    p = 1e3 * C.position
    text = {
        "spatial-analyzer": lines(None, points, p, C.angles("xyz"), separator=","),
        "spatial-analyzer-points": "// SA\n"
        + lines(None, ["A"] * 12, ["Main"] * 12, points, p, separator=","),
        "polyworks": lines(None, points, p, separator=" "),
        "tracker-pilot": lines(
            ["Name", "X", "Y", "Z", "StdDev X", "StdDev Y", "StdDev Z", "Timestamp"],
            points, p, np.full((12, 3), 0.004), [f"2024-05-31T12:00:{k:02}" for k in range(12)],
        ),
    }[name]  # fmt: skip
    table = write(tmp_path / "t.csv", text)
    # the controller's log: as the mapping says, in another order where rows are matched by name
    order = np.arange(12)[::-1] if name == "spatial-analyzer-points" else np.arange(12)
    head = ["Target", *[f"J{k}" for k in range(1, 7)]]
    separator = {"tracker-pilot": ","}.get(name, ",")
    log = lines(head, [points[k] for k in order], np.rad2deg(C.q)[order], separator=separator)
    second = write(tmp_path / "j.csv", log)
    out = tmp_path / "run.hilcal"
    d = ok(
        capsys, "import", table, "--second", second, "--config", CELL, "--format", name, "-o", out,
        "--json",
    ).document  # fmt: skip
    assert d["n_readings"] == 12
    x = values(tmp_path)
    np.testing.assert_allclose(x.states.q, C.q, atol=1e-7)
    np.testing.assert_allclose(x.value[:, :3], C.position, atol=1e-8)


def test_loads_that_a_table_only_names_act_as_the_cell_states_them(tmp_path, capsys):
    """Else a load without a force is an error of the arm that follows the load."""
    names = ["ohne", "10 kg", "pull x", "box"] * 3
    header = ["Punkt", "Last", *NAMES, "X", "Y", "Z"]
    text = lines(header, [f"P{k}" for k in range(12)], names, np.rad2deg(C.q), 1e3 * C.position)
    path, mapping, run = write(tmp_path / "t.csv", text), tmp_path / "m.toml", tmp_path / "r.hilcal"
    ok(capsys, "import", path, "--config", CELL, "--preview", "-o", mapping)
    result = ok(capsys, "import", path, "--config", CELL, "--format", mapping, "-o", run, "--json")
    with CampaignFile.open(run) as file:
        r = file.readings()
    cell = cell_from_config(load_config(CELL))
    stated = {x.name: x.wrench(cell.gravity) for x in load_config(CELL).loads}
    for name, of in (("none", None), ("10 kg", "10kg"), ("pull x", "pull x"), ("box", None)):
        wrench = r.states.wrench[r.load == r.load_names.index(name)]
        np.testing.assert_array_equal(wrench, [stated[of] if of else np.zeros(6)] * 3)
    notes = " ".join(result.document["notes"])
    assert "load 10 kg: its force is that of [[loads]]" in notes
    assert "load box: its force is not stated by the table, nor by [[loads]]" in notes


def test_one_coordinate_of_nines_is_no_unit_and_the_way_out_is_one(tmp_path, capsys):
    position = 1e3 * C.position
    position[5, 1] = -9999
    text = lines(["Point", *NAMES, "X", "Y", "Z"], [f"P{k}" for k in range(12)], np.rad2deg(C.q),
                 position)  # fmt: skip
    path, mapping = write(tmp_path / "t.csv", text), tmp_path / "m.toml"
    positions_only = MAPPING.split("[std]")[0]
    arguments = ("import", path, "--config", CELL, "-o", tmp_path / "r.hilcal", "--format", mapping)
    mapping.write_text(positions_only, encoding="utf-8")
    said = refused(capsys, 2, *arguments)
    assert "row 7" in said
    assert "name them as missing in a mapping" in said
    assert "millimetres" not in said
    mapping.write_text(
        positions_only.replace("[file]", "[file]\nmissing = [-9999]"), encoding="utf-8"
    )
    assert ok(capsys, *arguments, "--json").document["n_readings"] == 11


def proposed(tmp_path, capsys, header, *columns, robot="ur10e"):
    """Return the document of --preview for a table of joint values and other columns."""
    c = campaign(24)
    write(tmp_path / "t.csv", lines(header, *(f(c) for f in columns), separator=",", digits=8))
    text = f'[robot]\nmodel = "{robot}"\n[tracker]\nframe = "tracker"\n'
    cell = write(tmp_path / "CELL.toml", text)
    return ok(
        capsys, "import", tmp_path / "t.csv", "--preview", "--config", cell, "--json"
    ).document


def matrices(c, columns=3):
    """(N, 3, columns) of the rotation and, with 4 columns, the position."""
    return np.concatenate([c.attitude.as_matrix(), c.position[:, :, None]], axis=2)[:, :, :columns]


def test_columns_named_as_the_arms_joints_are_these_joints_in_any_order(tmp_path, capsys):
    text = (configs_dir() / "robots" / "ur10e.toml").read_text()
    names = ["yaw", "lift", "elbow", "roll", "tilt", "spin"]
    for old, new in zip(load_arm("ur10e").joint_names, names, strict=True):
        text = text.replace(f'"{old}"', f'"{new}"')
    write(tmp_path / "arm.toml", text)
    order = [3, 1, 5, 0, 2, 4]
    header = [*(f"{names[k].title()} [rad]" for k in order), "x", "y", "z"]
    columns = lambda c: c.q[:, order], lambda c: c.position
    d = proposed(tmp_path, capsys, header, *columns, robot="arm.toml")
    assert d["mapping"]["joints"]["columns"] == [f"{name.title()} [rad]" for name in names]


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("rows", [3, 4])
def test_homogeneous_matrices_row_by_row(named, rows, tmp_path, capsys):
    def cells(c):
        below = np.broadcast_to([[[0.0, 0.0, 0.0, 1.0]]], (len(c.q), 1, 4))
        return np.concatenate([matrices(c, 4), below], axis=1)[:, :rows].reshape(len(c.q), -1)

    header = [*(f"q{k}" for k in range(1, 7))]
    header += [f"T{i}{j}" for i in range(1, rows + 1) for j in range(1, 5)]
    d = proposed(tmp_path, capsys, header if named else None, lambda c: c.q, cells)
    mapping = d["mapping"]
    places = [7, 8, 9, 11, 12, 13, 15, 16, 17]
    expected = [header[k - 1] for k in places] if named else places
    assert [str(c) for c in mapping["orientation"]["columns"]] == [str(c) for c in expected]
    expected = [header[k - 1] for k in (10, 14, 18)] if named else [10, 14, 18]
    assert [str(c) for c in mapping["position"]["columns"]] == [str(c) for c in expected]
    assert any("leaves 4" in line or "µm rms" in line for line in d["outcome"]), d["outcome"]


def test_the_arm_decides_whether_matrices_stand_column_by_column(tmp_path, capsys):
    def across(c):
        return np.swapaxes(matrices(c), 1, 2).reshape(-1, 9)

    d = proposed(tmp_path, capsys, None, lambda c: c.q, lambda c: c.position, across)
    mapping = d["mapping"]
    assert [int(c) for c in mapping["orientation"]["columns"]] == [
        10, 13, 16, 11, 14, 17, 12, 15, 18,
    ]  # fmt: skip
    assert not [doubt for doubt in d["unsure"] if "row by row" in str(doubt)]


SPHERICAL = ["Hz [gon]", "V [gon]", "D [m]"]


@pytest.mark.parametrize(
    ("header", "section", "columns"),
    [
        ([*NAMES, "X", "Y", "Z", "S"], "std", None),  # the status of a KUKA's point
        ([*NAMES, "X", "Y", "Z", "Deviation"], "std", None),  # from the nominal position
        ([*NAMES, "p(1)", "p(2)", "p(3)"], "position", 3),
        ([f"field.position{k}" for k in range(6)] + ["x", "y", "z"], "joints", 6),
        ([*NAMES, *SPHERICAL], "missing", "spherical coordinates"),
        ([*NAMES, "L1", "L2", "L3"], "distance", "L1"),
    ],
)
def test_columns_of_robots_and_instruments(header, section, columns, tmp_path, capsys):
    cells = [lambda c: c.q, lambda c: c.position, lambda c: np.full(len(c.q), 2)]
    d = proposed(tmp_path, capsys, header, *cells[: 2 + (len(header) > 9)])
    if section == "missing":
        assert columns in d["missing"][0]
        return
    result = d["mapping"].get(section)
    named = result and result.get("column", result.get("columns"))
    of = {6: header[:6], 3: header[6:9]}
    assert named == of.get(columns, columns)


def test_a_quaternion_called_rotation_and_a_frame_that_stands_still(tmp_path, capsys):
    header = [*NAMES, *(f"rig {k}" for k in "xyz"), *(f"target {k}" for k in "xyz")]
    header += [f"Rotation {k}" for k in "XYZW"]
    cells = [lambda c: c.q, lambda c: 0 * c.position + 1.5, lambda c: c.position]
    d = proposed(tmp_path, capsys, header, *cells, lambda c: c.attitude.as_quat())
    assert d["mapping"]["position"]["columns"] == header[9:12]
    assert d["mapping"]["orientation"]["columns"] == [header[15], *header[12:15]]


def test_a_standard_error_has_the_unit_of_the_positions(tmp_path, capsys):
    header = [*NAMES, "X [mm]", "Y [mm]", "Z [mm]", "StdErr"]
    cells = [lambda c: c.q, lambda c: 1e3 * c.position, lambda c: np.full(len(c.q), 6e-4)]
    assert proposed(tmp_path, capsys, header, *cells)["mapping"]["std"]["unit"] == "mm"


@pytest.mark.parametrize("point", ["p;[[1.5,2,3,4,5,6],[9E9,9E9]];1;2", "XP={A1 1.5,A2 -90};1;2"])
def test_points_of_a_program_are_no_columns(point, tmp_path, capsys):
    path = write(tmp_path / "t.csv", "\n".join([point] * 20) + "\n")
    said = refused(capsys, 2, "import", path, "--preview")
    assert "points of a robot's program" in said


@pytest.mark.parametrize("zeroed", [True, False])
def test_the_weight_of_the_tool_in_the_forces_is_noticed(zeroed, tmp_path, capsys):
    weight = np.where(np.arange(12) % 2, 0.0, 50.0) + (0.0 if zeroed else 19.6)
    text = lines([*NAMES, "x", "y", "z", "fz"], np.rad2deg(C.q), C.position, -weight)
    path = write(tmp_path / "t.csv", text)
    cell = tmp_path / "CELL.toml"
    cell.write_text('[robot]\nmodel = "ur10e"\n[tool]\nmass_kg = 2.0\n')
    d = ok(capsys, "import", path, "--preview", "--config", cell, "--json").document
    assert zeroed != any("was the sensor not zeroed?" in line for line in d["outcome"])


def test_angles_from_0_to_360_beyond_a_limit_are_told_from_degrees(tmp_path, capsys):
    c = campaign(8)
    q = c.q % (2 * np.pi)
    header = ["pose", "load", *(f"q{k}_rad" for k in range(1, 7)), "x_m", "y_m", "z_m"]
    text = lines(header, [f"P{k}" for k in range(8)], ["none"] * 8, q, c.position, separator=",")
    write(tmp_path / "t.csv", text)
    cell = write(tmp_path / "CELL.toml", '[robot]\nmodel = "irb120"\n[tracker]\nframe = "base"\n')
    line = refused(
        capsys, 2, "import", tmp_path / "t.csv", "--config", cell, "-o", tmp_path / "x.hilcal"
    )
    assert "within them a whole turn on: were the angles counted from 0 to 360°?" in line
    assert "degrees" not in line


def test_a_numpy_archive_is_named(tmp_path, capsys):
    np.savez(tmp_path / "t.npz", q=np.zeros((3, 6)))
    line = refused(
        capsys, 2, "import", tmp_path / "t.npz", "--config", CELL, "-o", tmp_path / "x.hilcal"
    )
    assert "a NumPy file; save it as CSV" in line


def test_forces_of_a_sensor_at_the_flange_are_noticed(tmp_path, capsys):
    flange = evaluate(load_arm(load_config(CELL).robot.model), C.q).rotation[-1]
    force = np.einsum("nji,j->ni", flange, [0.0, 0.0, -49.0])
    header = [*NAMES, "X", "Y", "Z", "Fx", "Fy", "Fz"]
    table = write(tmp_path / "t.csv", lines(header, np.rad2deg(C.q), 1e3 * C.position, force))
    mapping = tmp_path / "m.toml"
    ok(capsys, "import", table, "--config", CELL, "--preview", "-o", mapping)
    run = ["import", table, "--config", CELL, "--format", mapping, "-o", tmp_path / "r.hilcal"]
    assert "taken in flange axes they all have one" in " ".join(ok(capsys, *run).out.split())
    mapping.write_text(mapping.read_text().replace("[wrench]", '[wrench]\naxes = "flange"'))
    assert "flange axes" not in ok(capsys, *run, "--force").out
    with CampaignFile.open(tmp_path / "r.hilcal") as file:
        wrench = file.readings().states.wrench
    np.testing.assert_allclose(wrench[:, :3], np.tile([0, 0, -49.0], (12, 1)), atol=1e-4)
