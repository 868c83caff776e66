"""Points of tables and of UR programs, and the branch that poses are put on."""

import re

import numpy as np
import pandas as pd
import pytest

from hilcal.calibration.points import on_branch, read_points
from hilcal.calibration.programs.urscript import movej_program, program_points, waypoints
from hilcal.errors import InputError
from hilcal.robot import se3
from hilcal.robot.catalogue import load_arm
from hilcal.robot.chain import evaluate
from hilcal.tables.mapping import Mapping, PointMapping, find_mapping
from hilcal.tables.propose import propose
from tests.support.refusals import refusal, refusals, refuses

ARM = load_arm("ur10e")
LOADS = {"10kg": np.array([0.0, 0.0, -98.0665, 0.0, 0.0, 0.0])}
Q = np.array([[0.1, -1.2, 1.5, -1.0, -1.4, 0.3], [0.3, -1.1, 1.4, -0.9, -1.5, 0.4]])
TOOL = se3.matrix(se3.rotation(np.array([0.1, 0.2, -0.3])), np.array([0.05, 0.0, 0.12]))
JOINTS = "q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad"


def written(tmp_path, text, name="p.csv"):
    path = tmp_path / name
    path.write_text(text)
    return path


def poses(q):
    chain = evaluate(ARM, q)
    rotation = se3.product(chain.rotation[-1], TOOL[:3, :3])
    return se3.matrix(rotation, chain.point(TOOL[:3, 3]))


@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_joint_values_loads_and_records_are_read(tmp_path, unit):
    factor = np.degrees(1) if unit == "deg" else 1.0
    rows = [",".join(f"{factor * v:.12f}" for v in q) for q in Q]
    header = JOINTS.replace("rad", unit)
    text = f"pose,{header},load,air_degC\na,{rows[0]},10kg,21\nb,{rows[1]},none,22\n"
    p = read_points(written(tmp_path, text), ARM, LOADS)
    assert p.names == ("a", "b")
    np.testing.assert_allclose(p.q, Q, atol=1e-11)
    assert p.target_poses is None
    np.testing.assert_array_equal(p.wrench[:, 2], [-98.0665, 0.0])
    np.testing.assert_array_equal(p.recorded["air_temperature"], [21, 22])


@pytest.mark.parametrize("metric", [True, False])
def test_poses_follow_the_branch_of_the_point_before(tmp_path, metric):
    goal = poses(Q)
    r = se3.rotation_vector(goal[:, :3, :3])
    rows = np.hstack([goal[:, :3, 3], r] if metric else [1e3 * goal[:, :3, 3], np.degrees(r)])
    header = "x_m,y_m,z_m,rx_rad,ry_rad,rz_rad" if metric else "x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg"
    text = "\n".join([header, *(",".join(f"{v:.12f}" for v in row) for row in rows)])
    p = read_points(written(tmp_path, text + "\n"), ARM, LOADS)
    q = on_branch(p, ARM, TOOL, Q[0] + 0.1)
    np.testing.assert_allclose(q, Q, atol=1e-8)
    assert p.names == ("1", "2")
    refusal(r"point 1 is a pose without joint values.*--near", on_branch, p, ARM, TOOL, None)


def test_tables_as_import_takes_them(tmp_path):
    """Semicolons, decimal commas, columns of the exchange table, positions alone; a mapping."""
    goal = poses(Q)
    wanted = goal[:, :3, 3] + [0.001, 0.0, -0.002]
    header = f"pose,load,{JOINTS},x_m,y_m,z_m,cov_x_x,cycle,x_note"
    rows = [
        ",".join([f"p{k}", "10kg", *(f"{v:.12f}" for v in (*Q[k], *wanted[k])), "1e-10", "1", "7"])
        for k in range(2)
    ]
    plain = read_points(written(tmp_path, "\n".join([header, *rows]) + "\n"), ARM, LOADS)
    q = on_branch(plain, ARM, TOOL, None)
    np.testing.assert_allclose(poses(q)[:, :3, 3], wanted, atol=1e-8)
    np.testing.assert_allclose(poses(q)[:, :3, :3], goal[:, :3, :3], atol=1e-8)
    german = "\n".join([header, *rows]).replace(",", ";").replace(".", ",") + "\n"
    again = read_points(written(tmp_path, german, "g.csv"), ARM, LOADS)
    np.testing.assert_array_equal(again.q, plain.q)
    mapping = written(
        tmp_path,
        "[position]\ncolumns = ['X', 'Y', 'Z']\nunit = 'mm'\n"
        "[joints]\ncolumns = ['A1', 'A2', 'A3', 'A4', 'A5', 'A6']\nunit = 'deg'\n"
        "[load]\ncolumn = 'Last'\n[file]\nseparator = ';'\ndecimal = ','\n",
        "m.toml",
    )
    table = "A1;A2;A3;A4;A5;A6;X;Y;Z;Last\n" + "".join(
        ";".join(f"{v:.9f}" for v in (*np.degrees(Q[k]), *1e3 * wanted[k])).replace(".", ",")
        + ";10kg\n"
        for k in range(2)
    )
    of_file = find_mapping(mapping, PointMapping)
    mapped = read_points(written(tmp_path, table, "k.csv"), ARM, LOADS, of_file)
    np.testing.assert_allclose(on_branch(mapped, ARM, TOOL, None), q, atol=1e-8)
    np.testing.assert_array_equal(mapped.wrench[:, 2], [-98.0665, -98.0665])
    lost = written(tmp_path, table.replace("10kg", "9kg"), "l.csv")
    refusal(r"unknown load '9kg'; valid: none, .*10kg", read_points, lost, ARM, LOADS, of_file)


