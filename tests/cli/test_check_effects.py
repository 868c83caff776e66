"""`check` refuses effects that do not exist before it talks to any device."""

import pytest

from tests.support.cli_cases import CELL, refused


@pytest.mark.parametrize(("section", "said"), [
    (
        '[planning]\nmodel = ["joint_complianse"]',
        "[planning] model: unknown effect 'joint_complianse' (did you mean "
        '"joint_compliance"?); valid: ',
    ),
    ('[planning]\nmodel = ["joint_compliance(joints=2-9)"]', "[planning] model: "),
    ('[planning]\nagainst = ["creap"]',
        "[planning] against: unknown effect 'creap' (did you mean \"creep\"?); valid: "),
    ("[plausible]\nlink_geometri = 4.0",
        "[plausible]: unknown effect 'link_geometri' (did you mean \"link_geometry\"?)"),
    ("[ordinary]\ncrep = 0.1", "[ordinary]: unknown effect 'crep' (did you mean \"creep\"?)"),
])  # fmt: skip
def test_an_unknown_effect_is_one_line(section, said, tmp_path, capsys):
    head, name = section.split("\n")[0], tmp_path / "mine.toml"
    text = CELL.read_text(encoding="utf-8")
    text = text.replace(head, section) if f"\n{head}\n" in text else f"{text}\n{section}\n"
    name.write_text(text, encoding="utf-8")
    line = refused(capsys, 2, "check", name)
    assert line.startswith(f"error: mine.toml: {said}")
