"""Plans for distances and heights know what fits of such readings know."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilcal.config import load_config
from hilcal.config.sections import Gauge, Point
from hilcal.design.information import problem
from hilcal.design.nominal_model import nominal_model
from hilcal.errors import InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.identification.full_covariance import with_joint_scatter
from tests.support.campaigns import cell_of, configuration
from tests.support.cli_cases import CELL, Capsys, ok
from tests.support.fit_cases import named
from tests.support.observer_cases import NORMAL, POINTS, STD, observed

CASES = {
    "distance": (["A", "B"], {k: Point(position_m=POINTS[k], std_m=STD) for k in "AB"}, {}),
    "height": (["G"], {}, {"G": Gauge(direction=tuple(NORMAL), std_m=STD)}),
}


@pytest.mark.parametrize("what", CASES)
def test_predicted_uncertainties_are_those_of_a_fit(what: str) -> None:
    who, points, gauges = CASES[what]
    config = configuration()
    tracker = config.tracker.model_copy(update={"frame": "base", "observes": what})
    planning = config.planning.model_copy(update={"readings": "absolute", "against": ()})
    config = config.model_copy(
        update={"tracker": tracker, "planning": planning, "points": points, "gauges": gauges}
    )
    acquire = config.acquire.model_copy(update={"samples": 1})
    config = config.model_copy(update={"acquire": acquire})
    cell = replace(cell_of(), config=config, registration_known=True)
    c = observed(who, 7, cell=cell, base=True)
    joint_std = config.repeatability.per_joint(6)
    readings = with_joint_scatter(cell, c.readings, joint_std)
    f = fit(baseline(cell, readings, "absolute"), readings, "absolute")

    _, first = np.unique(readings.pose, return_index=True)
    of = problem(nominal_model(cell, config), config, readings.states.q[first])
    assert len(of.what) == len(first) * 5
    information = of.information(np.ones(len(of.what))) - of.prior + of.measured
    names = [t.name for t in of.terms]
    own = [k for k, name in enumerate(names) if name.startswith("joint_compliance")]
    frames = [k for k, name in enumerate(names) if name.startswith("observer_frame")]
    kept = np.array([*own, *frames])
    covariance = np.linalg.pinv(information[np.ix_(kept, kept)], rcond=1e-12)
    std = np.sqrt(np.diagonal(covariance))[: len(own)] * of.scale[own]
    fitted = named(f)
    for name, planned in zip((names[k] for k in own), std, strict=True):
        if np.isfinite(fitted[name][1]):
            assert planned == pytest.approx(fitted[name][1], rel=0.25), name


@pytest.mark.long
def test_a_cell_of_distances_is_planned(tmp_path: Path, capsys: Capsys) -> None:
    text = CELL.read_text().replace("candidates = 250", "candidates = 60\nagainst = []")
    text = text.replace('frame = "tracker"', 'frame = "base"\nobserves = "distance"')
    (tmp_path / "cell.toml").write_text(text + "\n[points.A]\nstd_m = 1e-5\n[points.B]\n")
    out = tmp_path / "plan.json"
    ok(capsys, "plan", tmp_path / "cell.toml", "--poses", "8", "-o", out)
    assert len({step["pose"] for step in json.loads(out.read_text())["steps"]}) >= 8


def test_devices_read_positions(tmp_path: Path) -> None:
    text = CELL.read_text().replace(
        'frame = "tracker"', 'driver = "geocom"\nport = "x"\nobserves = "distance"'
    )
    (tmp_path / "cell.toml").write_text(text)
    with pytest.raises(InputError, match=r'observes = "distance" together with driver'):
        load_config(tmp_path / "cell.toml")
