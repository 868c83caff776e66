"""No name becomes anything but a name: refused or kept on each way in, escaped on each way out.

The ways out, by format: URScript (`movej_program`), CSV (`write_columns` for tables, residuals and
revisions, `plan_csv`, `compensate -o F.csv`, `export --parameters F.csv`, `--dh F.csv`), Parquet
(`write_columns`), URDF, UR's YAML, TOML (`--dh F.toml`, the mapping of `--preview`, CELL.toml),
JSON (plans, calibrations, `--json`), command lines that people are told to run, HTML (report, its
charts, workbench), rerun (labels and markdown; entity paths hold no names), Python (`discover -o
F.py`), the terminal (tables, progress, questions, errors).
"""

import ast
import csv
import io
import json
import re
import shlex
import sqlite3
import tomllib
from contextlib import redirect_stderr
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import plotly.graph_objects as go
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import tomli_w
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from hilcal.calibration import storage
from hilcal.calibration.dh_table import dh_rows, to_csv, to_toml
from hilcal.calibration.handover import ur_kinematics, urdf
from hilcal.calibration.points import read_points
from hilcal.calibration.programs.urscript import movej_program, waypoints
from hilcal.cli import Failures, WatchedStream
from hilcal.cli.compensating import _csv
from hilcal.cli.terminal import Terminal
from hilcal.config import load_config
from hilcal.config.reference import cell_text
from hilcal.discovery.law import source_of_form
from hilcal.drivers.terminal_operator import TerminalOperator
from hilcal.errors import InputError
from hilcal.identification.carried import posterior
from hilcal.names import check_name, check_names, csv_text, escaped, from_csv, quoted
from hilcal.present import charts as chart_style
from hilcal.present import html as page
from hilcal.present.charts import label as in_chart
from hilcal.present.document import Chart, Items, PageSection, Words, table
from hilcal.present.html import FirstScreen
from hilcal.present.progress import SafeConsole, counting, working
from hilcal.present.viewer import style as viewer_style
from hilcal.robot.catalogue import load_arm
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan, Step, read_plan
from hilcal.store.rows import text_crc
from hilcal.tables.files import open_grid
from hilcal.tables.mapping import FileFormat
from hilcal.tables.proposal import Proposal
from hilcal.tables.table import write_table
from hilcal.tables.write import plan_csv, write_columns
from hilcal.workbench.cards import plain
from tests.support.paths import ROOT
from tests.support.readings_cases import make_arm, read_table, simple_readings
from tests.support.refusals import refusal
from tests.support.unguarded import unguarded
from tests.unit.calibration.test_calibration import calibrated

ARM = load_arm("ur10e")
CELL = next((ROOT / "configs" / "cells").glob("*.toml"))
EVIL = (
    *(chr(k) for k in (*range(0x20), *range(0x7F, 0xA0))),
    *"\u2028\u2029\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069",
    *"\ud800\udfff\ufeff\uffff\u00ad\u180e\u200b\u2060\ufffb\U000e0001\U000e0041",
)
PIECES = (
    "P1", " ", "movej([0,0,0,0,0,0], a=10, v=3)", "#", "end", '"', "'", '"""', "\\", "\\u000a",
    "=1+1", "+", "-", "@SUM(A1)", ",", ";", ";=1+1", "\uff1d1", "<script>alert(1)</script>", "<b>",
    "&lt;", "-->", "--", "]]>", "[red]", "[/]", "{x}", "{{ x }}", "%s", "é", "日本", "/", "*", "_",
    "x: y", "`",
)  # fmt: skip
names = st.lists(st.sampled_from((*PIECES, *PIECES, *EVIL)), min_size=1, max_size=7).map("".join)
FORMULA = tuple("=+-@\t\r\uff1d\uff0b\uff0d\uff20")


def harmless(text):
    """Whether a text has no character that no name may hold, but for ends of lines."""
    return not set(text) & {*EVIL} - {"\n"}


