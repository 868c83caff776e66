"""A new lab's first day, as the README leads it: each claim that is printed, held to the truth.

`init`, `plan`, `run --rehearse`, `refine`, `next`, `report`, `compensate`, `export` and the table
of a colleague, each at a terminal of 80 columns, in a simulated cell with a hidden effect. What the
words tell to do next is done.
"""

import csv
import html
import json
import re
import shlex
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

import hilcal as hc
from hilcal.calibration.programs.urscript import waypoints
from hilcal.config import load_config
from hilcal.drivers.simulated.mechanics import displacement
from hilcal.drivers.simulated.rehearsal import (
    SimulationCase,
    case_of_plan,
    measurement_noise,
    simulate_plan,
)
from hilcal.readings.readings import States
from hilcal.robot.catalogue import load_arm
from hilcal.robot.se3 import inverse, of_six, rotation
from hilcal.store.plan import load_plan
from tests.support.campaign_cases import STARVED
from tests.support.foreign_tables import lines as table_of
from tests.support.foreign_tables import write
from tests.support.screen import AtTerminal
from tests.unit.calibration.other_eyes import by_pinocchio, flanges, urdf_model
from tests.unit.calibration.test_base import by_ur, pose, true_positions

pytestmark = pytest.mark.slow
HIDDEN, SEED, POSES, RUN = "link_geometry", 5, 20, "rehearsal.hilcal"
LONG = 1200.0
"""A command may take so long on a busy machine, s."""
ONE_SCREEN = 40
LENGTHS = {"nm": 1e-9, "µm": 1e-6, "mm": 1e-3, "m": 1.0}
ANSWERS = (
    ("Which arm?", "ur10e"),
    ("Address of its controller", ""),
    ("What pose repeatability", "0.05 mm"),
    ("Which tracker?", "geocom"),
    ("Its serial port", ""),
    ("How accurate is the tracker?", "10 um + 5 um/m"),
    ("Which force sensor", ""),
    ("Where does the target sit?", "60 mm, 20 mm, 120 mm"),
    ("Where do loads act?", "100 mm, 0 mm, 150 mm"),
    ("Mass of the tool", "0.8 kg"),
    ("Its centre of mass", "10 mm, 0 mm, 60 mm"),
    ("Which loads are at hand?", "10 kg"),
    ("Another one", "pull x = 80 N, 0 N, 0 N"),
    ("Another one", ""),
    ("What is to be calibrated?", ""),
    ("What height", "0.05"),
    ("Where does the tracker stand", "3, 0.5, 0.9"),
)
CELL = (
    ('#hide = "creep"', f'hide = "{HIDDEN}"\nstrength_sigma = 20.0\nseed = {SEED}'),
    ("#candidates = 2000", "candidates = 150\nagainst = []"),
)
"""What the simulated cell is told in CELL.toml, and what makes plans fast."""


@dataclass(frozen=True, slots=True)
class Said:
    """What one command has printed."""

    code: int
    lines: list[str]

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.lines).split())

    @property
    def steps(self) -> list[list[str]]:
        """Commands to copy that it ends with, as words without "hilcal"."""
        commands = [line.strip() for line in self.lines if line.startswith("  hilcal ")]
        commands += re.findall(r"(?:[Gg]o on with|on with): (hilcal [^,]*\S)", self.text)
        return [shlex.split(line)[1:] for line in commands]

    def number(self, pattern: str) -> float:
        """A number that stands in a pattern, or a length in m."""
        match = re.search(pattern, self.text)
        unit = match[2] if len(match.groups()) > 1 else "m"
        return float(match[1]) * LENGTHS[unit]


def at_terminal(home, *words, code=0):
    """Run a command there; it ends with the exit code, within 80 columns and without a rest."""
    with AtTerminal(*words, home=home, paper=300) as t:
        outcome = Said(t.wait_for_end(LONG), [line.rstrip() for line in t.lines])
    assert outcome.code == code, "\n".join(outcome.lines)
    assert "Traceback" not in outcome.text
    assert not re.search("[\u2800-\u28ff]", outcome.text)  # a spinner that nobody wiped away
    wide = [x for x in outcome.lines if len(x) > 80 and not x.startswith("  hilcal ")]
    assert not wide
    return outcome


