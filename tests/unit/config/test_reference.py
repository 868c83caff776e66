"""`hilcal config` and its page in the documents: every key, with what a reader needs."""

import tomllib
from typing import Annotated, get_args

import pytest
from pydantic import TypeAdapter

from hilcal.cli.looking_up import DRIVERS_OWN
from hilcal.config import CellConfig
from hilcal.config.reference import NOT_SET, REQUIRED, tables
from hilcal.toml import section_of
from tests.support.cli_cases import ok
from tests.support.hooks import hook
from tests.support.paths import ROOT

TABLES = {t.name: t for t in tables(DRIVERS_OWN)}


def fields(section, name):
    """All keys, found without the code under test: section, key, field."""
    for key, field in section.model_fields.items():
        if name:
            yield name, key, field
        inner = section_of(field)
        if inner is not None:
            yield from fields(inner, f"{name}.{key}" if name else key)


FIELDS = [
    *fields(CellConfig, ""),
    *((name, key, f) for name, s in DRIVERS_OWN.items() for key, f in s.model_fields.items()),
]


def key_of(section, key):
    (selected,) = [k for k in TABLES[section].keys if k.name == key]
    return selected


def numeric(annotation):
    """Whether a value is a number or made of numbers."""
    parts = get_args(annotation)
    if annotation in (int, float):
        return True
    return any(numeric(part) for part in parts) and dict not in (annotation, *parts)


@pytest.mark.parametrize(("section", "key", "field"), FIELDS, ids=lambda x: str(x)[:30])
def test_every_key_has_unit_default_and_an_example_that_is_valid(section, key, field):
    result = key_of(section, key)
    assert result.valid == field.description
    adapter = TypeAdapter(Annotated[field.annotation, *field.metadata, field])
    value = tomllib.loads(result.example)
    assert list(value) == [key]
    adapter.validate_python(value[key])
    if field.is_required():
        assert result.default == REQUIRED
    elif result.default != NOT_SET:
        default = tomllib.loads(f"x = {result.default}")["x"]
        assert adapter.validate_python(default) == field.get_default(call_default_factory=True)
    else:
        assert field.get_default(call_default_factory=True) in (None, (), {})
    texts = {
        "joint",
        "follows",
        "joint_sign",
        "seed",
        "target_normal",
        "robot_api_port",
    }  # numbers without a unit
    if numeric(field.annotation) and section_of(field) is None and key not in texts:
        assert result.unit


def test_the_example_of_a_section_is_a_section():
    """The keys of a section together, but for those that exclude each other."""
    apart = {"targets", "station_m", "work_q_rad", "options", "model", "joint_coupling"}
    apart |= {"center_m", "size_m", "base_link", "tip_link", "tracker_m"}
    lines = ['[robot]\nmodel = "ur10e"']
    for t in TABLES.values():
        if "." in t.name:
            continue
        lines += [t.header] if t.name != "robot" else []
        lines += [k.example for k in t.keys if k.name not in apart]
    config = CellConfig.model_validate(tomllib.loads("\n".join(lines)))
    assert config.planning.work_load == config.loads[0].name
    assert config.plausible == {"link_geometry": 4.0}


def test_no_key_is_invented():
    real = {(section, key) for section, key, _ in FIELDS}
    real |= {("plausible", "NAME"), ("ordinary", "NAME")}
    assert {(t.name, k.name) for t in TABLES.values() for k in t.keys} == real


def test_the_page_of_the_reference_is_what_the_program_writes():
    path = ROOT / "docs" / "reference" / "cell-configuration.md"
    written = hook("cell_page").page(list(TABLES.values()))
    assert path.read_text(encoding="utf-8") == written, "docs/hooks/cell_page.py makes it"


def test_config_in_the_terminal(capsys):
    words = ok(capsys, "config").out
    for t in TABLES.values():
        assert t.header in words
    words = ok(capsys, "config", "tracker").out
    for part in ("transverse_std_m", "unit: m; default: 7.5e-06", "example: port = "):
        assert part in words
    assert ok(capsys, "config", "[[loads]]").out == ok(capsys, "config", "loads").out
    (one,) = ok(capsys, "config", "tool.targets", "--json").document["sections"]
    assert (one["keys"][0]["name"], one["keys"][0]["default"]) == ("name", REQUIRED)
    everything = ok(capsys, "config", "--json").document["sections"]
    assert [s["name"] for s in everything] == list(TABLES)
