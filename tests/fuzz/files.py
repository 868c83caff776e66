"""Parsers of files, given damaged ones."""

import csv
import io
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np

import hilcal as hc
from hilcal.calibration.handover import Corrected, urdf
from hilcal.calibration.own_files.correct import correct_file
from hilcal.calibration.points import read_points
from hilcal.calibration.programs.languages import understood
from hilcal.campaign.campaign import Campaign
from hilcal.config import CellConfig, load_config
from hilcal.identification import parameters_document
from hilcal.robot.catalogue import arm_from_dh, configs_dir, load_arm
from hilcal.robot.factory import nominal_rows, read_factory, with_factory
from hilcal.robot.urdf import arm_from_urdf
from hilcal.store.plan import load_plan
from hilcal.tables.importing import import_readings
from hilcal.tables.mapping import Mapping, load_mapping
from tests.fuzz import stored
from tests.fuzz.bench import CELL, Bench
from tests.fuzz.damage import NUMBERS, bytes_damaged, document_damaged, toml_damaged, words_damaged
from tests.fuzz.harness import MEMORY_DISK, Accepted, Parser
from tests.fuzz.packed import packed
from tests.support.campaigns import configuration
from tests.support.description_files import MJCF, SDF
from tests.support.factory_cases import UR5E_YAML, factory_of
from tests.support.maker_arms import EXAMPLES, maker_arm, urdf_of


def _plain(readings: hc.Readings) -> None:
    """Refuse readings that no instrument and no arm can have given."""
    values = (readings.value, readings.covariance, readings.states.q)
    if not all(np.all(np.isfinite(v)) for v in values):
        raise Accepted("readings that are not finite")
    lowest = np.linalg.eigvalsh(readings.covariance)
    if np.any(lowest[:, 0] < -1e-9 * np.abs(lowest).max(axis=1)):
        raise Accepted("a covariance that is none")


def _cell_damaged(rows: list[list[str]], by: Random) -> list[list[str]]:
    """A table with cells, columns or rows changed as people and programs do."""
    out = [list(row) for row in rows]
    for _ in range(by.randint(1, 3)):
        col, row = by.randrange(len(out[0])), by.randrange(1, len(out))
        match by.randrange(9):
            case 0:
                for r in out[1:]:
                    r[col] = out[1][col]  # a constant column
            case 1:
                factor = by.choice((0.0, -1.0, 1e3, 1e-3, 57.29, 1e8, 1e-12, 1e150))
                for r in out[1:]:
                    r[col] = _scaled(r[col], factor)
            case 2:
                for r in out:
                    del r[col]
            case 3:
                out.append(list(out[row]))
            case 4 if len(out) > 3:
                del out[by.randrange(1, len(out)) :]
                out = out if len(out) > 1 else [list(r) for r in rows]
            case 5:
                other = by.randrange(len(out[0]))
                for r in out[1:]:
                    r[col], r[other] = r[other], r[col]
            case 6:
                covariance = [k for k, name in enumerate(out[0]) if name.startswith("cov_")]
                value = by.choice(("0", "1", "1e-30", "1e30", "-1", "1e-9"))
                for r in out[1:]:
                    for k in covariance:
                        r[k] = value
            case _:
                word = str(by.choice((*NUMBERS, "", "none", "5kg", "p0", "1,5", "1e-5")))
                out[row][col] = word
        if not out[0]:
            return [list(r) for r in rows]
    return out


def _scaled(text: str, factor: float) -> str:
    try:
        return repr(float(text) * factor)
    except ValueError:
        return text