@dataclass(frozen=True, slots=True, eq=False)
class Day:
    """A lab after its first campaign: where its files are, the truth, what it was told."""

    home: Path
    secret: SimulationCase
    said: dict[str, Said]

    def at(self, *words: str, code: int = 0) -> Said:
        return at_terminal(self.home, *words, code=code)

    def calibration(self) -> hc.Calibration:
        with hc.Campaign.open(self.home / RUN, read_only=True) as run:
            return run.calibration()

    def states(self, load: str | None = None) -> States:
        """States that were measured; under one load, each on the way to the next one."""
        with hc.Campaign.open(self.home / RUN, read_only=True) as run:
            r = run.readings
        if load is None:
            return r.states
        under_load = r.states[r.load == r.load_names.index(load)]
        order = np.lexsort(under_load.q.T[::-1])
        q = under_load.q[order]
        return replace(under_load[order][:-1], q=0.85 * q[:-1] + 0.15 * q[1:])


@pytest.fixture(scope="module")
def day(tmp_path_factory):
    home = tmp_path_factory.mktemp("lab")
    plan, run, check = asked(home).steps
    at_terminal(home, *check[:2], code=2)  # init has said what it lacks
    cell = home / "CELL.toml"
    text = cell.read_text(encoding="utf-8")
    for old, new in CELL:
        assert old in text
        text = text.replace(old, new)
    cell.write_text(text, encoding="utf-8")
    planned = at_terminal(home, *plan, "--poses", str(POSES))
    measured = rehearsed(home, run)
    (refine,) = measured.steps
    refined = at_terminal(home, *refine)
    config, made = load_config(cell), load_plan(home / "plan.json")
    secret = case_of_plan(config, made, HIDDEN, SEED)
    return Day(home, secret, {"plan": planned, "run": measured, "refine": refined})


def asked(home):
    with AtTerminal("init", home=home, paper=300) as t:
        for k, (question, answer) in enumerate(ANSWERS):
            t.wait_for_words(question, 1 + [q for q, _ in ANSWERS[:k]].count(question))
            t.type_keys(f"{answer}\n")
        assert t.wait_for_end() == 0
        assert max(map(len, t.lines)) <= 80
        return Said(0, t.lines)


def rehearsed(home, words):
    """Measure; where this computer was too busy for the devices, go on as is said."""
    for _ in range(8):
        with AtTerminal(*words, home=home, paper=300) as t:
            outcome = Said(t.wait_for_end(LONG), t.lines)
        if outcome.code == 0:
            return outcome
        assert outcome.code == 3, outcome.text
        assert STARVED.search(outcome.text), outcome.text
        words = outcome.steps[-1]
    raise AssertionError(outcome.text)


def axis_of_joint_1(secret):
    """A point of the axis, and its direction, in the tracker's frame."""
    w = secret.world
    place = w.registration @ w.cell.arm.links[0] @ displacement(w.physics.link_geometry[0])
    return place[:3, 3], place[:3, 2]


def test_the_plan_is_one_screen_and_what_it_counts_is_in_its_file(day):
    said, made = day.said["plan"], load_plan(day.home / "plan.json")
    assert len(said.lines) <= ONE_SCREEN
    assert said.number(r"poses (\d+) and the reference") == POSES == len(made.pose_names) - 1
    assert said.number(r"readings (\d+):") == len(made.steps)
    assert f"{len(made.steps)} readings are in {RUN}" in day.said["run"].text


def test_the_hidden_effect_is_named_no_other_and_the_base_is_the_worlds(day):
    said = day.said["refine"]
    assert len(said.lines) <= ONE_SCREEN
    assert "Verdict: adequate: the residual is noise." in said.text
    with hc.Campaign.open(day.home / RUN, read_only=True) as run:
        assert set(run.fit().model.named) == {"base_frame", "joint_compliance", HIDDEN}
    the_base_is_true(day, said)


