"""Files of effects: what they may hold, one clear line for what they may not, one to begin with."""

from pathlib import Path

import numpy as np
import pytest

from hilcal.effects.catalogue import BUILT_IN
from hilcal.effects.check import check_effect
from hilcal.effects.from_file import read_effects
from hilcal.model.model import Model
from tests.support.campaigns import campaign as simulated
from tests.support.campaigns import plan
from tests.support.cli_cases import ok, refused
from tests.support.user_effect_cases import CLASS, COLUMNS, HEAD

NAME = "soft_side"

# --- files that cannot be used --------------------------------------------------------------

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

LOCAL = ELASTIC.replace("elastic = True", "elastic = local_response = True")

BAD = {
    "not Python": ("class Mine(:\n", ", line 1: not Python: invalid syntax"),
    "does not import": ("import no_such_module\n", ", line 1: ModuleNotFoundError"),
    "fails": ("a = 1\nb = a / 0\n", ", line 2: ZeroDivisionError: division by zero"),
    "ends the program": ("raise SystemExit(0)\n", ", line 1: SystemExit"),
    "no effect": (HEAD, ": defines no effect"),
    "only a private one": (CLASS.replace("class Mine", "class _Mine"), ": defines no effect"),
    "abstract": (CLASS.replace("def columns", "def column"), ": class Mine lacks columns"),
    "no name": (CLASS.replace('    name = "mine"\n', ""), ": class Mine has name = None; valid:"),
    "bad name": (CLASS.replace('"mine"', '"My law"'), ": class Mine has name = 'My law'; valid:"),
    "no summary": (CLASS.replace("summary =", "law ="), ": class Mine has summary = None"),
    "needs no tuple": (
        CLASS.replace("    @prop", '    needs = ("time")\n\n    @prop'),
        ": class Mine has needs = 'time'; valid: a tuple of some of time,",
    ),
    "needs unknown": (
        CLASS.replace("    @prop", '    needs = ("humidity",)\n\n    @prop'),
        ": class Mine has needs = ('humidity',)",
    ),
    "canonical name": (
        CLASS.replace('"mine"', '"hysteresis"'),
        ": class Mine: effect hysteresis is in the catalogue already",
    ),
    "twice": (
        CLASS + CLASS.replace("class Mine", "class Other"),
        ": class Other: effect mine is in the catalogue already",
    ),
    "bad scale": (CLASS.replace("1e-5", "0.0"), ": effect mine: parameters a: scale = 0.0"),
    "no parameters": (
        CLASS.replace('(Parameter("a", "rad", 1e-5),)', "()"),
        ": effect mine: parameters are ()",
    ),
    "raises": (
        CLASS.replace(COLUMNS, "values = s.angel[:, :1]"),
        ", line 13: effect mine: columns raises AttributeError: 'Situation' object has no",
    ),
    "wrong shape": (
        CLASS.replace("s.angle[:, :1]", "s.angle"),
        ": effect mine: columns has dq values of shape (30, 6); expected (30, 1) or (1, 1)",
    ),
    "not finite": (
        CLASS.replace("np.sin(2 * ", "np.sqrt("),
        ": effect mine: columns has dq values of which some are not finite",
    ),
    "no such field": (
        CLASS.replace('"dq", np', '"joint", np'),
        ": effect mine: columns has the field 'joint'; valid: dq, twist",
    ),
    "no such joint": (
        CLASS.replace("np.array([1])", "np.array([9])"),
        ": effect mine: columns has element = [9]; valid: 0 to 5",
    ),
    "no tuple": (
        CLASS.replace("values),)", "values))"),
        ": effect mine: columns returns Columns; expected a tuple of Columns",
    ),
    "not elastic": (
        CLASS.replace(COLUMNS, "values = s.torque[:, :1]"),
        ": effect mine: columns follow the wrenches; set elastic = True and give response",
    ),
    "no response": (
        CLASS.replace(COLUMNS, "values = s.torque[:, :1]").replace(
            "    @prop", "    elastic = True\n\n    @prop"
        ),
        ": effect mine: response is not the derivative of columns by the wrenches: dq",
    ),
    "wrong response": (
        ELASTIC.replace("dq[:, :, 1] = 3", "dq[:, :, 1] = 2"),
        ": effect mine: response is not the derivative of columns by the wrenches: dq",
    ),
    "declared local and moves another joint": (
        LOCAL.replace(" ** 3", "").replace("3 * theta[0] * s.torque[:, :1] ** 2", "theta[0]"),
        ": effect mine: response moves other slots than 0 by its wrench; set local_response = F",
    ),
    "declared local and does not take equal changes": (
        LOCAL.replace("s.torque[:, :1] ** 2", "s.torque[: len(change), :1] ** 2"),
        ": effect mine: response to changes (1, P, n + 1, 6) has another dq",
    ),
    "response of a wrong shape": (
        ELASTIC.replace("dq=dq)", "dq=dq[:, 0])"),
        ": effect mine: response has dq of shape (30, 6); expected (30, 2, 6)",
    ),
    "uses what it does not name": (
        CLASS.replace(COLUMNS, "values = s.states.load_time[:, None] * 1e-3"),
        ': effect mine: uses load_time; name it: needs = ("load_time",)',
    ),
    "one state depends on the others": (
        CLASS.replace(COLUMNS, "values = s.angle[:, :1] - s.angle[:, :1].mean()"),
        ": effect mine: columns of a state depend on the other states",
    ),
    "changes what it is given": (
        CLASS.replace(COLUMNS, "values = s.angle[:, :1]; values *= 2.0"),
        ", line 13: effect mine: columns raises ValueError: output array is read-only",
    ),
    "load without its derivative": (
        CLASS + "\n    def wrench_change(self, theta, s):\n"
        "        return theta[0] * s.states.wrench\n",
        ": effect mine: wrench_columns is not the derivative",
    ),
    "not linear": (
        CLASS + "\n    def deviation(self, theta, s):\n"
        "        return super().deviation(theta**2, s)\n",
        ": class Mine overrides deviation; give columns",
    ),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_file_is_one_clear_line(kind, tmp_path, capsys):
    content, said = BAD[kind]
    path = tmp_path / "mine.py"
    path.write_text(content, encoding="utf-8")
    line = refused(capsys, 2, "effects", "--effects-from", path)
    assert line.startswith(f"error: {path}{said}")


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


# --- the file to begin with -----------------------------------------------------------------


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
