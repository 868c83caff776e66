"""Parsers of files, given damaged ones."""

import atexit
import csv
import io
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np

import hilcal as hc
from hilcal.calibration.handover import CorrectedArm, urdf
from hilcal.calibration.points import read_points
from hilcal.calibration.programs.languages import read_program
from hilcal.calibration.robot_files.descriptions import correct_file
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
from tests.fuzz.damage import NUMBERS, bytes_damaged, text_damaged, toml_damaged, words_damaged
from tests.fuzz.harness import Accepted, Make, Parser
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
        if by.random() < 0.5:
            return text_damaged(bench.table.decode(), by)
        return _csv(_cell_damaged(bench.rows, by))

    def read(path: Path) -> None:
        _plain(import_readings(path, "table", config, arm).readings)

    return bench.reader("table", "t.csv", make, read)


def _points(bench: Bench) -> Parser:
    arm = load_arm("ur10e")
    rows = [["pose", *(f"q{k}_rad" for k in range(1, 7)), "load"]]
    rows += [[f"p{k}", "0.1", "-1.5", "1", "0", "0.3", "0", "none"] for k in range(5)]

    def make(by: Random) -> bytes:
        data = _csv(_cell_damaged(rows, by))
        return bytes_damaged(data, by) if by.random() < 0.3 else data

    def read(path: Path) -> None:
        q = read_points(path, arm, {"none": np.zeros(6)}).q
        if np.any(np.isinf(q)) or np.abs(np.nan_to_num(q)).max() > 1e3:
            raise Accepted("points: joints that cannot be")

    return bench.reader("points", "p.csv", make, read)


def _diagnosed(cell: hc.Cell, readings: hc.Readings) -> None:
    """Go all the way: registration, fit, diagnosis."""
    hc.diagnose(hc.fit(hc.baseline(cell, readings), readings))


def _chains(bench: Bench, damaged_campaign: Make) -> list[Parser]:
    """A damaged table, a damaged cell or a damaged campaign, all the way."""
    cell, text = hc.Cell.load(CELL), CELL.read_text()

    def table(path: Path) -> None:
        _diagnosed(cell, hc.read_table(path, cell))

    def of_cell(path: Path) -> None:
        damaged = hc.Cell.load(path)
        _diagnosed(damaged, hc.read_table(bench.path("s.csv", bench.table), damaged))

    def campaign(path: Path) -> None:
        with Campaign.open(path) as run:
            _diagnosed(run.cell, run.readings)

    def words(by: Random) -> bytes:
        return words_damaged(text, by).encode("utf-8", "replace")

    def cells(by: Random) -> bytes:
        return _csv(_cell_damaged(bench.rows, by))

    return [
        bench.reader("chain", "chain.csv", cells, table, 120.0),
        bench.reader("cell_chain", "chain.toml", words, of_cell, 120.0),
        bench.reader("campaign_chain", "chain.hilcal", damaged_campaign, campaign, 120.0),
    ]


def _toml(bench: Bench, name: str, folder: str, read: Callable[[Path], object]) -> Parser:
    texts = [p.read_text() for p in sorted((configs_dir() / folder).glob("*.toml"))]
    return bench.reader(name, f"{name}.toml", lambda by: toml_damaged(by.choice(texts), by), read)


def _factory(bench: Bench) -> list[Parser]:
    """Kinematics of one arm, in each of the three forms."""
    nominal, made = load_arm("ur5e"), factory_of("ur5e")
    deltas = made.rows - nominal_rows(nominal)
    keys = ("delta_theta", "delta_a", "delta_d", "delta_alpha")
    conf = "".join(f"{k} = {v}\n" for k, v in zip(keys, deltas.tolist(), strict=True))
    texts = {".yaml": UR5E_YAML, ".conf": f"[mounting]\n{conf}", ".toml": made.to_toml()}

    def read(path: Path) -> None:
        arm = with_factory(nominal, read_factory(path, nominal))
        if not np.isfinite(arm.links).all():
            raise Accepted("factory: transforms that are no numbers")

    def parser(name: str, text: bytes) -> Parser:
        return bench.reader(name, name, lambda by: bytes_damaged(text, by), read)

    return [parser(f"factory{suffix}", text.encode()) for suffix, text in texts.items()]