def the_base_is_true(day, said, within=2e-5):
    """The base that is printed has the axis of joint 1 where the world has it."""
    match = re.search(r"base: at \((.*?)\) m, turned by the rotation vector \((.*?)\)°", said.text)
    place, turn = (np.array([float(v) for v in group.split(", ")]) for group in match.groups())
    point, direction = axis_of_joint_1(day.secret)
    assert np.linalg.norm(np.cross(place - point, direction)) < within
    off = np.cross(rotation(np.radians(turn))[:, 2], direction)
    assert np.linalg.norm(off) < within


def test_what_is_missing_is_not_measured_twice_and_the_way_on_leads_on(day):
    """Nothing is in doubt: `next` says so, and how to sharpen the model."""
    said = day.at("next", RUN, "-o", "next.json", code=4)
    assert "the model is adequate" in said.text
    more = re.search(r"plan on with: (hilcal plan .*?\.hilcal)", said.text)
    words = shlex.split(more[1])[1:]
    day.at(*words, "--poses", "3", "--quick")
    assert (day.home / words[words.index("-o") + 1]).is_file()


def test_the_report_passes_what_the_truth_passes(day):
    said = day.at("report", RUN, "-o", "report.html", "--operator", "A. Miller",
                  "--limit", "0.1 mm")  # fmt: skip
    page = html.unescape(re.sub(r"<[^>]+>", " ", (day.home / "report.html").read_text("utf-8")))
    page = " ".join(page.split())
    assert said.number(r"PASSED: (\d+) of \d+ errors") == len(day.states())
    match = re.search(r"expanded uncertainty U = ([\d.]+) (µm|mm) \(3-D, k = 2\)", page)
    U = float(match[1]) * {"µm": 1e-6, "mm": 1e-3}[match[2]]
    states, c = day.states(), day.calibration()
    predicted = c.predict(states.q, states.wrench).position
    off = np.linalg.norm(
        predicted - true_positions(day.secret.world, states, c.base_in_tracker()), axis=1
    )
    assert off.max() < 1e-4
    assert np.mean(off <= U) > 0.95
    assert the_same_base(page) == the_same_base(day.said["refine"].text)


def the_same_base(text):
    return re.search(r"The robot's base: at .*? in the tracker frame", text)[0]


