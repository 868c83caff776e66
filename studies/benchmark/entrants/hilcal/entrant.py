"""hilcal: read the table, refine, predict with bands, name, and discover where a law is asked for.

An effect's probability is 1 / (1 + 9 exp(1 - L)): 1 : 9 the prior odds, L its log evidence, the
largest over its strength, which costs a unit; of a named effect against the model without it, of
others beside it, in a background half the restricted likelihood ratio. What could stand for a named
effect shares its probability, by their evidence.
"""

# mypy: disable-error-code="attr-defined, name-defined, operator"
import re
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import hilcal as hc

sys.path.append(str(Path(__file__).parents[3]))
from benchmark.entrants.common import JOINTS, WRENCH, Asked, enter  # type: ignore[import-not-found]

CELL = """robot = {{model = "{urdf}", gravity_m_s2 = {gravity_m_s2}}}
tool = {{mass_kg = {tool[mass_kg]}, com_m = {tool[com_m]}, load_point_m = {load_point_m}}}
tracker = {{range_std_m={s}, transverse_std_m={s}, range_std_per_m=0, transverse_std_per_m=0}}
repeatability.joint_std_rad = {r}
"""
NAMES = {"angle": "q", "torque": "tau"}
JOINT = re.compile(r"s\.(angle|torque)\[:, (\d)(?::(\d))?\](\.sum\(axis=1\))?")


def probabilities(path: hc.Refinement, names: list[str]) -> dict[str, float] | None:
    """Return the probability of each candidate; None without candidates."""
    said: dict[str, float] = {a.effect: a.own for a in path.diagnosis.alternatives}
    for step in reversed(path.steps):
        said = {b.effect: b.ratio / 2 for b in step.diagnosis.background} | said
        said = {s.effect: s.score.log_evidence for s in step.diagnosis.suspects} | said
    p = {n: 1 / (1 + 9 * np.exp(1 - np.clip(said.get(n, 0.0), -30, 30))) for n in {*names, *said}}
    for a in path.diagnosis.alternatives:
        stays = 1 / (1 + np.exp(np.clip(a.log_evidence - a.own - len(a.others) + 1, -30, 30)))
        p |= {n: max(p.get(n, 0.0), 1 - stays) for n in a.others}
        p[a.effect] = min(p[a.effect], stays)
    return {n: float(p[n]) for n in names} or None


def formula(law: Any, acts_on: str) -> dict[str, str] | None:
    """Return a law as a formula of the task's quantities, where it is one."""
    at = [p for p in law.form.parts if acts_on in (f"q{p.site.element + 1}", "base_z")]
    text = " + ".join(f"{law.parameters[p.coefficient].value!r}*({p.amplitude.code()})" for p in at)

    def joints(m: re.Match[str]) -> str:
        last = int(m[3] or int(m[2]) + 1)
        return "(" + " + ".join(f"{NAMES[m[1]]}{j + 1}" for j in range(int(m[2]), last)) + ")"

    text = JOINT.sub(joints, text).replace("np.maximum", "max")
    text = re.sub(r"np\.linalg\.norm\(s\.states\.wrench\[:, 0:3\], axis=1\)", "force", text)
    text = re.sub(r"s\.states\.(time|air)(_temperature)?|np\.", r"\1", text)
    return {"formula": text} if text and "s." not in text and "where" not in text else None


def calibrated(asked: Asked) -> dict[str, Any]:
    """Refine from the baseline, or from the law that is found beside it."""
    about, law, note = asked.task.about, None, ""
    r = 0.0 if about["track"] in ("ur10", "ur5") else 1e-9  # no arm scatters in a simulated task
    with TemporaryDirectory() as folder:
        urdf, file = (asked.task.folder / "robot.urdf").resolve(), Path(folder, "CELL.toml")
        file.write_text(CELL.format(**about["arm"], urdf=urdf, s=asked.sigma, r=r), "utf-8")
        cell = hc.Cell.load(file)
    readings = hc.read_table(asked.task.folder / "train.csv", cell)
    model = hc.baseline(cell, readings, "absolute")
    if "acts_on" in about:
        d = hc.discover(hc.fit(model, readings, "absolute"))
        note = f"; law: {d.reason}"
        if d.laws and d.after is not None:
            note, law = f"; {d.laws[0].formula}", formula(d.laws[0], about["acts_on"])
            model = d.after.model
    path = hc.refine(model, readings, "absolute")
    of, names = asked.task.test, {"time": "time_s", "air_temperature": "air_degC"}
    recorded = {n: of.numbers[c] for n, c in names.items() if c in of.numbers}
    states = hc.States(of.of(JOINTS), of.of(WRENCH), **recorded)
    known = hc.Calibration.of(path.fit)
    turn = known.base_in_tracker()[:3, :3]
    covariance = known.predict(states.q, states.wrench, recorded=recorded).covariance
    return {
        "prediction_m": path.fit.predict(states).position,
        "std_m": np.sqrt(np.diagonal(turn @ covariance @ turn.T, axis1=1, axis2=2)),
        "effects": probabilities(path, [c["effect"] for c in about["candidates"]]),
        "law": law,
        "note": f"{path.verdict}: {' + '.join(path.fit.model.named)}{note}",
    }


if __name__ == "__main__":
    enter(calibrated)