def other_names(header):
    """A table of two points, as others write it."""
    rows = np.hstack([np.degrees(Q[:2]), 1e3 * poses(Q[:2])[:, :3, 3]])
    return f"{header},Load\n" + "".join(
        ",".join(f"{v:.9f}" for v in row) + ",10kg\n" for row in rows
    )


def test_other_names_are_taken_where_nothing_is_unsure(tmp_path):
    joints = ",".join(f"J{k} [deg]" for k in range(1, 7))
    text = other_names(f"{joints},X [mm],Y [mm],Z [mm]")
    points = read_points(written(tmp_path, text), ARM, LOADS)
    np.testing.assert_allclose(points.q, Q[:2], atol=1e-9)
    np.testing.assert_allclose(points.target_poses[:, :3, 3], poses(Q[:2])[:, :3, 3], atol=1e-9)
    assert points.wrench[0, 2] == -98.0665
    for part in ("joints = J1 [deg], J2 [deg]", "position = X [mm], Y [mm]", "load = Load"):
        assert part in points.guess
    vague = other_names(",".join("abcdefghi"))
    with pytest.raises(InputError, match=r"cannot be guessed: .*hilcal import .* --preview -o"):
        read_points(written(tmp_path, vague), ARM, LOADS)
    typed = f"{JOINTS},lod\n0,0,0,0,0,0,10kg\n"  # one of ours that is not
    refusal("unknown column 'lod'; valid", read_points, written(tmp_path, typed), ARM, LOADS)


@pytest.mark.parametrize("far", [False, True])
def test_a_unit_is_taken_where_the_arm_tells_it(tmp_path, far):
    """In m, or in mm of points as near as 50 mm, these would be nowhere that the arm is."""
    names, points = "X,Y,Z,J1 [deg],J2 [deg],J3 [deg],J4 [deg],J5 [deg],J6 [deg]", poses(Q)
    rows = np.hstack([1e3 * points[:, :3, 3], np.degrees(Q)])
    rows[:, :3] *= 10.0 if far else 1.0
    path = written(tmp_path, f"{names}\n" + "".join(",".join(map(str, r)) + "\n" for r in rows))
    if far:
        refusal("position: no unit stated", read_points, path, ARM, LOADS)
        return
    result = read_points(path, ARM, LOADS)
    np.testing.assert_allclose(result.target_poses[:, :3, 3], points[:, :3, 3], atol=1e-9)


def test_joint_values_alone_under_other_names(tmp_path):
    rows = "".join(";".join(f"{v:.9f}" for v in np.degrees(q)) + "\n" for q in Q)
    path = written(tmp_path, "A1;A2;A3;A4;A5;A6\n" + rows.replace(".", ","))
    points = read_points(path, ARM, LOADS)
    np.testing.assert_allclose(points.q, Q, atol=1e-9)
    assert points.target_poses is None
    assert points.wrench is None


@pytest.mark.parametrize("kind", ["csv", "xlsx", "parquet"])
def test_poses_without_joint_values_by_a_mapping(tmp_path, kind):
    """As the message on the missing convention says: --preview writes the mapping to correct."""
    goal = poses(Q)
    data = np.hstack([1e3 * goal[:, :3, 3], np.degrees(se3.rotation_vector(goal[:, :3, :3]))])
    table = pd.DataFrame(data, columns=["X [mm]", "Y [mm]", "Z [mm]", "RX [°]", "RY [°]", "RZ [°]"])
    path = tmp_path / f"points.{kind}"
    {"csv": table.to_csv, "xlsx": table.to_excel, "parquet": table.to_parquet}[kind](
        path, index=False
    )
    refusal("orientation: no convention stated", read_points, path, ARM, LOADS)
    proposed = propose(path).proposal.to_toml(path.name)
    convention = re.compile('convention = ".*"')
    assert convention.search(proposed)
    mapping = written(
        tmp_path, convention.sub('convention = "rotation-vector"', proposed), "m.toml"
    )
    points = read_points(path, ARM, LOADS, find_mapping(mapping, PointMapping))
    np.testing.assert_allclose(on_branch(points, ARM, TOOL, Q[0] + 0.1), Q, atol=1e-8)
    with pytest.raises(InputError, match="joints"):  # which readings need
        find_mapping(mapping, Mapping)


def test_a_pose_out_of_reach_is_named(tmp_path):
    text = f"pose,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad,{JOINTS}\nfar,3,0,0,0,0,0,0,-1,1,0,1,0\n"
    with pytest.raises(InputError, match=r"point far: the nominal arm does not reach it .* mm"):
        on_branch(read_points(written(tmp_path, text), ARM, LOADS), ARM, TOOL, None)


@refusals("points")
def test_tables_that_cannot_be_used_are_refused(case, given, tmp_path):
    path = written(tmp_path, given)
    refuses(case, lambda: read_points(path, ARM, LOADS), path)


def test_a_program_of_moves_has_them_as_waypoints():
    q = Q / 3
    np.testing.assert_allclose([w.q for w in waypoints(movej_program(["a", "b"], q))], q, atol=1e-9)


def test_a_program_without_waypoints_is_refused(tmp_path):
    refusal(r"p\.script: no waypoints", program_points, written(tmp_path, "x = 1\n", "p.script"))
