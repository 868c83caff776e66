"""hilcal: read the table, refine, predict with bands, name, and discover where a law is asked for.

An effect's probability is 1 / (1 + 9 exp(1 - L)): 1 : 9 the prior odds, L its log evidence, the
largest over its strength, which costs a unit; of a named effect against the model without it, of
others beside it, in a background half the restricted likelihood ratio. What could stand for a named
effect shares its probability, by their evidence.
"""

import re
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import hilcal as hc

sys.path.append(str(Path(__file__).parents[3]))
from benchmark.entrants.common import JOINTS, WRENCH, Asked, enter

CELL = """robot = {{model = "{urdf}", gravity_m_s2 = {gravity_m_s2}}}
tool = {{mass_kg = {tool[mass_kg]}, com_m = {tool[com_m]}, load_point_m = {load_point_m}}}
tracker = {{range_std_m = {std}, transverse_std_m = {std}, range_std_per_m = 0.0, transverse_std_per_m = 0.0}}
"""
WORDS = ((r"s\.angle\[:, (\d)\]", lambda m: f"q{int(m[1]) + 1}"), (r"s\.torque\[:, (\d)\]", lambda m: f"tau{int(m[1]) + 1}"),
         (r"s\.angle\[:, (\d):(\d)\]\.sum\(axis=1\)", lambda m: f"({' + '.join(f'q{j + 1}' for j in range(int(m[1]), int(m[2])))})"),
         (r"np\.linalg\.norm\(s\.states\.wrench\[:, 0:3\], axis=1\)", "force"), (r"np\.maximum", "max"), (r"np\.minimum", "min"), (r"np\.", ""), ("s.states.time", "time"), ("s.states.air_temperature", "air"))


def probabilities(path: hc.Refinement, names: list[str]) -> dict[str, float]:
    """Return the probability of each candidate."""
    said: dict[str, float] = {a.effect: a.own for a in path.diagnosis.alternatives}
    for step in reversed(path.steps):
        for s in step.diagnosis.suspects:
            said.setdefault(s.effect, s.score.log_evidence)
        for b in step.diagnosis.background:
            said.setdefault(b.effect, b.ratio / 2)
    p = {n: 1 / (1 + 9 * np.exp(1 - np.clip(said.get(n, 0.0), -30, 30))) for n in {*names, *said}}
    for a in path.diagnosis.alternatives:
        stays = 1 / (1 + np.exp(np.clip(a.log_evidence - a.own - len(a.others) + 1, -30, 30)))
        p |= {n: max(p.get(n, 0.0), 1 - stays) for n in a.others}
        p[a.effect] = min(p[a.effect], stays)
    return {n: float(p[n]) for n in names}


def formula(d: Any, acts_on: str) -> dict[str, str] | None:
    """Return a law as a formula of the task's quantities, where it is one."""
    law = d.laws[0]
    at = [p for p in law.form.parts if acts_on == f"q{p.site.joint + 1}" or acts_on == "base_z"]
    text = " + ".join(f"{law.parameters[p.coefficient].value!r}*({p.amplitude.code()})" for p in at)
    for word, by in WORDS:
        text = re.sub(word, by, text)
    return {"formula": text} if text and "s." not in text and "where" not in text else None


def entrant(asked: Asked) -> dict[str, Any]:
    about, of, law, note = asked.task.about, asked.task.test.numbers, None, ""
    with TemporaryDirectory() as folder:
        file = Path(folder, "CELL.toml")
        file.write_text(CELL.format(**about["arm"], urdf=(asked.task.folder / "robot.urdf").resolve(), std=asked.sigma))
        cell = hc.Cell.load(file)
    readings = hc.read_table(asked.task.folder / "train.csv", cell)
    model = hc.baseline(cell, readings, "absolute")
    if about.get("quantities"):
        d = hc.discover(hc.fit(model, readings, "absolute"))
        note = d.reason
        if d.laws and d.after is not None:
            model, law, note = d.after.model, formula(d, about["acts_on"]), d.laws[0].formula
    path = hc.refine(model, readings, "absolute")
    named = {"time": of.get("time_s"), "air_temperature": of.get("air_degC")}
    named = {n: c for n, c in named.items() if c is not None}
    q, wrench = asked.task.test.of(JOINTS), asked.task.test.of(WRENCH)
    known = hc.Calibration.of(path.fit)
    turn = known.base_in_tracker()[:3, :3]
    covariance = turn @ known.predict(q, wrench, recorded=named).covariance @ turn.T
    there = path.fit.predict(hc.States(q, wrench, **named)).position
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    names = [c["effect"] for c in about["candidates"]]
    note = f"{path.verdict}: {' + '.join(path.fit.model.named)} {note}"
    return {"prediction_m": there, "std_m": std, "effects": probabilities(path, names) if names else None, "law": law, "note": note}


if __name__ == "__main__":
    enter(entrant)
