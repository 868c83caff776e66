"""Loads whose force a table states as zero, or not at all."""

import csv

import pytest

from hilcal.readings.covariance import INSTRUMENT_AND_ARM
from hilcal.store.campaign_file import CampaignFile
from hilcal.tables.table import write_table
from tests.support.cli_cases import CELL, ok, rehearsal


@pytest.mark.parametrize("name", ["5kg", "7 kg"])
def test_a_load_without_force_takes_that_of_the_cell_or_is_told_apart(name, tmp_path, capsys):
    whole, table, run = (tmp_path / f for f in ("whole.csv", "table.csv", "run.hilcal"))
    readings = rehearsal("nothing").readings
    write_table(readings, whole, INSTRUMENT_AND_ARM)
    text = [line for line in whole.read_text().splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(text))
    for row in (row for row in rows if row["load"] == "5kg"):
        row |= {k: "0" for k in row if k.endswith(("_N", "_Nm"))} | {"load": name}
    with table.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    printed = " ".join(ok(capsys, "import", table, "--config", CELL, "-o", run).out.split())
    fitted = " ".join(ok(capsys, "identify", run).out.split())
    if name == "5kg":  # of the cell's [[loads]]
        assert "load 5kg: its force is that of [[loads]] of the cell" in printed
        with CampaignFile.open(run) as campaign:
            assert campaign.readings().states.wrench == pytest.approx(readings.states.wrench)
        assert "gross" not in fitted
    else:
        assert "load 7 kg: its force is not stated by the table" in printed
        assert "All 14 readings under the load 7 kg are set aside: check its force." in fitted
