"""`--prior` on `identify` and `refine`, and what it refuses."""

import json

import pytest

from hilcal.cli import main
from tests.support.cli_cases import CELL, table


def run(capsys, *words):
    with pytest.raises(SystemExit) as end:
        main([str(w) for w in words])
    out = capsys.readouterr()
    return int(end.value.code or 0), out.out, out.err


def test_the_next_campaign_starts_from_what_the_last_one_taught(tmp_path, capsys):
    old, new = tmp_path / "old.hilcal", tmp_path / "new.hilcal"
    run(capsys, "import", table(tmp_path / "a.csv", "nothing", 1, 12), "--config", CELL, "-o", old)
    run(capsys, "import", table(tmp_path / "b.csv", "nothing", 2, 6), "--config", CELL, "-o", new)
    code, _, err = run(capsys, "identify", new, "--prior", old)
    assert code == 2
    assert "no revision yet" in err
    assert run(capsys, "identify", old)[0] == 0
    alone = json.loads(run(capsys, "identify", new, "--json")[1])
    code, out, _ = run(capsys, "identify", new, "--prior", old, "--json")
    assert code == 0
    found = json.loads(out)
    assert found["prior"]["source"]["campaign"] == "old.hilcal"
    assert found["prior"]["source"]["revision"] == 1
    assert {"effect", "joint", "moved_sigma", "p_value", "drift"} <= set(
        found["prior"]["effects"][0]
    )
    name = "joint_compliance.j2"
    std = [next(p["std"] for p in d["parameters"] if p["name"] == name) for d in (alone, found)]
    assert std[1] < std[0]  # the two simulated arms differ: some of it drifted
    # Later commands find the prior in the file.
    old.unlink()
    code, out, _ = run(capsys, "compare", new, "--json")
    assert code == 0
    assert json.loads(out)["variance_factor"] == pytest.approx(found["variance_factor"], rel=1e-6)


@pytest.mark.long
def test_a_misfit_that_the_prior_does_not_know_is_told(tmp_path, capsys):
    old, new = tmp_path / "old.hilcal", tmp_path / "new.hilcal"
    hidden = table(tmp_path / "b.csv", "joint_tilt_compliance", 1, 8)
    run(capsys, "import", table(tmp_path / "a.csv", "nothing", 2, 8), "--config", CELL, "-o", old)
    run(capsys, "import", hidden, "--config", CELL, "-o", new)
    run(capsys, "identify", old)
    _, out, _ = run(capsys, "identify", new, "--prior", old)
    assert "leaves more than the noise; hilcal compare EARLIER LATER" in " ".join(out.split())
    more = "base_frame,joint_compliance,joint_tilt_compliance"
    _, out, _ = run(capsys, "identify", new, "--prior", old, "--effects", more)
    assert "did not have joint_tilt_compliance; hilcal compare" in " ".join(out.split())


def test_refusals(tmp_path, capsys):
    old = tmp_path / "old.hilcal"
    run(capsys, "import", table(tmp_path / "a.csv", "nothing", 1, 8), "--config", CELL, "-o", old)
    run(capsys, "identify", old)
    other = tmp_path / "other.json"
    other.write_text("{}")
    for words, said in (
        (("--prior", old), "count twice"),
        (("--prior", tmp_path / "none.hilcal"), "cannot be read"),
        (("--prior", other), "hilcal-posterior"),
        (("--prior", old, "--prior-of", "cousin"), "arm, type"),
        (("--prior", old, "--drift", "creep=1"), "joint_compliance"),
        (("--drift", "creep=1"), "--prior"),
    ):
        code, _, err = run(capsys, "identify", old, *words)
        assert code == 2, said
        assert said in " ".join(err.split())
        assert "Traceback" not in err
