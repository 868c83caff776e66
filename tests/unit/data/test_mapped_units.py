"""Units, times, wrenches and uncertainties of mapped tables, against plain arithmetic."""

from datetime import datetime, timedelta
from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilcal.errors import InputError
from hilcal.readings.covariance import TrackerNoise
from hilcal.robot.chain import evaluate
from hilcal.tables.mapped import import_mapped
from hilcal.tables.mapping import Mapping
from hilcal.toml import check_section
from tests.support.readings_cases import make_arm

ARM = make_arm()
NOISE = TrackerNoise(10e-6, 0.3e-6, 15e-6, 6e-6, 1e-4)
RNG = np.random.default_rng(7)
N = 5
Q, P = RNG.uniform(-2, 2, (N, 6)), RNG.uniform(-0.9, 0.9, (N, 3)) + 1.5
JOINTS, AXES = [f"A{k}" for k in range(1, 7)], ["X", "Y", "Z"]


def read(tmp_path, columns, **sections):
    """Readings of a table with these columns beside joints (rad) and positions (m)."""
    cells = {name: [repr(float(v)) for v in Q[:, k]] for k, name in enumerate(JOINTS)}
    cells |= {name: [repr(float(v)) for v in P[:, k]] for k, name in enumerate(AXES)}
    for name, values in columns.items():
        cells[name] = [v if isinstance(v, str) else repr(float(v)) for v in values]
    rows = [";".join(row) for row in zip(*cells.values(), strict=True)]
    path = tmp_path / "t.csv"
    path.write_text("\n".join([";".join(cells), *rows]))
    mapping = {
        "file": {"separator": ";"},
        "position": {"columns": AXES, "unit": "m"},
        "joints": {"columns": JOINTS, "unit": "rad"},
        **sections,
    }
    return import_mapped(path, check_section(mapping, Mapping, "m.toml"), ARM, NOISE).readings


SECONDS = np.array([0.0, 1.5, 60.0, 3600.0, 90000.0])
START = datetime(2024, 2, 28, 23, 0, 0)
DATES = [START + timedelta(seconds=float(s)) for s in SECONDS]


@pytest.mark.parametrize(("cells", "section"), [
    (SECONDS, {"unit": "s"}),
    (1e3 * SECONDS, {"unit": "ms"}),
    (SECONDS / 3600, {"unit": "h"}),
    (1.7e9 + SECONDS, {"unit": "s"}),
    (45350.958333333336 + SECONDS / 86400, {"unit": "excel"}),
    ([d.isoformat() for d in DATES], {"unit": "iso"}),
    ([d.isoformat() + "+01:00" for d in DATES], {"unit": "iso"}),
    (
        [d.strftime("%d.%m.%y %H:%M:%S.%f") for d in DATES],
        {"unit": "format", "format": "%d.%m.%y %H:%M:%S.%f"},
    )])  # fmt: skip
def test_times(cells, section, tmp_path):
    x = read(tmp_path, {"when": cells}, time={"column": "when", **section})
    np.testing.assert_allclose(x.states.time, SECONDS, atol=2e-6)


@pytest.mark.parametrize(("unit", "value"), [("degC", 20.0), ("degF", 68.0), ("K", 293.15)])
def test_temperatures(unit, value, tmp_path):
    x = read(tmp_path, {"T": [value] * N}, air={"column": "T", "unit": unit})
    np.testing.assert_allclose(x.states.air_temperature, 20.0, atol=1e-10)


@pytest.mark.parametrize(
    ("unit", "newton"), [("N", 1.0), ("kN", 1e3), ("kgf", 9.80665), ("lbf", 4.4482216)]
)
@pytest.mark.parametrize("of", ["load", "reaction"])
def test_forces(unit, newton, of, tmp_path):
    force = RNG.uniform(1, 20, (N, 3)) / newton
    force[2] = 0
    columns = {f"F{a}": force[:, k] for k, a in enumerate("xyz")}
    x = read(tmp_path, columns, wrench={"columns": list(columns), "unit": unit, "of": of})
    sign = -1 if of == "reaction" else 1
    np.testing.assert_allclose(x.states.wrench[:, :3], sign * newton * force, rtol=1e-7)
    assert [x.load_names[k] for k in x.load] == ["load", "load", "none", "load", "load"]


def test_hung_masses_pull_along_gravity(tmp_path):
    columns = {"m": ["0", "2500", "", "2500", "1e3"]}
    x = read(tmp_path, columns, hung_mass={"column": "m", "unit": "g"})
    expected = -9.80665 * np.array([0, 2.5, 0, 2.5, 1.0])
    np.testing.assert_allclose(x.states.wrench[:, 2], expected)
    assert [x.load_names[k] for k in x.load] == ["none", "2500g", "none", "2500g", "1000g"]


def test_angles_from_zero_to_a_turn(tmp_path):
    cells = {f"B{k}": np.rad2deg(Q[:, k]) % 360 for k in range(6)}
    x = read(tmp_path, cells, joints={"columns": list(cells), "unit": "deg", "from_zero": True})
    np.testing.assert_allclose(x.states.q, Q, atol=1e-12)


@pytest.mark.parametrize("sign", [1, -1])
def test_weights_pull_as_the_masses_they_are_of(sign, tmp_path):
    pounds = sign * np.array([0.0, 5.0, 10.0, 5.0, 0.0])
    x = read(tmp_path, {"w": pounds}, hung_mass={"column": "w", "unit": "lbf"})
    np.testing.assert_allclose(x.states.wrench[:, 2], -4.4482216152605 * np.abs(pounds))
    assert x.load_names == ("none", "5lbf", "10lbf")


