"""A noise that nobody states is estimated: it is no effect, and no effect is noise."""

from pathlib import Path

import numpy as np
import pytest

import hilcal as hc
from hilcal.cell import Cell
from hilcal.readings.readings import Readings
from tests.support.cli_cases import ok
from tests.unit.identification.test_other_arm import measured

OFF = 0.3
"""mm and mrad of each link: an ordinary arm."""


def tabled(readings: Readings, path: Path, noise: str = "") -> tuple[Path, Path]:
    """Write readings without covariances, and a cell that says nothing but the arm's name."""
    names = [*(f"q{j}_rad" for j in range(1, 7)), "x_m", "y_m", "z_m"]
    rows = np.hstack([readings.states.q, readings.value])
    text = [f"p{k},none,{','.join(f'{x:.8f}' for x in row)}" for k, row in enumerate(rows)]
    table, cell = path / "t.csv", path / "CELL.toml"
    table.write_text("\n".join([f"pose,load,{','.join(names)}", *text]))
    cell.write_text(f'[robot]\nmodel = "ur5"\n{noise}')
    return table, cell


def read(readings: Readings, path: Path, noise: str = "") -> tuple[Cell, Readings]:
    table, cell = tabled(readings, path, noise)
    known = hc.Cell.load(cell)
    return known, hc.read_table(table, known)


def judged(cell: Cell, readings: Readings) -> hc.Diagnosis:
    return hc.diagnose(hc.fit(hc.baseline(cell, readings) + hc.effect("link_geometry"), readings))


def size(readings: Readings) -> float:
    """Root of the mean variance of a coordinate, m."""
    return float(np.sqrt(np.trace(readings.covariance, axis1=1, axis2=2).mean() / 3))


@pytest.mark.parametrize("sigma", [5e-6, 2e-5, 2e-4])
def test_white_noise_of_any_size_is_noise(tmp_path: Path, sigma: float) -> None:
    cell, readings = read(measured("ur5", 3, OFF, 60, sigma), tmp_path)
    assert not readings.noise_stated
    assert size(readings) == pytest.approx(sigma, rel=0.3)
    assert judged(cell, readings).verdict == "adequate"


@pytest.mark.long
def test_gross_errors_are_not_noise(tmp_path: Path) -> None:
    of = measured("ur5", 1, OFF, 60, 2e-5)
    of.value[[5, 17], 0] += 3e-3
    of.value[30, 1] += 8e-4
    assert size(read(of, tmp_path)[1]) == pytest.approx(2e-5, rel=0.3)


def test_effects_are_not_noise(tmp_path: Path) -> None:
    """Where the readings show several, the default stays: they are suspects, or unknown."""
    of = measured("ur5", 2, OFF, 60, 1e-5, lambda q: 4e-5 * np.sin(q + 1))
    cell, readings = read(of, tmp_path)
    assert size(readings) < 2e-5
    d = judged(cell, readings)
    assert d.verdict in ("missing_effect", "ambiguous")
    law = np.eye(6)[2] * 2e-4

    def crossed(q: np.ndarray) -> np.ndarray:
        return (np.cos(q[:, 1] + 0.3) * np.sin(q[:, 4] + 1))[:, None] * law

    d = judged(*read(measured("ur5", 4, OFF, 60, 1e-5, crossed), tmp_path))
    assert d.verdict == "unknown_effect"
    assert set(d.follows) == {"joint 2 angle", "joint 5 angle"}


def test_a_stated_noise_is_taken_as_stated(tmp_path: Path) -> None:
    noise = "[tracker]\nrange_std_m = 1e-4\ntransverse_std_m = 1e-4\n"
    cell, readings = read(measured("ur5", 3, OFF, 60, 2e-5), tmp_path, noise)
    assert readings.noise_stated
    assert size(readings) > 9e-5
    assert judged(cell, readings).verdict == "noise_misjudged"


def test_import_and_info_say_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table, cell = tabled(measured("ur5", 3, OFF, 40, 2e-5), tmp_path)
    run = str(tmp_path / "r.hilcal")
    for args in (["import", str(table), "--config", str(cell), "-o", run], ["info", run]):
        said = " ".join(ok(capsys, *args).out.split())
        assert "neither the table nor [tracker] states the noise; it was estimated" in said
