"""`compensate` through the command line."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

import hilcal as hc
from hilcal.calibration.programs.urscript import waypoints
from hilcal.config import load_config
from hilcal.readings.covariance import INSTRUMENT_AND_ARM
from hilcal.readings.readings import States
from hilcal.robot.chain import evaluate
from hilcal.robot.factory import with_factory
from hilcal.robot.se3 import matrix, of_six, rotation, six
from tests.support.cli_cases import CELL, ok, refused, rehearsal, stored_readings
from tests.support.factory_cases import factory_of

JOINTS = "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg"


def made(path):
    """Write a campaign without any revision."""
    config = load_config(CELL)
    heavy = config.loads[0].model_copy(update={"name": "heavy", "mass_kg": 13.0})
    config = config.model_copy(update={"loads": (*config.loads, heavy)})
    return stored_readings(path, rehearsal("nothing").readings, config, INSTRUMENT_AND_ARM)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A campaign with one revision."""
    path = made(tmp_path_factory.mktemp("compensate") / "run.hilcal")
    with hc.Campaign.open(path) as run:
        model = hc.baseline(run.cell, run.readings, "absolute")
        run.append(hc.fit(model, run.readings, "absolute"))
    return path


def table(tmp_path, run, count=3, **more):
    """Points at poses between those that were fitted."""
    with hc.Campaign.open(run, read_only=True) as opened:
        q = np.unique(opened.readings.states.q, axis=0)
    rows = np.degrees(q[:count] + 0.2 * (q[1 : count + 1] - q[:count]))
    path = tmp_path / "points.csv"
    lines = [",".join(["pose", JOINTS, *more])]
    lines += [
        ",".join([f"w{k}", *(f"{v:.9f}" for v in row), *more.values()])
        for k, row in enumerate(rows)
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_table_becomes_joint_values_that_the_model_confirms(capsys, fitted, tmp_path):
    points, out, script = table(tmp_path, fitted), tmp_path / "o.csv", tmp_path / "o.script"
    before = fitted.read_bytes()
    shown = ok(capsys, "compensate", fitted, points, "--load", "10kg", "-o", out, "-o", script)
    assert "3 points compensated" in shown.out
    assert "the arm's repeatability" in shown.out
    assert fitted.read_bytes() == before
    with out.open() as stream:
        rows = list(csv.DictReader(stream))
    assert [r["pose"] for r in rows] == ["w0", "w1", "w2"]
    q = np.array([[float(r[f"q{j}_rad"]) for j in range(1, 7)] for r in rows])
    with hc.Campaign.open(fitted, read_only=True) as run:
        c = run.calibration()
        with points.open() as stream:
            asked = np.radians([[float(v) for v in r[1:7]] for r in list(csv.reader(stream))[1:]])
        nominal = c.predict(asked, std=False).nominal_position
        reached = c.predict(q, c.loads["10kg"], std=False).position
    assert np.abs(reached - nominal).max() < 1e-8
    np.testing.assert_allclose([w.q for w in waypoints(script.read_text())], q, atol=2e-9)


def test_a_calibration_file_says_that_it_has_no_cell_to_check(capsys, fitted, tmp_path):
    arm, points = tmp_path / "arm.json", table(tmp_path, fitted)
    ok(capsys, "export", fitted, "--calibration", arm)
    said = " ".join(ok(capsys, "compensate", arm, points).err.split())
    assert f"note: {arm}: a calibration does not have the cell's workspace" in said
    assert "was not checked" not in ok(capsys, "compensate", fitted, points).err


def test_points_without_a_load_get_nothing_of_deflections(capsys, fitted, tmp_path):
    arm, points = tmp_path / "arm.json", table(tmp_path, fitted)
    replace(hc.Calibration.load(fitted), mode="deflection").save(arm)
    words = "no point has a load, and a calibration of deflections corrects nothing else"
    assert words in " ".join(ok(capsys, "compensate", arm, points).err.split())
    assert words not in " ".join(ok(capsys, "compensate", arm, points, "--load", "5kg").err.split())
    assert words not in " ".join(ok(capsys, "compensate", fitted, points).err.split())


def test_a_program_is_rewritten_and_a_calibration_file_will_do(capsys, fitted, tmp_path):
    ok(capsys, "export", fitted, "--calibration", tmp_path / "arm.json")
    with hc.Campaign.open(fitted, read_only=True) as run:
        q = run.readings.states.q[:1] + 0.01
        first = ", ".join(f"{v:.9f}" for v in q[0])
    program = tmp_path / "p.script"
    program.write_text(f"set_tcp(p[0.06,0.02,0.12,0,0,0])\nmovel([{first}], a=1)\n")
    out = tmp_path / "new.script"
    document = ok(
        capsys, "compensate", tmp_path / "arm.json", program, "-o", out, "--json"
    ).document
    (point,) = document["points"]
    assert point["name"] == "line 2"
    assert point["residual_m"] < 1e-9
    assert 0 < point["std_m"] < point["band_m"] < 1e-3
    (waypoint,) = waypoints(out.read_text())
    other = refused(
        capsys, 2, "compensate", tmp_path / "arm.json", program, "--tool", "0 0 1 0 0 0"
    )
    assert "set_tcp is another tool than --tool" in other
    np.testing.assert_allclose(waypoint.q, point["q_corrected"], atol=1e-9)
    np.testing.assert_allclose(point["q_command"], q[0], atol=1e-9)
    assert point["expected_error_m"] == pytest.approx(point["std_m"], rel=1e-6)
    assert point["inside"] is True
    assert document["calibration"]["revision"] == 1
    assert document["written"] == [str(out)]


def test_waypoints_are_corrected_left_or_refused_and_that_is_said(capsys, fitted, tmp_path):
    with hc.Campaign.open(fitted, read_only=True) as run:
        first = ", ".join(f"{v:.9f}" for v in run.readings.states.q[0] + 0.01)
    program, out = tmp_path / "p.script", tmp_path / "new.script"
    lines = [
        f"q = [{first}]",
        "movej(q, a=1, v=1, r=0.02)",
        f"w = [{first}]",
        "w[0] = 1.57",
        "movej(w)",
        "movel([3.1, -0.1, 0.1, -3.1, -1.4, 3.1])",
    ]
    program.write_text("\r\n".join(lines) + "\r\n", newline="")
    said = refused(capsys, 2, "compensate", fitted, program, "-o", out)
    assert "p.script: line 5: the waypoint 'w' is computed" in said
    assert "--leave" in said
    assert not out.exists()
    result = ok(capsys, "compensate", fitted, program, "-o", out, "--leave", "--json")
    fates = result.document["waypoints"]
    assert [(f["line"], f["done"]) for f in fates] == [
        (2, "corrected"),
        (5, "left"),
        (6, "refused"),
    ]
    assert fates[0]["blend_m"] == 0.02
    assert "'w' has its value from lines 3, 4" in fates[1]["why"]
    assert "measured" in fates[2]["why"]
    assert "beyond" not in result.err
    assert len(result.document["points"]) == 1
    now = out.read_bytes().decode().split("\r\n")
    kept = [a == b for a, b in zip(lines, now[:-1], strict=True)]
    assert kept == [True, False, True, True, True, True]
    (q,) = [w.q for w in waypoints(now[1] + "\n")]
    np.testing.assert_allclose(q, result.document["points"][0]["q_corrected"], atol=1e-9)
    shown = ok(capsys, "compensate", fitted, program, "--leave").out
    assert "passes its place within 20" in " ".join(shown.split())
    assert "--leave is for" in refused(
        capsys, 2, "compensate", fitted, table(tmp_path, fitted), "--leave"
    )


def test_a_name_is_neither_a_line_of_a_program_nor_a_formula(capsys, fitted, tmp_path):
    points, out = table(tmp_path, fitted), tmp_path / "o.script"
    plain = points.read_text()
    evil = '"P1\n movej([0,0,0,0,0,0], a=10, v=3)\n #"'
    points.write_text(plain.replace("w1", evil))
    said = refused(capsys, 2, "compensate", fitted, points, "-o", out)
    assert "row 3, column 'pose': 'P1\\u000a movej(" in said
    assert "valid: " in said
    assert not out.exists()
    points.write_text(plain.replace("w1", "=1+1"))
    ok(capsys, "compensate", fitted, points, "-o", tmp_path / "a.csv")
    assert "\n'=1+1," in (tmp_path / "a.csv").read_text()
    kept = [line.rsplit(",", 3)[0] for line in (tmp_path / "a.csv").read_text().splitlines()]
    points.write_text("\n".join(kept) + "\n")
    document = ok(capsys, "compensate", fitted, points, "--json").document
    assert [point["name"] for point in document["points"]] == ["w0", "=1+1", "w2"]


def test_what_may_be_another_motion_than_meant_is_said(capsys, fitted, tmp_path):
    """A pose far from its joint values, another payload, a place that the cell does not allow."""
    points, program = tmp_path / "points.csv", tmp_path / "p.script"
    with hc.Campaign.open(fitted, read_only=True) as run:
        q = run.readings.states.q[0]
        tool = run.calibration().predict(q, std=False).nominal_position[0]
    joints, place = (",".join(map(str, x)) for x in (q, tool - np.array([0.0, 0.0, 0.03])))
    head = f"pose,{JOINTS.replace('deg', 'rad')}"
    points.write_text(f"{head}\nw,{joints}\n")
    quiet = ok(capsys, "compensate", fitted, points).err
    assert "warning" not in quiet
    assert "joint values and a pose" not in quiet
    points.write_text(f"{head},x_m,y_m,z_m\nw,{joints},{place}\n")
    said = " ".join(ok(capsys, "compensate", fitted, points, "--allow-outside").err.split())
    assert "note: " in said
    assert "w has joint values and a pose, 30.0 mm from where the nominal arm" in said
    low = "0,0.4,0.3,0,0.5,0"
    points.write_text(f"{head}\nlow,{low}\nlow too,{low}\n")
    said = " ".join(ok(capsys, "compensate", fitted, points, "--allow-outside").err.split())
    assert "does not allow low: forearm is 0.525 m outside the workspace" in said
    assert "(and 1 more points)" in said
    hanging = "0,-0.3,0.3,0,1.5,0"
    points.write_text(f"{head},load\nbare,{hanging},none\nhung,{hanging},5kg\n")
    said = " ".join(ok(capsys, "compensate", fitted, points, "--allow-outside").err.split())
    assert "does not allow hung: what hangs (5kg) is 0.105 m outside" in said
    assert "more points" not in said
    points.write_text(f"{head},load\nbare,{joints},\nmuch,{joints},heavy\n")
    said = " ".join(ok(capsys, "compensate", fitted, points, "--allow-outside").err.split())
    assert "tool and load are 13.8 kg; the payload of ur10e is 12.5 kg" in said
    program.write_text(f"def weld():\n  set_payload(5.8)\n  movej([{joints}])\nend\n")
    said = " ".join(ok(capsys, "compensate", fitted, program).err.split())
    assert "it sets a payload of 5.8 kg, and is corrected for 0.8 kg" in said
    assert "payload" not in ok(capsys, "compensate", fitted, program, "--load", "5kg").err
    for gravity, warns in (("0, 0, 9.82", False), ("0, 6.9, 6.9", True), ("0, 0, -9.82", True)):
        program.write_text(f"set_gravity([{gravity}])\nmovej([{joints}])\n")
        said = " ".join(ok(capsys, "compensate", fitted, program).err.split())
        assert ("from [robot] gravity_m_s2 of the cell" in said) == warns


KRL = """DEF weld( )
DECL FDAT FP1={{TOOL_NO 1,BASE_NO 0,IPO_FRAME #BASE}}
LOAD_DATA[1]={{M {},CM {{X 0,Y 0,Z 60,A 0,B 0,C 0}},J {{X 0,Y 0,Z 0}}}}
{}
PTP {{{}}}
END
"""
RAPID = r"""MODULE Weld
PERS tooldata tGun:=[TRUE,[[0,0,0],[1,0,0,0]],[{},[0,0,60],[1,0,0,0],0,0,0]];
PERS loaddata lPart:=[5,[0,0,60],[1,0,0,0],0,0,0];
PROC main()
{}MoveAbsJ [[{}],[9E9,9E9,9E9,9E9,9E9,9E9]]{},v100,fine,tGun;
ENDPROC
ENDMODULE
"""


@pytest.mark.parametrize(
    ("suffix", "text", "mass"),
    [
        (".src", KRL.format(5.8, "BAS(#TOOL,1)", "{}"), 5.8),
        (".src", KRL.format(5.8, "FDAT_ACT=FP1\nBAS(#PTP_PARAMS,100)", "{}"), 5.8),
        (".src", KRL.format(1, "$LOAD = {M 5.8,CM {X 0,Y 0,Z 0,A 0,B 0,C 0}}", "{}"), 5.8),
        (".src", KRL.format(1, "$LOAD.M = 5.8", "{}"), 5.8),
        (".src", KRL.format(1, "$LOAD.M = 5.8 + X", "{}"), None),  # computed
        (".src", KRL.format(-1, "BAS(#TOOL,1)", "{}"), None),  # not stated
        (".src", KRL.format(1, "$TOOL = $NULLFRAME", "{}"), None),
        (".mod", RAPID.format(5.8, "", "{}", ""), 5.8),
        (".mod", RAPID.format(0.8, "GripLoad lPart;", "{}", ""), 5.8),
        (".mod", RAPID.format(5.8, "GripLoad load0;", "{}", ""), 5.8),
        (".mod", RAPID.format(5.8, "GripLoad lOther;", "{}", ""), None),
        (".mod", RAPID.format(5.8, "", "{}", r"\TLoad:=lPart"), 5.0),
        (".mod", RAPID.format(-1, "", "{}", ""), None),
    ],
)
def test_a_mass_that_a_program_of_another_maker_states_is_compared(
    capsys, fitted, tmp_path, suffix, text, mass
):
    with hc.Campaign.open(fitted, read_only=True) as run:
        values = [f"{q:.9f}" for q in np.degrees(run.readings.states.q[0])]
    if suffix == ".src":
        values = [f"A{k} {q}" for k, q in enumerate(values, start=1)]
    program = tmp_path / f"weld{suffix}"
    program.write_text(text.replace("{}", ",".join(values)))
    said = " ".join(ok(capsys, "compensate", fitted, program).err.split())
    assert ("sets a payload" in said) == (mass is not None)
    if mass is not None:
        assert f"sets a payload of {mass:.4g} kg, and is corrected for 0.8 kg" in said
    if mass == 5.8:
        assert "payload" not in ok(capsys, "compensate", fitted, program, "--load", "5kg").err


def test_points_outside_are_refused_by_name_unless_told_otherwise(capsys, fitted, tmp_path):
    points = table(
        tmp_path, fitted, fx_N="0", fy_N="0", fz_N="-400", mx_Nm="0", my_Nm="0", mz_Nm="0"
    )
    out = tmp_path / "o.csv"
    said = refused(capsys, 4, "compensate", fitted, points, "-o", out)
    assert "3 of 3 points are refused: w0: force 400 N, measured 0 to " in said
    assert "--allow-outside" in said
    assert not out.exists()
    ok(capsys, "compensate", fitted, points, "-o", out, "--allow-outside")
    assert out.exists()


def test_a_load_as_the_force_sensor_reads_it_is_the_load(capsys, fitted, tmp_path):
    points = table(tmp_path, fitted)
    ok(capsys, "export", fitted, "--calibration", tmp_path / "arm.json")
    ok(capsys, "compensate", fitted, points, "--load", "10kg", "-o", tmp_path / "named.csv")
    c = hc.Calibration.load(tmp_path / "arm.json")
    lines = points.read_text().splitlines()
    q = np.radians([[float(v) for v in line.split(",")[1:]] for line in lines[1:]])
    # what a 10 kg weight does to a sensor: its force, and the moment of it about the sensor
    flange = evaluate(c.model.cell.arm, q)
    weight = c.loads["10kg"][:3]
    to_sensor = flange.rotation[-1] @ rotation(c.sensor.rotvec_rad)
    lever = flange.rotation[-1] @ (c.model.cell.load_point - c.sensor.origin_m)
    felt = [
        np.concatenate([r.T @ weight, r.T @ np.cross(a, weight)])
        for r, a in zip(to_sensor, lever, strict=True)
    ]
    np.testing.assert_allclose(c.load_wrench(q, np.array(felt)), [c.loads["10kg"]] * 3, atol=1e-9)
    names = ",".join(f"sensor_{n}" for n in ("fx_N", "fy_N", "fz_N", "mx_Nm", "my_Nm", "mz_Nm"))
    rows = [
        f"{line},{','.join(map(repr, map(float, f)))}"
        for line, f in zip(lines[1:], felt, strict=True)
    ]
    points.write_text("\n".join([f"{lines[0]},{names}", *rows]) + "\n")
    ok(capsys, "compensate", tmp_path / "arm.json", points, "-o", tmp_path / "felt.csv")
    assert (tmp_path / "felt.csv").read_text() == (tmp_path / "named.csv").read_text()
    two = refused(capsys, 2, "compensate", fitted, points, "--load", "10kg")
    assert "more than one load is given" in two


def test_every_command_counts_from_one_base_which_is_the_worlds(capsys, fitted, tmp_path):
    """A pose in the base that is handed over, corrected, is where the simulated tracker has it."""
    frames_file = tmp_path / "frames.json"
    exported = ok(
        capsys, "export", fitted, "--frames", frames_file, "--urdf", tmp_path / "a.urdf"
    ).out
    shown = next(line for line in exported.splitlines() if line.startswith("The robot's base: at"))
    frames = json.loads(frames_file.read_text())
    base, tool = (of_six(frames[k]) for k in ("base_in_tracker", "tool_on_flange"))
    assert frames["controller"]["base_in_tracker_m_rad"] == frames["base_in_tracker"]
    world = rehearsal("nothing").world
    np.testing.assert_allclose(base, world.registration, atol=5e-5)
    with hc.Campaign.open(fitted, read_only=True) as run:
        arm, q = run.cell.arm, np.unique(run.readings.states.q, axis=0)[:8]
        load = run.calibration().loads["10kg"]
    chain = evaluate(arm, q)
    asked = matrix(chain.rotation[-1], chain.position[-1]) @ tool
    rows = [[*np.degrees(a), *six(t)] for a, t in zip(q, asked, strict=True)]
    points = tmp_path / "poses.csv"
    lines = [f"{JOINTS},x_m,y_m,z_m,rx_rad,ry_rad,rz_rad"]
    points.write_text("\n".join(lines + [",".join(f"{v:.12g}" for v in r) for r in rows]))
    words = ok(capsys, "compensate", fitted, points, "--load", "10kg").out
    assert " ".join(shown.split()) in " ".join(words.split())
    document = ok(capsys, "compensate", fitted, points, "--load", "10kg", "--json").document
    assert document["base_in_tracker"] == frames["base_in_tracker"]
    assert document["base_is"] == frames["base_is"] == "mechanical"
    corrected = np.array([p["q_corrected"] for p in document["points"]])
    read = world.ideal_readings(States(corrected, np.tile(load, (len(q), 1)))).value(3)
    off = np.linalg.norm((read - base[:3, 3]) @ base[:3, :3] - asked[:, :3, 3], axis=1)
    assert np.all(off <= [p["band_m"] for p in document["points"]])
    assert document["error_before"]["mean_m"] > 20 * off.mean()
    report = tmp_path / "r.html"
    ok(capsys, "report", fitted, "-o", report)
    assert "the nominal arm on it has the axis of joint 1" in report.read_text()


def test_a_pose_of_a_program_is_by_the_controllers_own_kinematics(capsys, fitted, tmp_path):
    """The controller goes where its own arm has the tool; that is where the correction begins."""
    file, factory = tmp_path / "arm.json", factory_of("ur10e")
    ok(capsys, "export", fitted, "--calibration", file)
    with hc.Campaign.open(fitted, read_only=True) as run:
        q = run.readings.states.q[0] + 0.01
        c, nominal = run.calibration(), run.cell.arm
    tool = of_six([0.06, 0.02, 0.12, 0.0, 0.0, 0.0])
    theirs = with_factory(nominal, factory)

    def pose_by(arm, q):
        chain = evaluate(arm, np.atleast_2d(q))
        return matrix(chain.rotation[-1], chain.position[-1])[0] @ tool

    pose = pose_by(theirs, q)
    program = tmp_path / "p.script"
    numbers = ", ".join(f"{v:.12f}" for v in six(pose))
    joints = ", ".join(f"{v:.9f}" for v in q)
    program.write_text(
        "set_tcp(p[0.06,0.02,0.12,0,0,0])\n"
        f"movej(get_inverse_kin(p[{numbers}], qnear=[{joints}]), a=1)\n"
        f"movej([{joints}], a=1)\n"
    )
    content = json.loads(file.read_text())
    (plain,) = ok(capsys, "compensate", file, program, "--json").document["points"][:1]
    content["source"]["kinematics"] = factory.to_dict()
    file.write_text(json.dumps(content))
    first, second = ok(capsys, "compensate", file, program, "--json").document["points"]
    np.testing.assert_allclose(first["q_command"], q, atol=1e-8)  # as the controller takes it
    assert np.abs(np.array(plain["q_command"]) - q).max() > 1e-5  # the nominal arm takes another
    np.testing.assert_allclose(plain["q_corrected"], first["q_corrected"], atol=1e-7)
    there = c.predict(np.array(first["q_corrected"]), tool=tool, std=False)
    np.testing.assert_allclose(there.position[0], pose[:3, 3], atol=1e-8)
    before = c.predict(q, tool=tool, std=False).position[0]
    assert np.linalg.norm(before - pose[:3, 3]) > 1e-4
    at_joints = c.predict(np.array(second["q_corrected"]), tool=tool, std=False).position[0]
    np.testing.assert_allclose(at_joints, pose_by(nominal, q)[:3, 3], atol=1e-8)
    content["source"]["kinematics"] = {"a_m": "far"}
    file.write_text(json.dumps(content))
    assert "not the kinematics" in refused(capsys, 2, "compensate", file, program)
