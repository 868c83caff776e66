"""Tables by a mapping: a round trip in any dialect, unit and convention, and every complaint."""

import csv
import io
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hilcal.readings.covariance import TrackerNoise, tracker_covariance
from hilcal.robot.se3 import rotation
from hilcal.tables.mapped import import_mapped
from hilcal.tables.mapping import Mapping
from hilcal.tables.propose import propose
from hilcal.tables.sniff import sniff
from hilcal.toml import check_section
from tests.support.readings_cases import make_arm
from tests.support.refusals import refusal

ARM = make_arm()
per_example_file = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
NOISE = TrackerNoise(10e-6, 0.3e-6, 15e-6, 6e-6, 1e-4)
Q = [f"A{k}" for k in range(1, 7)]

# what the makers' manuals say, written out independently of the program's table
ORIENTATIONS = {
    "rotation-vector": lambda r: r.as_rotvec(),
    "ur": lambda r: r.as_rotvec(),
    "matrix": lambda r: r.as_matrix().reshape(-1, 9),
    "quaternion-xyzw": lambda r: r.as_quat(),
    "quaternion-wxyz": lambda r: r.as_quat()[:, [3, 0, 1, 2]],
    "abb": lambda r: r.as_quat()[:, [3, 0, 1, 2]],
    "kuka": lambda r: r.as_euler("ZYX"),
    "fanuc": lambda r: r.as_euler("xyz"),
    "staubli": lambda r: r.as_euler("XYZ"),
    "spatial-analyzer": lambda r: r.as_euler("xyz"),
    "kawasaki": lambda r: r.as_euler("ZYZ"),
    "intrinsic-zyz": lambda r: r.as_euler("ZYZ"),
    "fixed-zyx": lambda r: r.as_euler("zyx"),
    "fixed-xyx": lambda r: r.as_euler("xyx"),
}
LENGTHS = {"m": 1.0, "mm": 1e3, "um": 1e6, "in": 1 / 0.0254}
ANGLES = {"rad": 1.0, "deg": 180 / np.pi, "mrad": 1e3}


@dataclass(frozen=True)
class Written:
    """A table as somebody would write it, the mapping, and what it holds in SI units."""

    content: bytes
    mapping: dict[str, Any]
    q: np.ndarray
    position: np.ndarray
    attitude: Rotation | None
    std: np.ndarray | None
    load: list[str]
    time: np.ndarray