def test_weights_have_one_sign(tmp_path):
    with pytest.raises(InputError, match="row 3, column 'w': weights have one sign"):
        read(tmp_path, {"w": [9.0, -9.0, 0, 0, 0]}, hung_mass={"column": "w", "unit": "N"})


def test_one_force_is_that_along_z(tmp_path):
    x = read(tmp_path, {"Fz": [0.0, -49, -98, 0, 1]}, wrench={"columns": ["Fz"]})
    np.testing.assert_array_equal(x.states.wrench[:, 2], [0, -49, -98, 0, 1])
    assert not np.delete(x.states.wrench, 2, axis=1).any()


def test_wrenches_in_flange_axes_are_turned_to_those_of_the_base(tmp_path):
    r = evaluate(ARM, Q).rotation[-1]
    base = RNG.uniform(1, 20, (N, 2, 3))
    in_flange_axes = np.einsum("nji,nkj->nki", r, base).reshape(N, 6)
    columns = {f"{c}{a}": in_flange_axes[:, k] for k, (c, a) in enumerate(product("FM", "xyz"))}
    x = read(tmp_path, columns, wrench={"columns": list(columns), "axes": "flange"})
    np.testing.assert_allclose(x.states.wrench, base.reshape(N, 6), rtol=1e-9)


def test_rows_of_the_same_joints_are_one_pose(tmp_path):
    cells = {f"B{k}": np.repeat(Q[:3, k], 2)[:N] for k in range(6)}
    x = read(tmp_path, cells, joints={"columns": list(cells), "unit": "rad"})
    assert x.pose.tolist() == [0, 0, 1, 1, 2]
    assert x.pose_names == ("row 2", "row 4", "row 6")


def test_a_name_twice_in_the_header(tmp_path):
    path = tmp_path / "t.csv"
    row = ",".join(["1", "2", "3", *["0.1"] * 6, "9"])
    path.write_text(",".join([*AXES, *JOINTS, "X"]) + f"\n{row}\n")
    mapping = {
        "position": {"columns": ["X (2)", "Y", "Z"], "unit": "m"},
        "joints": {"columns": JOINTS, "unit": "rad"},
    }
    checked = check_section(mapping, Mapping, "m.toml")
    x = import_mapped(path, checked, ARM, NOISE).readings
    assert x.value.tolist() == [[9.0, 2.0, 3.0]]


def _covariance(m):
    root = RNG.normal(size=(N, m, m))
    scale = np.repeat([1e-5, 1e-4], 3)[:m]
    return scale[:, None] * (root @ np.swapaxes(root, 1, 2) + np.eye(m)) * scale


ANGLES = {f"r{a}": np.zeros(N) + 0.1 * k for k, a in enumerate("xyz")}
TURN = {"columns": list(ANGLES), "convention": "rotation-vector", "unit": "rad"}


@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("whole", [False, True])
def test_covariances(m, whole, tmp_path):
    cov = _covariance(m)
    scale = np.repeat([1e3, 180 / np.pi], 3)[:m]
    shown = scale[:, None] * cov * scale
    pairs = [(i, j) for i in range(m) for j in range(m) if whole or i <= j]
    columns = {f"c{i}{j}": shown[:, i, j] for i, j in pairs}
    section = {"columns": list(columns), "unit": "mm", "angle_unit": "deg"}
    if m == 3:
        x = read(tmp_path, columns, covariance=section)
    else:
        x = read(tmp_path, columns | ANGLES, covariance=section, orientation=TURN)
    np.testing.assert_allclose(x.covariance, cov, rtol=1e-9, atol=1e-22)


def test_correlations(tmp_path):
    cov = _covariance(3)
    sigma = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    correlation = cov / sigma[:, :, None] / sigma[:, None, :]
    columns = {f"s{k}": 1e6 * sigma[:, k] for k in range(3)}
    pairs = {f"r{i}{j}": correlation[:, i, j] for i, j in ((0, 1), (0, 2), (1, 2))}
    x = read(
        tmp_path,
        columns | pairs,
        std={"columns": list(columns), "unit": "um"},
        correlation={"columns": list(pairs)},
    )
    np.testing.assert_allclose(x.covariance, cov, rtol=1e-9)
    bad = pairs | {"r01": np.full(N, 1.5)}
    with pytest.raises(InputError, match="row 2: the covariance is not positive semi-definite"):
        read(
            tmp_path,
            columns | bad,
            std={"columns": list(columns), "unit": "um"},
            correlation={"columns": list(pairs)},
        )


@pytest.mark.parametrize(
    ("convention", "order"),
    [("kuka", "ZYX"), ("fanuc", "xyz"), ("kawasaki", "ZYZ"), ("staubli", "XYZ")],
)
def test_standard_deviations_of_angles_turn_into_those_of_rotations(convention, order, tmp_path):
    """Against the spread of rotations whose angles scatter."""
    angles = np.array([0.7, -0.4, 1.2])
    sigma = np.array([2e-4, 5e-4, 8e-4])
    columns = {f"a{k}": np.full(N, angles[k]) for k in range(3)}
    figures = np.concatenate([[1e-5] * 3, sigma])
    std = {"values": figures.tolist(), "unit": "m", "angle_unit": "rad"}
    turn = {"columns": list(columns), "convention": convention, "unit": "rad"}
    x = read(tmp_path, columns, std=std, orientation=turn)
    mean = Rotation.from_euler(order, angles)
    sample = Rotation.from_euler(order, angles + sigma * RNG.standard_normal((100_000, 3)))
    spread = np.cov((sample * mean.inv()).as_rotvec().T)
    np.testing.assert_allclose(x.covariance[0, 3:, 3:], spread, atol=0.02 * sigma.max() ** 2)
