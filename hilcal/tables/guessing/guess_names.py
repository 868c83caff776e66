"""Poses, loads, cycles, times and temperatures, guessed from names and values."""

from collections.abc import Callable
from datetime import datetime
from typing import Any

import numpy as np

from hilcal.readings.readings import SAME_POSE
from hilcal.tables.guessing import column_names as words
from hilcal.tables.guessing.guess_values import time_unit
from hilcal.tables.guessing.guesser import REPORTED, SHOWN, Guesser
from hilcal.tables.mapping import UNLOADED
from hilcal.tables.units import ANGLES


def guess_names(g: Guesser) -> None:
    """Poses, loads, cycles and reflectors."""
    q = g.proposal.sections.get("joints")
    _pick(g, "pose", words.POSE, lambda n: q is None or _one_pose_each(g, n, q))
    for c in list(g.free.values()):
        if c.has(words.MASS | words.LOAD) and g.number(c.name) and "load" not in g.free:
            mass = c.unit in ("kg", "g", "lb") or c.has(words.MASS)
            if mass and "hung_mass" not in g.proposal.sections:
                unit = c.unit if c.unit in ("kg", "g", "lb") else "kg"
                if "wrench" in g.proposal.sections:
                    continue
                g.take("hung_mass", [c.name], unit, column=c.name, unit=unit)
    if "hung_mass" not in g.proposal.sections:
        _pick(g, "load", words.LOAD, lambda n: True)
    if not {"load", "hung_mass"} & set(g.proposal.sections):
        for c in list(g.free.values()):
            texts = [t.lower() for t in g.grid.text(c.name)]
            few = 1 < len(set(texts)) <= 20
            if not g.number(c.name) and few and set(texts) & (set(UNLOADED) - {"0", "-", "no"}):
                g.take("load", [c.name], "name", column=c.name)
                g.unsure("load", f"'{c.name}' has a value that means no load")
                break
    if (load := g.proposal.sections.get("load")) is not None:
        values = {t.lower() for t in g.grid.text(load["column"])}
        if not values & {*UNLOADED, ""}:
            shown = ", ".join(sorted(values)[:SHOWN])
            g.unsure("load", f"which of its values means no load? Set none = [...] ({shown})")
    _pick(g, "cycle", words.CYCLE, lambda n: g.number(n) and _whole(g, n))
    _pick(g, "target", words.REFLECTOR, lambda n: not g.number(n) and _few(g, n))


def _pick(
    g: Guesser, what: str, known: set[str], fits: Callable[[str], bool], meaning: str = "name"
) -> None:
    for c in list(g.free.values()):
        if c.has(known) and not c.axis and not c.has(words.STD) and _is_name(g, c.name):
            if not fits(c.name):
                continue
            g.take(what, [c.name], meaning, column=c.name)
            return


def _is_name(g: Guesser, name: str) -> bool:
    """Whether a column holds text or whole numbers."""
    return not g.number(name) or _whole(g, name)


def _whole(g: Guesser, name: str) -> bool:
    values = g.block([name])[:, 0]
    known = values[np.isfinite(values)]
    return bool(np.all(known == np.rint(known)))


def _few(g: Guesser, name: str) -> bool:
    count = len(set(g.grid.text(name)))
    return 1 < count <= min(20, len(g.grid.rows) // 2)


def _one_pose_each(g: Guesser, name: str, joints: dict[str, Any]) -> bool:
    """Whether all rows of a name command the same joints, or reported nearly the same."""
    texts = g.grid.text(name)
    if "" in texts:
        return False
    q = g.block(joints["columns"]) * ANGLES[joints["unit"]]
    first: dict[str, int] = {}
    rows = [first.setdefault(text, k) for k, text in enumerate(texts)]
    off = np.nan_to_num(np.abs(q - q[rows]))
    if off.max() > REPORTED:
        k = int(np.argmax(off.max(axis=1)))
        g.unsure("joints", f"'{name}' is no pose: '{texts[k]}' stands at different joints")
        return False
    if off.max() > SAME_POSE and "actual_joints" not in g.proposal.sections:
        joints["reported"] = True
        g.unsure("joints", f"they differ by up to {off.max():.2g} rad in a pose: reported angles")
    return True


def guess_scalars(g: Guesser) -> None:
    """Times and the temperature of the air."""
    for c in list(g.free.values()):
        dated = all(isinstance(cell, datetime) for cell in g.grid.cells(c.name))
        timed = dated or (c.has(words.TIME) and not c.axis)
        if "time" not in g.proposal.sections and timed:
            found = time_unit(g.grid, c.name, c.unit, g.values[c.name])
            if found is not None:
                section, doubt = found
                if doubt:
                    g.unsure("time", doubt)
                g.take("time", [c.name], str(section["unit"]), column=c.name, **section)
        elif (
            "air" not in g.proposal.sections
            and (c.has(words.TEMPERATURE) or (c.has(words.AIR) and c.unit in ("degC", "K", "degF")))
            and g.number(c.name)
            and not c.numbers
        ):
            values = g.block([c.name])
            unit = c.unit or ("K" if np.nanmin(values) > 200 else "degC")
            if unit in ("degC", "degF", "K"):
                g.take("air", [c.name], unit, column=c.name, unit=unit)
