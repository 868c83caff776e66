"""Files of effects: what they may hold, one clear line for what they may not, one to begin with."""

from pathlib import Path

import numpy as np
import pytest

from hilcal.effects.catalogue import BUILT_IN, read_effects
from hilcal.effects.check import check_effect
from hilcal.model.model import Model
from tests.support.campaigns import campaign as simulated
from tests.support.campaigns import plan
from tests.support.cli_cases import ok, refused
from tests.support.refusals import check, refusals, with_edits
from tests.support.user_effect_cases import CLASS, COLUMNS

NAME = "soft_side"


ELASTIC = CLASS.replace(COLUMNS, "values = s.torque[:, :1] ** 3").replace(
    "    @property",
    """\
    elastic = True

    def response(self, theta, s, change):
        dq = np.zeros((*change.shape[:2], s.angle.shape[1]))
        dq[:, :, 1] = 3 * theta[0] * s.torque[:, :1] ** 2 * change[:, :, 0, 5]
        return Response(dq=dq)

    @property""",
)


@refusals("user_effects")
def test_a_bad_file_is_one_clear_line(case, given, tmp_path, capsys):
    path = tmp_path / "mine.py"
    path.write_text(with_edits(given, CLASS=CLASS, ELASTIC=ELASTIC), encoding="utf-8")
    line = refused(capsys, 2, "effects", "--effects-from", path)
    check(case, line.removeprefix("error: ").replace(str(path), path.name))


@pytest.mark.parametrize("content", [CLASS, ELASTIC], ids=["rigid", "elastic"])
def test_what_the_bad_files_were_made_from_is_good(content, tmp_path, capsys):
    path = tmp_path / "mine.py"
    path.write_text(content, encoding="utf-8")
    ok(capsys, "effects", "--effects-from", path)


def test_what_a_file_prints_is_not_in_the_document(tmp_path, capsys):
    path = tmp_path / "mine.py"
    law = f"print('here')\n        {COLUMNS}"
    path.write_text("print('there')\n" + CLASS.replace(COLUMNS, law), encoding="utf-8")
    result = ok(capsys, "effects", "--effects-from", path, "--json")
    assert result.document["effects"][-1]["name"] == "mine"
    assert "there" in result.err
    assert "here" in result.err


def test_one_parameter_may_move_every_joint(tmp_path):
    path = tmp_path / "mine.py"
    every = CLASS.replace("s.angle[:, :1]", "s.angle").replace(
        "np.array([0]), np.array([1])", "np.zeros(6, int), np.arange(6)"
    )
    path.write_text(every, encoding="utf-8")
    c, p = simulated(plan_seed=0), plan()
    (kind,) = read_effects(path).effects
    model = Model(c.cell, (kind(c.cell, p.states),))
    ends = [model.predict(p.states, np.array([a])).observation.position for a in (-1e-4, 1e-4)]
    derived = model.jacobian(model.predict(p.states, np.zeros(1)), np.zeros(1), 3)[:, :, 0]
    np.testing.assert_allclose(derived, (ends[1] - ends[0]) / 2e-4, rtol=0, atol=1e-7)


@pytest.mark.parametrize("kind", BUILT_IN, ids=lambda kind: kind.name)
def test_what_is_built_in_passes_the_check(kind):
    check_effect(kind)


def test_new_writes_an_effect_that_works(tmp_path, capsys):
    path = tmp_path / "response.py"
    d = ok(capsys, "effects", "new", "response", "-o", path, "--json").document
    assert d == {"written": str(path), "effect": "response"}
    listed = ok(capsys, "effects", "--effects-from", path, "--json").document["effects"]
    assert listed[-1]["name"] == "response"
    assert listed[-1]["source"] == str(path)
    content = path.read_text(encoding="utf-8")
    assert "emplate" not in content
    for word in ("hilcal.effects", "needs", "elastic", "scale", "--effects-from response.py"):
        assert word in content


def test_new_goes_into_the_folder_one_is_in(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "soft_side.py" in ok(capsys, "effects", "new", NAME).out
    there = Path("soft_side.py").read_bytes()
    assert "the file exists" in refused(capsys, 2, "effects", "new", NAME)
    assert Path("soft_side.py").read_bytes() == there


@pytest.mark.parametrize("name", ["2x", "My", "a-b", "", "class", "é", "a/b"])
def test_new_refuses_a_bad_name(name, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "valid: lower-case letters" in refused(capsys, 2, "effects", "new", name)
    assert not list(tmp_path.iterdir())


def test_new_refuses_what_is_there_already(tmp_path, capsys):
    out = tmp_path / "mine.py"
    said = refused(capsys, 2, "effects", "new", "hysteresis", "-o", out)
    assert "in the catalogue already" in said
    assert ".py" in refused(capsys, 2, "effects", "new", NAME, "-o", tmp_path / "mine.txt")
    assert "written" in refused(capsys, 2, "effects", "new", NAME, "-o", out / "mine.py")
    assert not out.exists()