def _urdf(bench: Bench) -> Parser:
    text = urdf(load_arm("ur10e"))

    def read(path: Path) -> None:
        arm = arm_from_urdf(path)
        if not np.all(np.isfinite(arm.q_min)) or not arm.n:
            raise Accepted("urdf: an arm that cannot be")

    return bench.reader("urdf", "a.urdf", lambda by: text_damaged(text, by, by_words=True), read)


def _maker_program(bench: Bench, maker: str, name: str, frames: str | None) -> Parser:
    """A program of another maker than UR, read and written."""
    arm, text = maker_arm(maker, bench.folder), (EXAMPLES / name).read_bytes().decode("latin-1")
    if maker == "krl":
        bench.path("weld.dat", (EXAMPLES / "weld.dat").read_bytes())

    def make(by: Random) -> bytes:
        return text_damaged(text, by, by_words=True, encoding="latin-1")

    def read(path: Path) -> None:
        given = None if frames is None else EXAMPLES / frames
        program = read_program(path, arm, frames=given, leave=True)
        if not np.all(np.isfinite(program.q)):
            raise Accepted(f"{maker}: points that are nowhere")
        corrected = program.corrected(program.q)
        if any(path.with_suffix(s).read_bytes() != content for s, content in corrected.items()):
            raise Accepted(f"{maker}: text that changed without a correction")

    return bench.reader(maker, name, make, read, 10.0)


def _own_files(bench: Bench) -> list[Parser]:
    """Descriptions that an arm is written into."""
    arm = maker_arm("krl", bench.folder)
    links = arm.links.copy()
    links[2, :3, 3] += 1e-4
    new = CorrectedArm(replace(arm, links=links), (), ())

    def parser(name: str, text: str, base: str, tip: str) -> Parser:
        def make(by: Random) -> bytes:
            return text_damaged(text, by, by_words=True)

        return bench.reader(name, name, make, lambda path: correct_file(path, arm, new, base, tip))

    return [
        parser("own.urdf", urdf_of("krl"), "base_link", "tool0"),
        parser("own.xml", MJCF, "base", "flange"),
        parser("own.sdf", SDF, "base", "tool0"),
    ]


def _campaign_fit(bench: Bench) -> Parser:
    """A damaged campaign, and its fit."""
    work = bench.folder / "mended.hilcal"

    def read(path: Path) -> None:
        with Campaign.open(path) as run:
            _plain(run.readings)
            if run.latest() is not None:
                run.calibration()

    def make(by: Random) -> bytes:
        return stored.mended(bench.run, work, by)

    return bench.reader("campaign_fit", "c.hilcal", make, read, 20.0)


def parsers() -> list[Parser]:
    """All of them; SQLite waits for the disk at every commit, but not where files are in memory."""
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    bench = Bench(Path(tempfile.mkdtemp(prefix="hilcal-fuzz-", dir=memory)))
    atexit.register(shutil.rmtree, bench.folder, ignore_errors=True)
    campaigns = _campaign_fit(bench)
    return [
        _table(bench),
        _points(bench),
        *packed(bench),
        _toml(bench, "mapping", "mappings", lambda p: load_mapping(p, Mapping)),
        _toml(bench, "cell", "cells", hc.Cell.load),
        _toml(bench, "arm", "robots", arm_from_dh),
        bench.document(
            "config",
            configuration().to_json,
            lambda p: CellConfig.from_json(p.read_text(errors="replace")),
        ),
        bench.document("plan", lambda: bench.plan, load_plan),
        bench.document(
            "parameters", lambda: bench.documents["parameters"], parameters_document.read
        ),
        *_factory(bench),
        _urdf(bench),
        _maker_program(bench, "krl", "weld.src", "config.dat"),
        _maker_program(bench, "rapid", "weld.mod", None),
        _maker_program(bench, "fanuc", "weld.ls", "fanuc.toml"),
        _maker_program(bench, "inform", "weld.jbi", "yaskawa.toml"),
        *_own_files(bench),
        campaigns,
        *stored.parsers(bench),
        *_chains(bench, campaigns.make),
    ]
