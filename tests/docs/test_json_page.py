"""The page on JSON describes every key that the commands print, with its type."""

import inspect
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from hilcal.config import load_config
from hilcal.config.reference import to_toml
from hilcal.store.campaign_file import CampaignFile
from studies.random_campaigns import rehearse
from tests.support.cli_cases import CELL, Capsys, quickly_planned, run
from tests.support.paths import ROOT

PAGE = (ROOT / "docs" / "reference" / "json.md").read_text(encoding="utf-8")
ROW = re.compile(r"^\| `([^`]+)` \| ([^|]+) \| [^|]+ \|$", re.MULTILINE)
PART = re.compile(r"\[[^\]]+\]\(#([a-z-]+)\)")
ALSO = {"next": ("plan",), "diagnose": ("diagnosis",), "discover": ("discovery",)}
"""Sections that have the keys of another one, too."""


def sections() -> dict[str, dict[str, str]]:
    """Types by key, by the anchor of the section."""
    out = {}
    for title, text in re.findall(r"^###? (.+)\n((?:(?!^##).*\n?)*)", PAGE, re.MULTILINE):
        rows = {key: kind.strip() for key, kind in ROW.findall(text)}
        for place in re.findall(r"<!-- attributes of (\S+) -->", text):
            module, name = place.rsplit(".", 1)
            said = inspect.getdoc(getattr(import_module(module), name)) or ""
            listed = said.split("Attributes:\n")[1]
            rows |= dict.fromkeys(re.findall(r"^    (\w+):", listed, re.MULTILINE), "any")
        if title == "serial noise":
            rows["half"] = "number"
        out[title.replace(" ", "-")] = rows
    return out


SECTIONS = sections()


def kind_of(value: object) -> str:
    if value is None:
        return "null"
    kinds = {bool: "yes/no", int: "number", float: "number", str: "text", list: "list"}
    return kinds.get(type(value), "object")


def differences(found: dict[str, Any], section: str, path: str = "") -> Iterator[str]:
    """What a document has that a section does not say."""
    rows: dict[str, str] = {}
    for name in (section, *ALSO.get(section, ())):
        rows |= SECTIONS[name]
    for key, value in found.items():
        where = f"{path}{key}"
        kind = rows.get(where)
        if kind is None:
            yield f"{section}: {where} is not on the page"
            continue
        part, kinds = PART.search(kind), PART.sub("object", kind.removesuffix(", sometimes"))
        some = kinds.split(" or ")
        if kind != "any" and kind_of(value) not in {k.split()[0] for k in some}:
            yield f"{section}: {where} is {kind_of(value)}; on the page: {kind}"
        for each in value if isinstance(value, list) else [value]:
            if not isinstance(each, dict) or kind == "any":
                continue
            if part is not None:
                yield from differences(each, part[1])
            elif " by " not in kind and any(row.startswith(f"{where}.") for row in rows):
                yield from differences(each, section, f"{where}.")


@pytest.mark.slow
def test_the_page_has_every_key_of_the_commands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    config = quickly_planned(load_config(CELL))
    Path("cell.toml").write_text(to_toml(config), encoding="utf-8")
    for name, seed in (("run", 3), ("later", 4)):
        with CampaignFile.create(f"{name}.hilcal", config.to_json(), str(CELL.parent), "x") as f:
            f.append_readings(rehearse(config, "creep", seed, 10).readings)
    Path("points.csv").write_text("x_m,y_m,z_m,rx_rad,ry_rad,rz_rad\n0.6,0.2,0.4,3.14,0,0\n")
    asked = (
        "identify run.hilcal",
        "identify run.hilcal --scaling all",
        "compare run.hilcal",
        "diagnose run.hilcal",
        "add run.hilcal creep",
        "remove run.hilcal creep",
        "refine run.hilcal",
        "discover run.hilcal -o laws.py",
        "compare run.hilcal later.hilcal",
        "validate run.hilcal later.hilcal --limit 1m",
        "compensate run.hilcal points.csv -o corrected.csv --allow-outside",
        "info run.hilcal",
        "accept run.hilcal",
        "repair run.hilcal",
        "bootstrap run.hilcal --draws 20",
        "export run.hilcal --readings readings.csv",
        "import readings.csv --config cell.toml -o again.hilcal",
        "import readings.csv --config cell.toml --preview",
        "report run.hilcal -o report.html",
        "view run.hilcal --record run.rrd",
        "plan cell.toml -o plan.json --poses 6",
        "next run.hilcal -o next.json --poses 6 --suspects joint_tilt_compliance,link_compliance",
        "init new.toml --robot ur10e",
        "config tracker",
        "effects",
        "effects new mine",
        "doctor",
        "study scaling --runs 20",
    )
    wrong: list[str] = []
    for words in asked:
        result = run(capsys, *words.split(), "--json")
        failed = result.document.pop("error", {}) if result.code else {}
        document = {k: v for k, v in result.document.items() if not (result.code and k == "error")}
        assert document, (words, failed)
        section = words.split()[0] if "later" not in words else words.split()[0] + "-two-campaigns"
        wrong += list(differences(document, section if section in SECTIONS else words.split()[0]))
    assert sorted(set(wrong)) == []


def test_a_failure_has_the_keys_of_the_page(capsys: Capsys) -> None:
    document = run(capsys, "diagnose", "none.hilcal", "--json").document
    assert list(differences(document, "Failure")) == []


def test_what_the_page_says_is_compared() -> None:
    """The comparison itself: a key that is missing, a type that is another."""
    assert len(SECTIONS) > 40
    assert list(differences({"accepted": 1, "in_use": 1, "latest": 2}, "accept")) == []
    assert list(differences({"in_use": "one", "more": 0}, "accept")) == [
        "accept: in_use is text; on the page: number",
        "accept: more is not on the page",
    ]
    nested = {"rms_m": 1.0, "mean_m": "x"}
    assert list(differences({"error": {"fit": nested}}, "compare"))
