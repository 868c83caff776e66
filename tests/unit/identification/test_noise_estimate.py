"""A noise that nobody states is estimated: it is no effect, and no effect is noise."""

from dataclasses import replace

import numpy as np
import pytest

import hilcal as hc
from hilcal.cli.running import estimate_noise
from hilcal.cli.terminal import terminal
from hilcal.config import Tracker
from hilcal.errors import DeviceError
from hilcal.measuring.devices import TrackerSample
from hilcal.measuring.measure import average
from hilcal.readings.covariance import tracker_covariance, tracker_noise
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan, Step
from hilcal.store.run_log import create_run
from tests.support.cli_cases import ok
from tests.support.rows import first
from tests.unit.identification.test_registration import measured

OFF = 0.3  # mm and mrad of each link: an ordinary arm


def tabled(readings, path, noise=""):
    """Write readings without covariances, and a cell that says nothing but the arm's name."""
    names = [*(f"q{j}_rad" for j in range(1, 7)), "x_m", "y_m", "z_m"]
    rows = np.hstack([readings.states.q, readings.value])
    text = [f"p{k},none,{','.join(f'{x:.8f}' for x in row)}" for k, row in enumerate(rows)]
    table, cell = path / "t.csv", path / "CELL.toml"
    table.write_text("\n".join([f"pose,load,{','.join(names)}", *text]))
    cell.write_text(f'[robot]\nmodel = "ur5"\n{noise}')
    return table, cell


def read(readings, path, noise=""):
    table, cell = tabled(readings, path, noise)
    known = hc.Cell.load(cell)
    return known, hc.read_table(table, known)


def judged(cell, readings):
    return hc.diagnose(hc.fit(hc.baseline(cell, readings) + hc.effect("link_geometry"), readings))


def size(readings):
    """Root of the mean variance of a coordinate, m."""
    return float(np.sqrt(np.trace(readings.covariance, axis1=1, axis2=2).mean() / 3))


@pytest.mark.parametrize("sigma", first(1, [2e-5, 5e-6, 2e-4]))
def test_white_noise_of_any_size_is_noise(tmp_path, sigma):
    cell, readings = read(measured("ur5", 3, OFF, 60, sigma), tmp_path)
    assert not readings.noise_stated
    assert size(readings) == pytest.approx(sigma, rel=0.3)
    assert judged(cell, readings).verdict == "adequate"


@pytest.mark.long
def test_effects_are_not_noise(tmp_path):
    """Where the readings show several, the default stays: they are suspects, or unknown."""
    of = measured("ur5", 2, OFF, 60, 1e-5, lambda q: 4e-5 * np.sin(q + 1))
    cell, readings = read(of, tmp_path)
    assert size(readings) < 2e-5
    d = judged(cell, readings)
    assert d.verdict in ("missing_effect", "ambiguous")
    law = np.eye(6)[2] * 2e-4

    def crossed(q):
        return (np.cos(q[:, 1] + 0.3) * np.sin(q[:, 4] + 1))[:, None] * law

    d = judged(*read(measured("ur5", 4, OFF, 60, 1e-5, crossed), tmp_path))
    assert d.verdict == "unknown_effect"
    assert set(d.follows) == {"joint 2 angle", "joint 5 angle"}


def test_a_stated_noise_is_taken_as_stated(tmp_path):
    noise = "[tracker]\nrange_std_m = 1e-4\ntransverse_std_m = 1e-4\n"
    cell, readings = read(measured("ur5", 3, OFF, 60, 2e-5), tmp_path, noise)
    assert readings.noise_stated
    assert size(readings) > 9e-5
    assert judged(cell, readings).verdict == "noise_misjudged"


def test_import_and_info_say_it(tmp_path, capsys):
    table, cell = tabled(measured("ur5", 3, OFF, 40, 2e-5), tmp_path)
    run = str(tmp_path / "r.hilcal")
    for args in (["import", str(table), "--config", str(cell), "-o", run], ["info", run]):
        said = " ".join(ok(capsys, *args).out.split())
        assert "neither the table nor [tracker] states the noise; it was estimated" in said


SAMPLES = 5
STATED = "range_std_m = 5e-6\ntransverse_std_m = 7.5e-6\n"


