"""Several reflectors over real bytes: the station is pointed to each; a whole run."""

from pathlib import Path

import numpy as np
import pytest

from hilcal.campaign.campaign import Campaign
from hilcal.drivers import emscon, geocom
from hilcal.drivers.simulated.cell_processes import SimulatedCell
from hilcal.measuring.devices import PointingTracker, TargetLostError
from hilcal.robot.catalogue import configs_dir
from tests.support.cli_cases import Capsys
from tests.support.cli_cases import run as command
from tests.support.living_cell import config, world_of
from tests.support.reflector_cases import NAMES, OFFSETS

RADIUS = 0.05
OPEN = {"geocom": geocom.open_tracker, "emscon": emscon.open_tracker}
TARGETS = [{"name": n, "target_m": at} for n, at in zip(NAMES, OFFSETS.tolist(), strict=True)]


def made(driver):
    tool = {"load_point_m": [0.1, -0.03, 0.15], "mass_kg": 0.8, "targets": TARGETS}
    return config(tool=tool, tracker={"driver": driver})


@pytest.mark.parametrize("driver", OPEN)
def test_the_station_measures_the_reflector_that_it_is_pointed_to(
    driver: str, tmp_path: Path
) -> None:
    with SimulatedCell.start(world_of(made(driver)), made(driver), tmp_path, 3) as cell:
        tracker = OPEN[driver](cell.config)
        try:
            assert isinstance(tracker, PointingTracker)
            true = np.array(cell.ask("world", "state")["targets"])
            assert true.shape == (3, 3)
            for k in (2, 0, 1):
                tracker.aim(true[k] + [0.004, -0.003, 0.002], RADIUS)
                assert np.linalg.norm(tracker.measure().value - true[k]) < 5e-4
            cell.ask("tracker", "hide", targets=[1])
            with pytest.raises(TargetLostError):
                tracker.measure()
            with pytest.raises(TargetLostError, match=r"no target in sight|not found"):
                tracker.aim(true[1], RADIUS)
            tracker.aim(true[2], RADIUS)
            assert np.linalg.norm(tracker.measure().value - true[2]) < 5e-4
        finally:
            tracker.close()


@pytest.mark.slow
def test_a_whole_run_with_three_reflectors(tmp_path: Path, capsys: Capsys) -> None:
    text = (configs_dir() / "cells" / "demo_ur10e.toml").read_text()
    tables = "".join(
        f'[[tool.targets]]\nname = "{t["name"]}"\ntarget_m = {t["target_m"]}\n'
        f"estimate = {'false' if k == 0 else 'true'}\n"
        for k, t in enumerate(TARGETS)
    )
    text = text.replace("target_m = [0.06, 0.02, 0.12]\n", "", 1)
    text = text.replace("[tracker]\n", f"{tables}\n[tracker]\n", 1)
    text = text.replace("seed = 4", 'seed = 4\nhide = "base_compliance"')
    text = text.replace("strength_sigma = 3.0", "strength_sigma = 5.0")
    (tmp_path / "cell.toml").write_text(text)
    run, plan = tmp_path / "r.hilcal", tmp_path / "p.json"

    def hilcal(*words: str) -> dict:
        done = command(capsys, *words, "--json")
        assert done.code == 0, done.err
        return done.document

    cell = str(tmp_path / "cell.toml")
    hilcal("plan", cell, "-o", str(plan), "--poses", "12")
    words = ("run", cell, "--rehearse", "-o", str(run))
    done = command(capsys, *words, "--plan", str(plan), "--json")
    for _ in range(3):  # a busy machine lets the simulated controller's watchdog bite
        if done.code == 3:
            done = command(capsys, *words, "--resume", "--json")
    assert done.code == 0, done.err
    told = done.document
    with Campaign.open(run) as campaign:
        r = campaign.readings
        assert told["readings"] == len(r) <= told["planned"]
        assert np.bincount(r.target).min() > len(r) / 4
        assert r.common is not None
    found = hilcal("refine", str(run))
    assert found["revisions"][-1]["model"].count("base_compliance") == 1
    assert 0.6 < found["revisions"][-1]["variance_factor"] < 1.5