@pytest.mark.parametrize("sign", EVIL)
def test_each_such_character_is_refused_in_one_line_and_escaped(sign):
    with pytest.raises(InputError) as error:
        check_name(f"P1{sign}x", "t.csv: row 2, column 'pose'")
    said = str(error.value)
    code = f"\\u{ord(sign):04x}" if ord(sign) < 0x10000 else f"\\U{ord(sign):08x}"
    assert said.startswith(f"t.csv: row 2, column 'pose': 'P1{code}x' holds the character {code};")
    assert "valid: " in said
    assert harmless(said)
    assert "\n" not in said
    assert escaped(sign) == code


def test_documents_are_checked_however_deep_they_are():
    deep = "a\nb"
    for _ in range(5000):
        deep = [deep]
    refusal("holds the character", check_names, {"a": deep}, "f")
    refusal(r"f: a: b 2: .* holds the character", check_names, {"a": {"b": [1, "\x1b"]}}, "f")
    refusal("holds the character", check_names, {"a": {"b\u2028": 1}}, "f")


@given(names, names)
def test_urscript(name, other):
    text = movej_program([name, other], np.zeros((2, 6)))
    assert harmless(text)
    assert len(waypoints(text)) == 2
    assert [line.split("#")[0].split("(")[0].strip() for line in text.splitlines()] == [
        *("def compensated", "movej", "movej", "end")
    ]
    assert text.split("\n")[1].endswith(f"  # {escaped(name)}")


def the_same_cells(text, wanted):
    """Rows by their lines, with the names in place, and no cell that is a formula."""
    assert harmless(text)
    rows = list(csv.reader(io.StringIO(text, newline=""), strict=True))
    assert len(rows) == text.count("\n") == len(wanted)
    for row, given_ in zip(rows, wanted, strict=True):
        assert len(row) == len(given_)
        for cell, name in zip(row, given_, strict=True):
            if name is not None:
                assert from_csv(cell) == escaped(name)
                for begun in (cell, *cell.split(";")):  # as spreadsheets of some countries do
                    assert not begun.strip(' "').startswith(FORMULA)


@given(names)
def test_csv(name):
    folder = FOLDER[0]
    write_columns(folder / "a.csv", {"pose": [name, "b"], name: [-1.5, None]}, {})
    text = (folder / "a.csv").read_bytes().decode()
    the_same_cells(text, [["pose", name], [name, None], ["b", ""]])
    assert text.split("\n")[1].endswith(",-1.5")  # numbers stay numbers
    plan = Plan((name,), np.full((1, 6), -0.5), (Step(name, name),))
    the_same_cells(plan_csv(plan), [[None] * 10, [None, name, name, *[None] * 7]])
    assert plan_csv(plan).endswith(",-0.5\n")
    errors = SimpleNamespace(error_m=np.ones(1), std_m=np.ones(1), band_m=np.ones(1))
    result = SimpleNamespace(q=np.zeros((1, 6)), before=errors, after=errors)
    the_same_cells(_csv((name,), result, ("rad",) * 6), [[None] * 10, [name, *[None] * 9]])
    arm = replace(ARM, joint_names=(name,) * 6)
    rows = to_csv(dh_rows(ARM, "standard"), arm)
    the_same_cells(rows, [[None] * 5, *[[name, *[None] * 4]] * 6])
    row = {"name": name, "value": -1.0, "std": None, "unit": "m", "identifiable": True}
    write_columns(folder / "p.csv", {key: [value] for key, value in row.items()}, {})
    the_same_cells((folder / "p.csv").read_bytes().decode(), [[None] * 5, [name, *[None] * 4]])
    if escaped(name) == name:
        assert from_csv(csv_text(name)) == name
    write_columns(folder / "a.parquet", {"pose": [name]}, {"about": name})
    assert pq.read_table(folder / "a.parquet")["pose"].to_pylist() == [escaped(name)]


@given(names)
def test_xml_and_yaml(name):
    arm = replace(ARM, name=name, joint_names=tuple(f"{name}{k}" for k in "abcdef"))
    text = urdf(arm, f"{name}\n{name}-")
    assert harmless(text)
    root, plain_ = ElementTree.fromstring(text), ElementTree.fromstring(urdf(ARM))
    assert [x.tag for x in root.iter()] == [x.tag for x in plain_.iter()]
    assert root.get("name") == escaped(name)
    assert root.findall("joint")[0].get("name") == escaped(f"{name}a")
    made, _ = ur_kinematics(ARM, ARM, f"{name}\n{name}")
    assert harmless(made)
    assert yaml.safe_load(made) == yaml.safe_load(ur_kinematics(ARM, ARM)[0])


