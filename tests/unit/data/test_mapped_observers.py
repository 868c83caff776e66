"""Foreign tables of distances, heights, stations and torques, by a mapping and by its proposal."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.config import load_config
from hilcal.errors import InputError
from hilcal.identification.noise.full_covariance import with_joint_scatter
from hilcal.identification.registration.table_preview import preview_table
from hilcal.identification.torques import check_torques
from hilcal.tables.importing import import_readings
from hilcal.tables.mapping import Mapping
from hilcal.toml import check_section
from tests.support.campaigns import cell_of, configuration, true_parameters
from tests.support.cli_cases import CELL, ok
from tests.support.fit_cases import fitted_model, parameters_by_effect
from tests.support.observer_cases import observed
from tests.support.refusals import refusal

JOINTS = [f"Achse {k} [°]" for k in range(1, 7)]
MOMENTS = [f"Drehmoment A{k} [Nmm]" for k in range(1, 7)]
POSITION = ["X [mm]", "Y [mm]", "Z [mm]"]
TORQUES = {"columns": MOMENTS, "unit": "Nmm", "of": "load"}
BAR = {
    "file": {"separator": ";", "decimal": ","},
    "joints": {"columns": JOINTS, "unit": "deg"},
    "pose": {"column": "Messpunkt"},
    "load": {"column": "Last"},
    "distance": {"column": "Abstand [mm]", "unit": "mm", "name_column": "Kugel",
        "std_column": "Unsicherheit Abstand [µm]", "std_unit": "um"},
}  # fmt: skip


def measured(who, seed):
    """Readings with the torques that hold the arm, N·m."""
    c = observed(who, seed, base=who[0] in "ABCD")
    torque = -c.world.drive_torque(c.readings.states)
    return replace(
        c, readings=replace(c.readings, states=replace(c.readings.states, torque=torque))
    )


def german(r):
    """The table as a German program writes it: torques are those of the load, in N·mm."""
    kinds = [o.kind for o in r.observers]
    head = ["Messpunkt", "Last", *JOINTS, *MOMENTS]
    head += ["Standpunkt", *POSITION] * ("station" in kinds)
    head += ["Abstand [mm]", "Kugel", "Unsicherheit Abstand [µm]"] * ("point" in kinds)
    head += ["Messuhr [mm]", "Ebene"] * ("gauge" in kinds)
    lines = [";".join(head)]
    for i in range(len(r)):
        of, load = r.observers[r.observer[i]], r.load_names[r.load[i]]
        row = [r.pose_names[r.pose[i]], "ohne" if load == "none" else load]
        row += [f"{v:.7f}" for v in np.rad2deg(r.states.q[i])]
        row += [f"{-1e3 * v:.4f}" for v in r.states.torque[i]]
        number, blank = [f"{1e3 * v:.6f}" for v in r.value[i]], [""] * 3
        if "station" in kinds:
            row += [of.name, *number] if of.kind == "station" else ["", *blank]
        std = f"{1e6 * np.sqrt(r.covariance[i, 0, 0]):.3f}"
        if "point" in kinds:
            row += [number[0], of.name, std] if of.kind == "point" else blank
        if "gauge" in kinds:
            row += [number[0], of.name] if of.kind == "gauge" else blank[:2]
        lines.append(";".join(row).replace(".", ","))
    return "\n".join(lines) + "\n"


def imported(path, sections, cell=CELL):
    mapping = check_section(sections, Mapping, "mapping")
    return import_readings(path, mapping, load_config(cell), cell_of().arm).readings


def same(found, true):
    by = [found.observers[k].name for k in found.observer]
    assert by == [true.observers[k].name for k in true.observer]
    np.testing.assert_allclose(found.value, true.value, atol=1e-9)
    np.testing.assert_allclose(found.states.q, true.states.q, atol=2e-9)
    np.testing.assert_allclose(found.states.torque, true.states.torque, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_a_ball_bars_table_gives_the_true_compliances(seed, tmp_path):
    c = measured(["A", "B", "C"], seed)
    (tmp_path / "t.csv").write_text(german(c.readings))
    result = imported(tmp_path / "t.csv", BAR | {"torques": TORQUES})
    same(result, c.readings)
    np.testing.assert_allclose(result.covariance, c.readings.covariance, rtol=1e-6)
    wrench = replace(result.states, wrench=c.readings.states.wrench)  # of a load named alone
    joint_std = configuration().repeatability.per_joint(6)
    readings = with_joint_scatter(c.cell, replace(result, states=wrench), joint_std)
    fitted = fitted_model(c.cell, readings, "absolute")
    truth = true_parameters(c.world, "joint_compliance")
    compliances = [
        v for k, v in parameters_by_effect(fitted).items() if k.startswith("joint_compliance")
    ]
    z = np.array([(value - t) / std for (value, std), t in zip(compliances, truth, strict=True)])
    assert np.sqrt(np.mean(z**2)) < 2.5
    assert 0.75 < fitted.variance_factor < 1.3
    torques = check_torques(c.cell, readings)
    assert not any(f.differs for f in torques.factors)


def test_stations_and_heights_beside_distances(tmp_path):
    c = measured(["S1", "S2", "A", "G"], 1)
    (tmp_path / "t.csv").write_text(german(c.readings))
    (tmp_path / "c.toml").write_text(CELL.read_text() + "\n[gauges.G]\nstd_m = 1e-5\n")
    more = {
        "torques": TORQUES,
        "position": {"columns": POSITION, "unit": "mm"},
        "station": {"column": "Standpunkt"},
        "std": {"values": [0.03], "unit": "mm"},
        "gauge": {"column": "Messuhr [mm]", "unit": "mm", "name": "G"},
    }
    result = imported(tmp_path / "t.csv", BAR | more, tmp_path / "c.toml")
    same(result, c.readings)
    np.testing.assert_allclose(result.covariance[result.scalar, 0, 0], 1e-10, rtol=1e-6)
    np.testing.assert_allclose(result.covariance[~result.scalar][:, 1, 1], 9e-10, rtol=1e-6)
    refusal(r"nothing states the noise of gauge G", imported, tmp_path / "t.csv", BAR | more)


@pytest.mark.parametrize("who", [["A", "B", "C"], ["S1", "S2", "A", "G"]])
def test_a_preview_proposes_the_mapping(who, tmp_path, capsys):
    c = measured(who, 2)
    (tmp_path / "t.csv").write_text(german(c.readings))
    (tmp_path / "c.toml").write_text(CELL.read_text() + "\n[gauges.G]\nstd_m = 1e-5\n")
    preview = preview_table(tmp_path / "t.csv", cell_of())
    assert not preview.proposal.missing
    assert any('of = "load"' in words for _, words in preview.proposal.doubts)
    sections = preview.proposal.sections
    sections["torques"]["of"] = "load"
    same(imported(tmp_path / "t.csv", sections, tmp_path / "c.toml"), c.readings)
    (tmp_path / "m.toml").write_text(preview.proposal.to_toml("t.csv"))
    given = [tmp_path / "t.csv", "--config", tmp_path / "c.toml", "--format", tmp_path / "m.toml"]
    assert "distances from A" in " ".join(
        ok(capsys, "import", *given, "-o", tmp_path / "r.hilcal").out.split()
    )


def test_a_table_of_joint_angles_and_one_number_without_names_is_of_distances(tmp_path, capsys):
    r = measured(["A"], 3).readings
    rows = np.column_stack([np.rad2deg(r.states.q), 1e3 * r.value[:, 0]])
    np.savetxt(tmp_path / "cable.txt", rows, fmt="%.4f")
    (tmp_path / "c.toml").write_text(CELL.read_text() + "\n[points.A]\nstd_m = 1e-4\n")
    preview = preview_table(tmp_path / "cable.txt", cell_of())
    assert not preview.proposal.missing
    assert {where for where, _ in preview.proposal.doubts} >= {"joints", "distance"}
    (tmp_path / "m.toml").write_text(preview.proposal.to_toml("cable.txt"))
    table = imported(tmp_path / "cable.txt", preview.proposal.sections, tmp_path / "c.toml")
    np.testing.assert_allclose(table.value[:, 0], r.value[:, 0], atol=1e-7)
    given = [tmp_path / "cable.txt", "--config", tmp_path / "c.toml"]
    out = ok(
        capsys, "import", *given, "--format", tmp_path / "m.toml", "-o", tmp_path / "r.hilcal"
    ).out
    assert "distances from A" in " ".join(out.split())
    assert "rounded" not in out  # 0.0001° is 0.5 µm at the target, the noise 100 µm


@pytest.mark.parametrize(("sections", "message"), [
    ({"distance": {"column": "d", "unit": "mm"}}, "name_column or name: give one"),
    ({"distance": None}, r"no reading: it must be a section \[position\]"),
    ({"std": {"values": [0.1]}}, r"\[std\], .* need \[position\]"),
    ({"rows": {"plausible_only": True}}, "give those in a table of their own"),
    ({"torques": TORQUES | {"columns": MOMENTS[:4]}}, "4 columns of torques; .* has 6 joints"),
])  # fmt: skip
def test_mappings_that_cannot_be(sections, message, tmp_path):
    (tmp_path / "t.csv").write_text(german(measured(["A", "B", "C"], 0).readings))
    with pytest.raises(InputError, match=message):
        imported(tmp_path / "t.csv", {k: v for k, v in (BAR | sections).items() if v is not None})


def test_rows_without_a_reading_are_left_out_and_a_negative_deviation_is_named(tmp_path):
    c = measured(["A", "B", "C"], 0)
    lines = german(c.readings).splitlines()
    cells = lines[5].split(";")
    lines[5] = ";".join([*cells[:-3], "", "", ""])
    (tmp_path / "t.csv").write_text("\n".join(lines))
    assert len(imported(tmp_path / "t.csv", BAR)) == len(c.readings) - 1
    lines[5] = ";".join([*cells[:-1], "-3"])
    (tmp_path / "t.csv").write_text("\n".join(lines))
    refusal(r"row 6, column 'Abstand .*deviation is below 0", imported, tmp_path / "t.csv", BAR)