def _csv(rows: list[list[str]]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()


def _table(bench: Bench) -> Parser:
    config = load_config(CELL)
    arm = load_arm(config.robot.model)

    def make(by: Random) -> bytes:
        kind = by.random()
        if kind < 0.3:
            return bytes_damaged(bench.table, by)
        if kind < 0.5:
            return words_damaged(bench.table.decode(), by).encode("utf-8", "replace")
        return _csv(_cell_damaged(bench.rows, by))

    def parse(data: bytes) -> bool:
        _plain(import_readings(bench.path("t.csv", data), "table", config, arm).readings)
        return True

    return Parser("table", make, parse)


def _points(bench: Bench) -> Parser:
    arm = load_arm("ur10e")
    rows = [["pose", *(f"q{k}_rad" for k in range(1, 7)), "load"]]
    rows += [[f"p{k}", "0.1", "-1.5", "1", "0", "0.3", "0", "none"] for k in range(5)]

    def make(by: Random) -> bytes:
        data = _csv(_cell_damaged(rows, by))
        return bytes_damaged(data, by) if by.random() < 0.3 else data

    def parse(data: bytes) -> bool:
        found = read_points(bench.path("p.csv", data), arm, {"none": np.zeros(6)})
        if np.any(np.isinf(found.q)) or np.abs(np.nan_to_num(found.q)).max() > 1e3:
            raise Accepted("points: joints that cannot be")
        return True

    return Parser("points", make, parse)


def _chain(bench: Bench) -> Parser:
    """A damaged table all the way: import, registration, fit, diagnosis."""
    cell = hc.Cell.load(CELL)

    def make(by: Random) -> bytes:
        return _csv(_cell_damaged(bench.rows, by))

    def parse(data: bytes) -> bool:
        readings = hc.read_table(bench.path("t.csv", data), cell)
        found = hc.fit(hc.baseline(cell, readings), readings)
        hc.diagnose(found)
        return True

    return Parser("chain", make, parse, limit_s=120.0)


def _cell_chain(bench: Bench) -> Parser:
    """A sound table in a damaged cell, all the way."""
    text = CELL.read_text()

    def make(by: Random) -> bytes:
        return words_damaged(text, by).encode("utf-8", "replace")

    def parse(data: bytes) -> bool:
        cell = hc.Cell.load(bench.path("chain.toml", data))
        readings = hc.read_table(bench.path("s.csv", bench.table), cell)
        hc.diagnose(hc.fit(hc.baseline(cell, readings), readings))
        return True

    return Parser("cell_chain", make, parse, limit_s=120.0)


def _campaign_chain(bench: Bench, damaged: Parser) -> Parser:
    """A damaged campaign, all the way."""

    def parse(data: bytes) -> bool:
        path = bench.path("chain.hilcal", data)
        path.with_name("chain.hilcal-journal").unlink(missing_ok=True)
        with Campaign.open(path) as run:
            hc.diagnose(hc.fit(hc.baseline(run.cell, run.readings), run.readings))
        return True

    return Parser("campaign_chain", damaged.make, parse, limit_s=120.0)


def _toml(bench: Bench, name: str, folder: str, read: Callable[[Path], object]) -> Parser:
    texts = [p.read_text() for p in sorted((configs_dir() / folder).glob("*.toml"))]

    def make(by: Random) -> bytes:
        return toml_damaged(by.choice(texts), by)

    def parse(data: bytes) -> bool:
        read(bench.path(f"{name}.toml", data))
        return True

    return Parser(name, make, parse)


def _factory(bench: Bench) -> Parser:
    """Kinematics of one arm, in each of the three forms."""
    nominal, made = load_arm("ur5e"), factory_of("ur5e")
    deltas = made.rows - nominal_rows(nominal)
    keys = ("delta_theta", "delta_a", "delta_d", "delta_alpha")
    conf = "".join(f"{k} = {v}\n" for k, v in zip(keys, deltas.tolist(), strict=True))
    texts = [(".yaml", UR5E_YAML), (".conf", f"[mounting]\n{conf}"), (".toml", made.to_toml())]

    def make(by: Random) -> bytes:
        k = by.randrange(len(texts))
        return bytes([k]) + bytes_damaged(texts[k][1].encode(), by)

    def parse(data: bytes) -> bool:
        path = bench.path(f"factory{texts[data[0] % len(texts)][0]}", data[1:])
        arm = with_factory(nominal, read_factory(path, nominal))
        if not np.isfinite(arm.links).all():
            raise Accepted("factory: transforms that are no numbers")
        return True

    return Parser("factory", make, parse)


def _document(
    bench: Bench, name: str, sound: Callable[[], str], read: Callable[[Path], object]
) -> Parser:
    kept: list[str] = []

    def make(by: Random) -> bytes:
        if not kept:
            kept.append(sound())
        return document_damaged(kept[0], by)

    def parse(data: bytes) -> bool:
        read(bench.path(f"{name}.json", data))
        return True

    return Parser(name, make, parse)


def _urdf(bench: Bench) -> Parser:
    text = urdf(load_arm("ur10e"))

    def make(by: Random) -> bytes:
        if by.random() < 0.3:
            return bytes_damaged(text.encode(), by)
        return words_damaged(text.replace(" ", "\n"), by).replace("\n", " ").encode(
            "utf-8", "replace"
        )  # fmt: skip

    def parse(data: bytes) -> bool:
        arm = arm_from_urdf(bench.path("a.urdf", data))
        if not np.all(np.isfinite(arm.q_min)) or not arm.n:
            raise Accepted("urdf: an arm that cannot be")
        return True

    return Parser("urdf", make, parse)


def _text_damaged(data: bytes, by: Random) -> bytes:
    """A program or description with bytes or words changed."""
    if by.random() < 0.5:
        return bytes_damaged(data, by)
    text = words_damaged(data.decode("latin-1").replace(" ", "\n"), by)
    return text.replace("\n", " ").encode("latin-1", "replace")


def _maker_program(bench: Bench, maker: str, name: str, frames: str | None) -> Parser:
    """A program of another maker than UR, read and written."""
    arm, data = maker_arm(maker, bench.folder), (EXAMPLES / name).read_bytes()
    if maker == "krl":
        bench.path("weld.dat", (EXAMPLES / "weld.dat").read_bytes())

    def parse(content: bytes) -> bool:
        path = bench.path(name, content)
        given = None if frames is None else EXAMPLES / frames
        found = understood(path, arm, frames=given, leave=True)
        if not np.all(np.isfinite(found.q)):
            raise Accepted(f"{maker}: points that are nowhere")
        if any(path.with_suffix(s).read_bytes() != c for s, c in found.corrected(found.q).items()):
            raise Accepted(f"{maker}: text that changed without a correction")
        return True

    return Parser(maker, lambda by: _text_damaged(data, by), parse, limit_s=10.0)


def _own_file(bench: Bench, name: str, text: str, ends: tuple[str, str]) -> Parser:
    """A description that an arm is written into."""
    arm = maker_arm("krl", bench.folder)
    links = arm.links.copy()
    links[2, :3, 3] += 1e-4
    new = Corrected(replace(arm, links=links), (), ())

    def parse(content: bytes) -> bool:
        correct_file(bench.path(name, content), arm, new, *ends)
        return True

    return Parser(name, lambda by: _text_damaged(text.encode(), by), parse)


def _campaign_fit(bench: Bench) -> Parser:
    """A damaged campaign, and its fit."""
    work = bench.folder / "mended.hilcal"

    def make(by: Random) -> bytes:
        return stored.mended(bench.run, work, by)

    def parse(data: bytes) -> bool:
        path = bench.path("c.hilcal", data)
        path.with_name("c.hilcal-journal").unlink(missing_ok=True)
        with Campaign.open(path) as run:
            _plain(run.readings)
            if run.latest() is not None:
                run.calibration()
        return True

    return Parser("campaign_fit", make, parse, limit_s=20.0)


def parsers() -> list[Parser]:
    """All of them."""
    folder = Path(tempfile.mkdtemp(prefix="hilcal-fuzz-", dir=MEMORY_DISK))
    import atexit

    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    bench = Bench(folder)

    campaigns = _campaign_fit(bench)
    return [
        _table(bench),
        _points(bench),
        *packed(bench),
        _toml(bench, "mapping", "mappings", lambda p: load_mapping(p, Mapping)),
        _toml(bench, "cell", "cells", hc.Cell.load),
        _toml(bench, "arm", "robots", arm_from_dh),
        _document(
            bench,
            "config",
            configuration().to_json,
            lambda p: CellConfig.from_json(p.read_text(errors="replace")),
        ),
        _document(bench, "plan", lambda: bench.plan, load_plan),
        _document(bench, "parameters", bench.of_run("parameters"), parameters_document.read),
        _factory(bench),
        _urdf(bench),
        _maker_program(bench, "krl", "weld.src", "config.dat"),
        _maker_program(bench, "rapid", "weld.mod", None),
        _maker_program(bench, "fanuc", "weld.ls", "fanuc.toml"),
        _maker_program(bench, "inform", "weld.jbi", "yaskawa.toml"),
        _own_file(bench, "own.urdf", urdf_of("krl"), ("base_link", "tool0")),
        _own_file(bench, "own.xml", MJCF, ("base", "flange")),
        _own_file(bench, "own.sdf", SDF, ("base", "tool0")),
        campaigns,
        *stored.parsers(bench),
        _chain(bench),
        _cell_chain(bench),
        _campaign_chain(bench, campaigns),
    ]