@given(names)
def test_toml(name):
    arm = replace(ARM, source=name, joint_names=(name,) * 6)
    made = to_toml(dh_rows(ARM, "standard"), arm, name)
    content = tomllib.loads(made)
    assert harmless(made)
    assert content["title"] == escaped(name)
    assert [joint["name"] for joint in content["joints"]] == [escaped(name)] * 6
    p = Proposal({"position": {"unit": name, "columns": [name, "y", "z"]}}, unused=[(name, name)])
    p.missing.append(name)
    p.doubts += [("position", name), ("elsewhere", name)]
    mapping = p.to_toml(name)
    assert harmless(mapping)
    assert tomllib.loads(mapping) == {
        "position": {"unit": escaped(name), "columns": [escaped(name), "y", "z"]}
    }
    cell = cell_text({"robot": {"model": "ur10e"}}, name)
    assert harmless(cell)
    assert tomllib.loads(cell) == tomllib.loads(cell_text({"robot": {"model": "ur10e"}}, "a"))


@given(names)
def test_command_lines(name):
    line = f"hilcal refine {quoted(name)} --prior a"
    assert harmless(line)
    assert shlex.split(line) == ["hilcal", "refine", escaped(name), "--prior", "a"]


@given(names)
def test_json(name):
    text = Plan((name,), np.zeros((1, 6)), (Step(name, name),), {"by": name}).to_json()
    assert text.isascii()
    assert harmless(text)
    assert json.loads(text)["poses"][0]["name"] == json.loads(text)["by"] == name
    out = io.StringIO()
    silent = Console(file=io.StringIO())
    Terminal(True, silent, silent, out).document({name: [name]})
    assert out.getvalue().isascii()
    assert json.loads(out.getvalue()) == {name: [name]}


class Tags(HTMLParser):
    """Tags with their attributes' names, and all text."""

    def __init__(self):
        super().__init__()
        self.tags = []
        self.words = []
        self.labels = []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, [key for key, _ in attrs]))
        self.labels += [value for key, value in attrs if key == "aria-label"]

    def handle_data(self, data):
        self.words.append(data)


def report(name):
    figure = chart_style.figure(
        name, in_chart(name), traces=[go.Scatter(x=[in_chart(name)], y=[1])]
    )
    parts = (
        *(Words(name, kind) for kind in ("text", "note", "heading", "strong", "code")),
        Items((name,)),
        table(name, "b", rows=[(name, name)], caption=name),
        Chart(name, figure),
    )
    first = FirstScreen(name, "good", ((name, name),), (), name, True)
    return page.render(name, name, first, (PageSection("a", name, parts),))


@settings(max_examples=12, deadline=None)
@given(names.map(lambda name: name.replace("\n", "")))  # an end of line begins a paragraph
def test_html(name):
    tags, other = Tags(), Tags()
    text = report(f"x{name}")  # a cell without a short class has the same tag
    assert harmless(text)
    tags.feed(text)
    other.feed(report("x" * 24))
    short = [(tag, [a for a in keys if a != "class"]) for tag, keys in tags.tags]
    assert short == [(tag, [a for a in keys if a != "class"]) for tag, keys in other.tags]
    words = escaped("x" + name)
    assert words in tags.words
    assert words in tags.labels
    scripts = [w for w in tags.words if w.startswith("{")]
    drawn = json.loads(scripts[0])["data"][0]["x"][0]
    assert "<" not in drawn
    assert drawn == in_chart(f"x{name}")
    once = Tags()
    once.feed(f"<h2 title='{plain(name)}'>{plain(name)}</h2>")
    assert once.tags == [("h2", ["title"])]
    assert "".join(once.words) == escaped(name)


@given(names)
def test_rerun(name):
    assert harmless(viewer_style.storable(name))
    words = viewer_style.escaped(name)
    assert "\n" not in words
    assert harmless(words)
    assert not re.search(r"(?<!\\)(?:\\\\)*[<>`*_\[\]]", words)


