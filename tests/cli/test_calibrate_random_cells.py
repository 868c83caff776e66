"""`calibrate --rehearse` of random cells: whatever a cell states or leaves out, it has an end."""

import json
import shlex

import numpy as np
import pytest
import tomli_w

from hilcal.store.campaign_file import CampaignFile
from tests.support.campaign_cases import STARVED, TRIES
from tests.support.cli_cases import ok, run
from tests.support.random_cells import random_cell, random_options

ENDS = (0, 4, 5)
"""Done; the data cannot answer; a limit is not kept."""
SMALL = ("--poses", "4", "--validation", "3", "--rehearse", "--yes", "--json")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_a_random_cell_is_calibrated_to_an_end(seed, tmp_path, capsys):
    rng = np.random.default_rng([seed, 32])
    cell = tmp_path / "CELL.toml"
    cell.write_text(tomli_w.dumps(random_cell(rng)), encoding="utf-8")
    options = (*random_options(rng), *SMALL)
    found = rehearsed(capsys, cell, *options)
    if "or leave out --goal" in found.err:  # of the position, which deflections do not show
        assert found.code == 2
        k = options.index("--goal")
        options = (*options[:k], *options[k + 2 :])
        found = rehearsed(capsys, cell, *options)
    assert found.code in ENDS, found.err
    document = json.loads(found.out)
    assert ("error" in document) == bool(found.code)
    if found.code != 4:
        assert document["improvement"]
        steps_are_taken(capsys, found, cell.with_name("run.hilcal"))
        again = run(capsys, "calibrate", cell, "-o", cell.with_name("run.hilcal"), "--resume",
                    *options)  # fmt: skip
        assert again.code == found.code
        assert json.loads(again.out)["improvement"] == document["improvement"]


def steps_are_taken(capsys, found, path):
    """Correct a point, and write a report, by the lines that are told, where it was measured."""
    points = path.with_name("points.csv")
    with CampaignFile.open(path, read_only=True) as campaign:
        q = campaign.readings().states.q[0]
    names = ",".join(f"q{k}_rad" for k in range(1, 7))
    points.write_text(f"{names}\n{','.join(map(repr, q.tolist()))}\n", encoding="utf-8")
    steps = [shlex.split(x)[1:] for x in found.err.splitlines() if x.startswith("  hilcal ")]
    assert [words[0] for words in steps] == ["compensate", "report"]
    for words in steps:
        given = [{"POINTS": str(points), "NAME": "A. Miller"}.get(w, w) for w in words]
        ok(capsys, *given)


def rehearsed(capsys, cell, *options):
    """Rehearse; where this computer was too busy for the devices, go on as an operator does."""
    path = cell.with_name("run.hilcal")
    for _ in range(TRIES):
        resume = ("--resume",) if path.exists() else ()
        found = run(capsys, "calibrate", cell, "-o", path, *resume, *options)
        if found.code != 3 or not STARVED.search(found.err):
            break
    return found