@st.composite
def written(draw):
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    count = draw(st.integers(2, 12))
    q = rng.uniform(-3, 3, (count, 6))
    position = rng.uniform(-1, 1, (count, 3)) + np.array([2.0, -1.0, 0.3])
    attitude = Rotation.random(count, rng=rng)
    separator = draw(st.sampled_from([",", ";", "tab", "blanks", "|"]))
    decimal = draw(st.sampled_from(["."] if separator == "," else [".", ","]))
    thousands = draw(st.sampled_from([None, "'"]))
    encoding = draw(st.sampled_from(["utf-8", "latin-1", "utf-16"]))
    length, angle = draw(st.sampled_from(list(LENGTHS))), draw(st.sampled_from(list(ANGLES)))
    convention = draw(st.sampled_from([None, *ORIENTATIONS]))
    header, units, comment = draw(st.booleans()), draw(st.booleans()), draw(st.booleans())

    columns = {"Punkt": [f"P{k}" for k in range(count)]}
    mapping = {"pose": {"column": "Punkt"}}

    def numbers(name, values):
        def cell(v):
            text = f"{v:.18f}"
            if thousands and abs(v) >= 1000:
                text = f"{v:,.18f}".replace(",", thousands)
            return text.replace(".", decimal)

        columns[name] = [cell(v) for v in values.tolist()]

    for k, name in enumerate(("Länge x", "y", "z")):
        numbers(name, LENGTHS[length] * position[:, k])
    mapping["position"] = {"columns": ["Länge x", "y", "z"], "unit": length}
    for k, name in enumerate(Q):
        numbers(name, ANGLES[angle] * q[:, k])
    mapping["joints"] = {"columns": Q, "unit": angle}
    if convention is not None:
        values = ORIENTATIONS[convention](attitude)
        turned = values.shape[1] == 3
        names = [f"o{k}" for k in range(values.shape[1])]
        for k, name in enumerate(names):
            numbers(name, values[:, k] * (ANGLES[angle] if turned else 1.0))
        mapping["orientation"] = {"columns": names, "convention": convention, "unit": angle}
    std = None
    if draw(st.booleans()):
        kind = draw(st.sampled_from(["std", "expanded", "variance"]))
        std = rng.uniform(10e-6, 40e-6, (count, 3))
        shown = LENGTHS[length] * std * (3.0 if kind == "expanded" else 1.0)
        names = ["sx", "sy", "sz"]
        for k, name in enumerate(names):
            numbers(name, shown[:, k] ** 2 if kind == "variance" else shown[:, k])
        mapping["std"] = {"columns": names, "kind": kind, "k": 3.0, "unit": length}
    load = ["none" if k % 2 else "10 kg" for k in range(count)]
    if separator != "blanks":
        columns["Last"] = ["unbelastet" if name == "none" else name for name in load]
    else:
        columns["Last"] = ["0" if name == "none" else "10kg" for name in load]
        load = [name.replace(" ", "") for name in load]
    mapping["load"] = {"column": "Last"}
    time = np.round(np.arange(count) * 61.5, 3)
    start = datetime(2024, 5, 31, 23, 59, 0)
    stamps = [start + timedelta(seconds=float(s)) for s in time]
    columns["Zeit"] = [s.isoformat() for s in stamps]
    mapping["time"] = {"column": "Zeit", "unit": "iso"}

    rows = [list(row) for row in zip(*columns.values(), strict=True)]
    file = {
        "separator": separator, "decimal": decimal, "encoding": encoding, "header_row": 0,
    }  # fmt: skip
    if thousands:
        file["thousands"] = thousands
    lines = []
    if comment:
        file["comment"] = "//"
        lines.append(["// made", "up"])
    if header:
        lines.append(list(columns))
        file["header_row"] = len(lines)
        if units:
            lines.append(["[-]"] * len(columns))
            file["units_row"] = len(lines)
    else:
        order = {name: k for k, name in enumerate(columns, start=1)}
        mapping = numbered(mapping, order)
    out = io.StringIO()
    mark = {"tab": "\t", "blanks": " "}.get(separator, separator)
    end = draw(st.sampled_from(["\n", "\r\n", "\r"]))
    writer = csv.writer(out, delimiter=mark, lineterminator=end)
    writer.writerows(lines + rows)
    text = out.getvalue() + draw(st.sampled_from(["", end * 3]))
    mapping["file"] = file
    used = attitude if convention is not None else None
    return Written(text.encode(encoding), mapping, q, position, used, std, load, time)


def numbered(mapping, order):
    """The mapping with columns by number."""
    out = {}
    for key, section in mapping.items():
        new = dict(section)
        if "column" in new:
            new["column"] = order[new["column"]]
        if "columns" in new:
            new["columns"] = [order[c] for c in new["columns"]]
        out[key] = new
    return out


def mapped(path, mapping, **options):
    return import_mapped(path, check_section(mapping, Mapping, "m.toml"), ARM, NOISE, **options)


@per_example_file
@given(w=written())
def test_round_trip(tmp_path, w):
    path = tmp_path / "t.txt"
    path.write_bytes(w.content)
    x = mapped(path, w.mapping).readings
    np.testing.assert_allclose(x.states.q, w.q, atol=1e-11)
    np.testing.assert_allclose(x.value[:, :3], w.position, atol=1e-11)
    if w.attitude is None:
        assert x.m == 3
    else:
        np.testing.assert_allclose(rotation(x.value[:, 3:]), w.attitude.as_matrix(), atol=1e-8)
    expected = tracker_covariance(w.position, NOISE, m=x.m)
    if w.std is not None:
        expected[:, :3, :3] = w.std[:, :, None] ** 2 * np.eye(3)
    np.testing.assert_allclose(x.covariance, expected, rtol=1e-4, atol=1e-17)
    assert [x.load_names[k] for k in x.load] == w.load
    assert x.pose_names == tuple(f"P{k}" for k in range(len(w.q)))
    np.testing.assert_allclose(x.states.time, w.time, atol=1e-5)