@given(names)
def test_python(name):
    form = FORM[0]
    source = source_of_form(form, "my_law", evidence=f"{name}\n{name}", file=name)
    other = source_of_form(form, "my_law", evidence="a\nb", file="F.py")
    assert harmless(source)
    tree, wanted = ast.parse(source), ast.parse(other)
    assert ast.dump(ast.Module(tree.body[1:], [])) == ast.dump(ast.Module(wanted.body[1:], []))
    assert escaped(name).strip() in (ast.get_docstring(tree, clean=False) or "")


@pytest.mark.parametrize("name", ["a\nimport os", "a-b", "A", ""])
def test_an_effect_has_a_name_of_python(name):
    refusal("valid: lower-case letters", source_of_form, FORM[0], name)


@given(names)
def test_terminal(name):
    for terminal_ in (False, True):
        file = io.StringIO()
        kept = SafeConsole(file=file, width=4000, force_terminal=terminal_, color_system=None)
        t = Terminal(False, kept, kept, io.StringIO())
        rows = RichTable(name)
        rows.add_row(name)
        t.show([name, Text(name), rows])
        t.notice(name)
        t.command(name)
        assert harmless(file.getvalue())
        for markup in ("[red]", "[/]"):
            assert file.getvalue().count(markup) == 6 * name.count(markup)
    with redirect_stderr(io.StringIO()) as stderr:
        out = io.StringIO()
        Failures(True, WatchedStream(out), False).report(None, f"{name}: no such file", 2)
    assert stderr.getvalue().count("\n") == 1
    assert harmless(stderr.getvalue())
    assert harmless(json.loads(out.getvalue())["error"]["message"])


def test_progress_and_questions_are_no_markup():
    name = "[red]x[/]\x1b[31m\u202e"
    file = io.StringIO()
    console = SafeConsole(file=file, width=200, force_terminal=True, color_system=None)
    with working(console) as say:
        say(name)
        say(name)
    with counting(console, name, 3) as step:
        step(1)
    shown = re.sub(r"\x1b\[(\?25[lh]|[\d;]*[mKAG])", "", file.getvalue())
    assert harmless(shown.replace("\r", ""))
    assert shown.count("[red]x[/]\\u001b[31m\\u202e") >= 2
    operator = TerminalOperator(load_config(CELL))
    operator._console = Console(file=(asked := io.StringIO()), width=200)
    operator._say(name)
    assert asked.getvalue() == f"{escaped(name)}\n"


def refused_or(read, name, what=""):
    """A reader refuses a name, naming its character, or keeps it."""
    kept, said = None, ""
    try:
        kept = read()
    except InputError as error:
        said = str(error)
    if kept is None:
        assert harmless(said)
        assert escaped(name) == name or "holds the character \\" in said, what
    else:
        assert kept == name.strip(), what  # no reader takes blanks around a name for a part of it
        assert harmless(kept), what
        assert "\n" not in kept, what


def as_csv(header, *rows):
    out = io.StringIO()
    csv.writer(out).writerows([header, *rows])
    return out.getvalue().encode("utf-8", "replace")


@given(names)
def test_tables_and_plans_refuse_a_name_or_keep_it(name):
    folder, q = FOLDER[0], [f"q{k}_rad" for k in range(1, 7)]
    if re.search("[\ud800-\udfff]", name):
        return  # no file of UTF-8 holds these
    said = csv_text(name) if escaped(name) == name else name
    path = folder / "p.csv"
    path.write_bytes(as_csv(["pose", *q], [said, *[0.1] * 6]))
    refused_or(lambda: read_points(path, ARM, {}).names[0], name, "points")
    path.write_bytes(as_csv(["pose", "load", *q], [name, said, *[0.1] * 6]))
    refused_or(lambda: read_points(path, ARM, {name.strip(): np.zeros(6)}) and name.strip(), name)
    path.write_bytes(as_csv(["a", "b"], [said, 1]))
    refused_or(lambda: open_grid(path, FileFormat()).text("a")[0], name, "grid")
    pq.write_table(pa.table({"pose": [name]}), folder / "p.parquet")
    refused_or(lambda: open_grid(folder / "p.parquet", FileFormat()).text("pose")[0], name)
    text = Plan((name,), np.zeros((1, 6)), (Step(name, "none"),)).to_json()
    refused_or(lambda: read_plan(text, "plan.json").pose_names[0].strip(), name, "plan")