def test_corrected_joint_values_put_the_tool_where_it_was_asked_to_be(day):
    states, c = day.states("10kg"), day.calibration()
    names = [f"m{k}" for k in range(len(states))]
    head = ["pose", *(f"q{k}_deg" for k in range(1, 7)), "load"]
    text = table_of(head, names, np.degrees(states.q), ["10kg"] * len(states), comma=True, digits=9)
    write(day.home / "points.csv", text)
    said = day.at("compensate", RUN, "points.csv", "-o", "corrected.csv", "-o", "corrected.script")
    assert the_same_base(said.text) == the_same_base(day.said["refine"].text)
    with (day.home / "corrected.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    q = np.array([[float(r[f"q{j}_rad"]) for j in range(1, 7)] for r in rows])
    program = waypoints((day.home / "corrected.script").read_text())
    np.testing.assert_allclose([w.q for w in program], q, atol=2e-9)
    base, tool = c.base_in_tracker(), c.tool_pose()
    asked_for = (flanges(c.model.cell.arm, states.q) @ tool)[:, :3, 3]
    world = day.secret.world
    before, after = (
        np.linalg.norm(true_positions(world, replace(states, q=at), base) - asked_for, axis=1)
        for at in (states.q, q)
    )
    band = said.number(r"95 % of the points within ([\d.]+) (\S+);")
    assert np.mean(after <= band) >= 0.9
    assert abs(said.number(r"error before ([\d.]+) (\S+) mean") - before.mean()) < band
    assert after.mean() < 0.05 * before.mean()


def test_every_export_puts_the_arm_where_the_tracker_finds_it(day):
    """But for what it says that it leaves out: an arm of this geometry that does not yield."""
    words = "--urdf a.urdf --dh a.toml --ur-kinematics a.yaml --frames frames.json"
    said = day.at("export", RUN, *words.split(), "--calibration", "arm.json")
    assert "Not included, as not constant: joint_compliance" in said.text
    assert the_same_base(said.text) == the_same_base(day.said["refine"].text)
    document = json.loads((day.home / "frames.json").read_text())
    base, tool = pose(document["base_in_tracker"]), pose(document["tool_on_flange"])
    the_base_is_true(day, said)
    states, c = day.states("10kg"), hc.Calibration.load(day.home / "arm.json")
    states = replace(states, wrench=0 * states.wrench)
    world = day.secret.world
    soft = world.physics.joint_compliance
    stiff = replace(world, physics=replace(world.physics, joint_compliance=0 * soft))
    wanted, prediction = true_positions(stiff, states, base), c.predict(states.q)
    urdf, ur = (day.home / "a.urdf").read_text(), (day.home / "a.yaml").read_text()
    exported = {
        "URDF": by_pinocchio(urdf_model(urdf), states.q) @ tool,
        "DH": flanges(load_arm(str(day.home / "a.toml")), states.q) @ tool,
        "UR": by_ur(ur, states.q) @ pose(document["tcp_for_ur_kinematics"]),
    }
    nominal = flanges(c.model.cell.arm, states.q) @ tool
    for name, poses in exported.items():
        off = np.linalg.norm(poses[:, :3, 3] - wanted, axis=1)
        assert np.mean(off <= prediction.band_m) > 0.9, name
        assert off.mean() < 0.1 * np.linalg.norm(nominal[:, :3, 3] - wanted, axis=1).mean(), name
    predicted = np.linalg.norm(prediction.position - true_positions(world, states, base), axis=1)
    assert np.mean(predicted <= prediction.band_m) > 0.9
    controller = document["controller"]
    there = inverse(of_six(controller["tracker_in_base_m_rad"]))
    np.testing.assert_allclose(there, base, atol=1e-9)
    np.testing.assert_allclose(c.base_in_tracker(), base, atol=1e-9)


def test_the_table_of_a_colleague_tells_the_same(day):
    """Semicolons, decimal commas, degrees, millimetres, names in German, loads by name alone."""
    config, made = day.secret.config, load_plan(day.home / "plan.json")
    r = simulate_plan(day.secret, made, [SEED, 9]).readings
    loads = ["ohne" if r.load_names[k] == "none" else r.load_names[k] for k in r.load]
    head = ["Messpunkt", "Last", *(f"A{k} [°]" for k in range(1, 7))]
    head += [*(f"{axis} [mm]" for axis in "XYZ"), "Bemerkung"]
    names = [r.pose_names[k] for k in r.pose]
    text = table_of(head, names, loads, np.degrees(r.states.q), 1e3 * r.value, ["ok"] * len(r),
                    comma=True)  # fmt: skip
    write(day.home / "theirs.csv", text, "cp1252")
    command = ("import", "theirs.csv", "--config", "CELL.toml")
    previewed = day.at(*command, "--preview", "-o", "mapping.toml")
    assert "import with --format mapping.toml" in previewed.text
    said = day.at(*command, "--format", "mapping.toml", "-o", "theirs.hilcal")
    assert "load 10kg: its force is that of [[loads]]" in said.text
    refined = day.at("refine", "theirs.hilcal")
    with hc.Campaign.open(day.home / "theirs.hilcal", read_only=True) as run:
        assert set(run.fit().model.named) == {"base_frame", "joint_compliance", HIDDEN}
    the_base_is_true(day, refined)
    # Each of these readings is a mean, and the cell states the noise of one measurement.
    one, mean = (measurement_noise(config, n).range_std[0] for n in (1, config.acquire.samples))
    assert "the noise is not what was stated" in refined.text
    factor = refined.number(r"scale the covariance by ([\d.]*\d)")
    with hc.Campaign.open(day.home / "theirs.hilcal", read_only=True) as run:
        repeats = hc.diagnose(run.fit()).pure_error
    low, high = chi2.ppf([0.001, 0.999], repeats.dof) / repeats.dof  # they tell the factor
    assert low < factor / (mean / one) ** 2 < high
    day.at("validate", RUN, "theirs.hilcal", "--limit", "0.1 mm")
    compared = day.at("compare", RUN, "theirs.hilcal")
    assert "Nothing has changed beyond the uncertainty." in compared.text
    assert 0.01 < compared.number(r"move the target by less than ([\d.]+) mm may") < 1.0