def test_three_targets_side_by_side(tmp_path):
    rng = np.random.default_rng(3)
    q, p = rng.uniform(-2, 2, (11, 6)), rng.uniform(-0.9, 0.9, (11, 3, 3)) + 1.5
    sigma = rng.uniform(0.01, 0.03, (11, 3, 3))
    names = [f"{axis}{k}" for k in (1, 2, 3) for axis in "xyz"]
    stds = [f"s{axis}{k}" for k in (1, 2, 3) for axis in "xyz"]
    text = ",".join([*names, *stds, *Q]) + "\n"
    block = np.hstack([1e3 * p.reshape(11, 9), sigma.reshape(11, 9), q])
    rows = [[f"{v:.9f}" for v in row] for row in block]
    rows[4][3] = ""  # x2 of the fifth row was not seen
    path = tmp_path / "t.csv"
    path.write_text(text + "\n".join(",".join(row) for row in rows))
    mapping = {
        "position": {"columns": names, "unit": "mm", "targets": ["A", "B", "C"]},
        "std": {"columns": stds, "unit": "mm"},
        "joints": {"columns": Q, "unit": "rad"},
    }
    result = mapped(path, mapping, targets=("A", "B", "C"))
    x = result.readings
    kept = np.delete(np.arange(33), 13)
    np.testing.assert_allclose(x.value, p.reshape(33, 3)[kept], atol=1e-11)
    expected = (1e-3 * sigma.reshape(33, 3)[kept]) ** 2
    np.testing.assert_allclose(x.covariance[:, range(3), range(3)], expected, rtol=1e-6)
    np.testing.assert_array_equal(x.states.target, np.tile([0, 1, 2], 11)[kept])
    np.testing.assert_array_equal(x.pose, np.repeat(np.arange(11), 3)[kept])
    assert result.notes[0] == "1 of 33 rows left out (6): no value in x1/x2/x3"
    sections = propose(path).proposal.sections
    assert sections["position"]["columns"] == names
    assert sections["position"]["targets"] == ["1", "2", "3"]
    refusal(r"\[\[tool.targets\]\]", mapped, path, mapping)


def test_angles_that_the_encoders_reported(tmp_path):
    rng = np.random.default_rng(3)
    q = np.repeat(rng.uniform(-2, 2, (6, 6)), 2, axis=0) + rng.uniform(-1e-4, 1e-4, (12, 6))
    p = rng.uniform(-0.9, 0.9, (12, 3)) + 1.5
    rows = [f"P{k // 2}," + ",".join(f"{v:.9f}" for v in (*q[k], *p[k])) for k in range(12)]
    path = tmp_path / "t.csv"
    path.write_text("\n".join([",".join(["pose", *Q, "x_m", "y_m", "z_m"]), *rows]))
    mapping = {
        "position": {"columns": ["x_m", "y_m", "z_m"], "unit": "m"},
        "joints": {"columns": Q, "unit": "rad"},
        "pose": {"column": "pose"},
    }
    refusal("row 3: pose 'P0' commands joint 1", mapped, path, mapping)
    mapping["joints"]["reported"] = True
    states = mapped(path, mapping).readings.states
    np.testing.assert_allclose(states.q, q[np.arange(12) // 2 * 2], atol=1e-9)
    np.testing.assert_allclose(states.q_actual, q, atol=1e-9)
    assert propose(path).proposal.mapping(Mapping) == check_section(mapping, Mapping, "m.toml")


@per_example_file
@given(w=written())
def test_the_dialect_is_seen(tmp_path, w):
    """However a table is written, the preview reads the same numbers from it."""
    path = tmp_path / "t.txt"
    path.write_bytes(w.content)
    grid = sniff(path).grid
    named = "A1" in grid.names
    joints = Q if named else [str(c) for c in w.mapping["joints"]["columns"]]
    unit = ANGLES[w.mapping["joints"]["unit"]]
    angles = np.stack([grid.numbers(name) for name in joints], axis=1)
    np.testing.assert_allclose(angles, unit * w.q, rtol=1e-9, atol=1e-9)
