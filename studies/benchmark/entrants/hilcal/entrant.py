"""hilcal: read the table, refine, predict with bands, name, and discover where a law is asked for.

How its probabilities are meant: `hilcal.diagnosis.diagnosis`.
"""

# mypy: disable-error-code="attr-defined, name-defined, operator"
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import hilcal as hc

sys.path.append(str(Path(__file__).parents[3]))
from benchmark.entrants.common import JOINTS, WRENCH, TaskInput, enter  # type: ignore[import-not-found]

CELL = """robot = {{model = "{urdf}", gravity_m_s2 = {gravity_m_s2}}}
tool = {{mass_kg = {tool[mass_kg]}, com_m = {tool[com_m]}, load_point_m = {load_point_m}}}
tracker = {{range_std_m={s}, transverse_std_m={s}, range_std_per_m=0, transverse_std_per_m=0}}
repeatability.joint_std_rad = {r}
"""


def calibrated(data: TaskInput) -> dict[str, Any]:
    """Refine from the baseline, or from the baseline with a discovered law."""
    about, law, note = data.task.about, None, ""
    r = 0.0 if about["track"] in ("ur10", "ur5") else 1e-9  # no arm scatters in a simulated task
    with TemporaryDirectory() as folder:
        urdf, file = (data.task.folder / "robot.urdf").resolve(), Path(folder, "CELL.toml")
        file.write_text(CELL.format(**about["arm"], urdf=urdf, s=data.sigma, r=r), "utf-8")
        cell = hc.Cell.load(file)
    readings = hc.read_table(data.task.folder / "train.csv", cell)
    model = hc.baseline(cell, readings, "absolute")
    if "acts_on" in about:
        d = hc.discover(hc.fit(model, readings, "absolute"))
        note = f"; law: {d.reason}"
        if d.laws and d.after is not None:
            site = about["acts_on"].replace("q", "dq_")
            note, law = f"; {d.laws[0].formula}", d.laws[0].expressions.get(site)
            model = d.after.model
    path = hc.refine(model, readings, "absolute")
    test, names = data.task.test, {"time": "time_s", "air_temperature": "air_degC"}
    recorded = {n: test.numbers[c] for n, c in names.items() if c in test.numbers}
    states = hc.States(test.of(JOINTS), test.of(WRENCH), **recorded)
    calibration = hc.Calibration.of(path.fit)
    turn = calibration.base_in_tracker()[:3, :3]
    covariance = calibration.predict(states.q, states.wrench, recorded=recorded).covariance
    return {
        "prediction_m": path.fit.predict(states).position,
        "std_m": np.sqrt(np.diagonal(turn @ covariance @ turn.T, axis1=1, axis2=2)),
        "effects": path.probabilities(c["effect"] for c in about["candidates"]) or None,
        "law": {"formula": law} if law else None,
        "note": f"{path.verdict}: {' + '.join(path.fit.model.named)}{note}",
    }


if __name__ == "__main__":
    enter(calibrated)
