"""Laws beside other searchers: problems, answers, and cases that are not run twice."""

import json
import sys
from dataclasses import asdict
from pathlib import Path

from studies.formulas import FORMULAS, Answer, asked, claims, mark
from studies.odds import OddsCase
from studies.odds import claims as odds_claims
from studies.records import resumed


def test_a_searcher_that_is_not_there_is_said_to_be_missing():
    one = {
        "quantities": {"a": [1.0, 2.0]}, "angles": [], "target": [1.0, 2.0],
        "covariance": [[1.0, 0.0], [0.0, 1.0]], "fresh": {"a": [3.0]},
    }  # fmt: skip
    told = asked(Path(sys.executable), "pysr", one)
    assert "No module named 'pysr'" in told["error"]
    missing = {who: Answer(f"not run: {told['error']}") for who in ("hilcal", "pysr")}
    figures = {f.what: f.measured for f in claims([(FORMULAS[0], 0.01, missing)])}
    assert figures["pysr, noise 1 %"] == "not run: needs Julia"


def test_a_case_that_is_in_the_file_is_not_run_again(tmp_path):
    path, run = tmp_path / "cases.jsonl", []

    def once(key):
        run.append(key)
        return {"size": len(key)}

    assert [c["size"] for c in resumed(path, ["a", "bb"], once)] == [1, 2]
    assert [c["size"] for c in resumed(path, ["bb", "ccc"], once)] == [2, 3]
    assert run == ["a", "bb", "ccc"]
    assert len(path.read_text().splitlines()) == 3


def test_frequencies_are_counted_by_what_was_said():
    """Two laws, said with 0.9 and right; a third, with 0.6 and wrong: expected 2.4 ± 0.65."""
    both = [OddsCase("a", "a", ((0.9, True), (0.1, False)), (2.0, 0.8), (1.0, 0.95))] * 2
    wrong = OddsCase("a", "b", ((0.6, False), (0.3, True)), (1.0, 0.9), (1.0, 0.95))
    none = OddsCase("a")
    cases = [json.loads(json.dumps(asdict(o))) for o in (*both, wrong, none)]
    figures = {f.what: f for f in odds_claims(cases)}
    assert figures["laws drawn, and proposed"].measured == "4, 3"
    right = "structures said to have a probability of 80 % to 95 %"
    assert figures[right].measured.startswith("right 2 of 2 (100 %)")
    first = figures["the likeliest structure of drawn laws of one term"]
    assert first.measured == "right in 2 of 3; expected 2.4 ± 0.6"
    assert first.met is True
    error = figures["error at fresh poses, averaged over that of the first law alone"]
    assert error.measured == f"{0.25 ** (1 / 3):.3f} (geometric mean), smaller in 2 of 3"
    inside = figures["elements of fresh poses inside the 95 % interval of the average"]
    assert inside.measured == "95.0 %"


def test_an_answer_is_equivalent_only_where_it_holds_beyond_the_range():
    assert mark(Answer("a", 1e-5, 1e-5)) == "="
    assert mark(Answer("a", 1e-5, 1.0)) == "≈"
    assert mark(Answer("a", 1e-2, 1e-9)) == "-"