@given(names)
def test_exchange_tables_are_read_back_or_refused(name):
    readings = simple_readings(4)
    whole = replace(readings, pose_names=(name, *readings.pose_names[1:]))
    for path in (FOLDER[0] / "t.csv", FOLDER[0] / "t.parquet"):
        if escaped(name) != name or name != name.strip():
            with pytest.raises(InputError) as error:
                write_table(whole, path)
            assert harmless(str(error.value))
        else:
            write_table(whole, path)
            assert name in read_table(path, make_arm(), None).pose_names


@given(names)
def test_cells_and_documents_refuse_a_name_or_keep_it(name):
    if re.search("[\ud800-\udfff]", name):
        return  # no TOML holds these
    cell = tomllib.loads((CELL).read_text())
    cell["loads"] = [{"name": name, "mass_kg": 1.0}]
    cell.pop("planning", None)
    path = FOLDER[0] / "cell.toml"
    path.write_text(tomli_w.dumps(cell))
    refused_or(lambda: load_config(path).loads[0].name.strip(), name, "cell")
    content = {**CALIBRATION[0], "loads": {name: [0.0] * 6}}
    refused_or(lambda: next(iter(storage.from_json(content).loads)).strip(), name, "calibration")
    if escaped(name) != name:
        prior = {"format": posterior.FORMAT, "version": 1, "arm": name}
        refusal("holds the character", posterior.Posterior.from_json, prior)


@pytest.mark.parametrize("table_", ["poses", "loads", "revisions"])
def test_a_name_in_a_campaign_of_others_is_refused(table_, tmp_path):
    path = tmp_path / "run.hilcal"
    with CampaignFile.create(path, "{}", str(tmp_path), "made") as file:
        file.append_readings(simple_readings(4))
    with sqlite3.connect(path) as db:
        if table_ == "revisions":
            document = {
                **{key: {} for key in ("options", "parameters_json", "result_json")},
                **{"effects": ["a\x1b[31m"], "created": "", "program_version": "", "data_hash": ""},
                **{"added": None, "removed": None},
            }
            text = json.dumps(document)
            db.execute("INSERT INTO revisions VALUES (1, ?, ?)", (text, text_crc("1", text)))
        else:
            with unguarded(db):
                db.execute(f"UPDATE {table_} SET name = ? WHERE id = 0", ("P1\n movej(x)",))
    db.close()
    with (
        pytest.raises(InputError, match=r"holds the character \\u00") as error,
        CampaignFile.open(path) as file,
    ):
        file.readings()
    assert str(path) in str(error.value)
    assert harmless(str(error.value))


def test_a_name_is_refused_where_it_goes_into_a_campaign(tmp_path):
    readings = simple_readings(4)
    named = replace(readings, pose_names=("a\nb", *readings.pose_names[1:]))
    with CampaignFile.create(tmp_path / "run.hilcal", "{}", "", "made") as file:
        refusal(r"holds the character \\u000a", file.append_readings, named)
        assert file.n_readings == 0


FOLDER = []
FORM = []
CALIBRATION = []


@pytest.fixture(scope="module", autouse=True)
def _made(tmp_path_factory):
    from hilcal.discovery import shapes
    from hilcal.discovery.amplitudes import Factor
    from hilcal.discovery.law import Form, LawPart
    from hilcal.discovery.sites import sites
    from tests.unit.discovery.test_grammar import example, named, product

    FOLDER.append(tmp_path_factory.mktemp("names"))
    linear = product(Factor(named(example())["τ_2"], shapes.LINEAR))
    FORM.append(Form((LawPart(sites(6)[2], linear, 0),)))
    CALIBRATION.append(json.loads(json.dumps(storage.to_json(calibrated("encoder_offset")))))
    patched = pytest.MonkeyPatch()
    patched.setattr(page, "get_plotlyjs", lambda: "")  # 4 MB that no name is in
    yield
    patched.undo()