def sampled(seed, sigma, between):
    """Readings of an ordinary arm, each the mean of samples with the default's covariance.

    `sigma` is of each axis of a sample, None for the default's noise; `between` of what the
    instrument errs by from pose to pose.
    """
    r, rng = measured("ur5", seed, OFF, 60, 1e-9), np.random.default_rng(seed)
    means = []
    for x, v in zip(r.value, tracker_covariance(r.value, tracker_noise(Tracker())), strict=True):
        root = np.linalg.cholesky(v) if sigma is None else sigma * np.eye(3)
        means.append(of_samples(x + between * rng.standard_normal(3), v, root, rng))
    value, covariance = (np.array(part) for part in zip(*means, strict=True))
    return replace(r, value=value, covariance=covariance)


def of_samples(x, v, root, rng):
    """The mean of samples and its covariance; samples that scatter too much are taken again."""
    while True:
        drawn = x + rng.standard_normal((SAMPLES, 3)) @ root.T
        try:
            mean = average([TrackerSample(k, value, v) for k, value in enumerate(drawn)])
        except DeviceError:
            continue
        return mean.value, mean.covariance


def run_of(readings, path, tracker="", arm=""):
    """A campaign as `run` leaves it."""
    text = f'[robot]\nmodel = "ur5"\n[tracker]\n{tracker}{arm}'
    (path / "CELL.toml").write_text(text)
    config = hc.Cell.load(path / "CELL.toml").configured()
    names = readings.pose_names
    plan = Plan(names, readings.states.q, tuple(Step(name, "none") for name in names))
    with create_run(path / "r.hilcal", config, path, plan) as file:
        file.append_readings(readings)
        estimate_noise(terminal(False), hc.Cell.load(path / "CELL.toml").with_config(config), file)
    return path / "r.hilcal"


STATED_ARM = "[repeatability]\njoint_std_rad = 1e-7\n"
INSTRUMENTS = [(2e-5, 0.0, ""), (5e-6, 1e-4, ""), (2e-4, 0.0, ""), (5e-6, 2e-5, "")]


@pytest.mark.long
@pytest.mark.parametrize(("sigma", "between", "arm"), [*INSTRUMENTS, (5e-6, 1e-4, STATED_ARM)])
def test_another_instrument_is_noise(tmp_path, capsys, sigma, between, arm):
    readings = sampled(3, sigma, between)
    path = run_of(readings, tmp_path, arm=arm)
    assert "[tracker] does not state the noise" in " ".join(capsys.readouterr().err.split())
    with hc.Campaign.open(path) as run:
        assert not run.readings.noise_stated
        truth = np.sqrt(sigma**2 / SAMPLES + between**2)
        assert size(run.readings) == pytest.approx(truth, rel=0.3)
        assert judged(run.cell, run.readings).verdict == "adequate"
    assert "[tracker] does not state the noise" in " ".join(ok(capsys, "info", path).out.split())


@pytest.mark.parametrize("tracker", ["", STATED])
def test_what_the_samples_show_or_the_cell_states_stays(tmp_path, tracker):
    """The default's own noise; or a stated one that the readings contradict."""
    readings = sampled(3, 5e-6, 2e-5) if tracker else sampled(3, None, 0.0)
    with hc.Campaign.open(run_of(readings, tmp_path, tracker)) as run:
        assert run.readings.noise_stated
        np.testing.assert_array_equal(run.readings.covariance, readings.covariance)
        if not tracker:
            assert judged(run.cell, run.readings).verdict == "adequate"


def test_an_estimate_does_not_outlive_the_readings_that_it_is_of(tmp_path, capsys, monkeypatch):
    path = run_of(sampled(3, 5e-6, 1e-4), tmp_path)
    cell = hc.Cell.load(tmp_path / "CELL.toml")
    monkeypatch.setattr("hilcal.cli.running.measured_noise", lambda *_: None)
    with CampaignFile.open(path) as file:
        estimate_noise(terminal(False), cell, file)
        stored = file.readings()
    with hc.Campaign.open(path) as run:
        assert run.readings.noise_stated
        np.testing.assert_array_equal(run.readings.covariance, stored.covariance)
    assert "does not state the noise" not in ok(capsys, "info", path).out
