"""Joint torques in a run: stored with the readings, lost in the middle, back, or never told."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilcal.errors import InputError
from hilcal.identification.torques import check_torques, require_torques
from hilcal.measuring.progress import Remark
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.rows import content_hash
from hilcal.tables.table import read_table, write_table
from tests.support.fake_bench import Bench
from tests.support.fake_devices import TORQUE
from tests.support.fake_world import Killed
from tests.support.run_cases import measure

LOST = "no longer tells the torques"


def told(b: Bench) -> list[str]:
    return [r.text for r in b.notes.of(Remark) if LOST in r.text]


def test_torques_are_averaged_over_the_reading() -> None:
    b = Bench()
    b.world.torques = np.inf
    torque = measure(b).states.torque
    assert torque is not None
    # means of at least three samples that scatter by 0.1 N·m
    assert np.abs(torque - TORQUE).max() < 5 * 0.1 / np.sqrt(3)
    assert not told(b)
    assert b.store.details()[0]["torque"] == torque[0].tolist()


def test_an_arm_without_torques_gives_none() -> None:
    b = Bench()
    assert measure(b).states.torque is None
    assert not told(b)


def test_a_lost_link_is_said_once_and_readings_go_on(tmp_path: Path) -> None:
    b = Bench()
    b.world.torques = 60
    readings = measure(b)
    torque = readings.states.torque
    assert torque is not None
    lost = np.isnan(torque).all(axis=1)
    assert np.array_equal(lost, np.isnan(torque).any(axis=1))
    assert 0 < lost.argmax() < len(lost)
    assert lost[lost.argmax() :].all()
    assert len(told(b)) == 1
    with CampaignFile.create(tmp_path / "r.hilcal", "{}", ".", "test") as file:
        file.append_readings(readings[:1])
        file.append_readings(readings[1:])
        assert content_hash(file.readings()) == content_hash(readings)
        half = np.array(torque)
        half[0, 2] = np.nan
        with pytest.raises(InputError, match="torque of reading 1 is not finite"):
            file.append_readings(replace(readings, states=replace(readings.states, torque=half)))
    write_table(readings, tmp_path / "t.csv")
    write_table(readings, tmp_path / "t.parquet")
    for name in ("t.csv", "t.parquet"):
        back = read_table(tmp_path / name, b.cell.arm, None)
        assert content_hash(back) == content_hash(readings)
    text = (tmp_path / "t.csv").read_text().replace(repr(float(torque[0, 2])), "")
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(InputError, match=r"row 2, column 'tau3_Nm': no value; give all torques"):
        read_table(tmp_path / "t.csv", b.cell.arm, None)
    measured = replace(b.cell, measured_torques=True)
    with pytest.raises(InputError, match=rf"but {lost.sum()} of {len(lost)} readings have none"):
        require_torques(measured, readings)
    some, all_of_them = check_torques(b.cell, readings), check_torques(b.cell, readings[~lost])
    assert some is not None
    assert all_of_them is not None
    assert some.to_json() == all_of_them.to_json()


@pytest.mark.parametrize("first", [0, np.inf])
def test_a_campaign_goes_on_as_it_began(first: float) -> None:
    b = Bench()
    b.world.torques, b.world.kill_after = first, ("store.recorded", 4)
    with pytest.raises(Killed):
        measure(b)
    b.world.again()
    b.world.torques = -1 if first else np.inf
    torque = measure(b).states.torque
    if not first:
        assert torque is None
    else:
        assert torque is not None
        assert np.isfinite(torque[:4]).all()
        assert np.isnan(torque[4:]).all()
        assert len(told(b)) == 1
