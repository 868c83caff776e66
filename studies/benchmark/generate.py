"""`python -m studies.benchmark.generate`: make tasks from a key, the same bytes for the same key.

Everything random in a task comes from HMAC-SHA256(key, id of the task). The public tasks are
those of the key "public"; those of another key are unknown until the key is known. The key
also determines which effects a task hides, and how strongly: an id contains only its track, and an
entrant cannot distinguish a private task from a public one.

Needs hilcal; track mujoco also `mujoco`; the real tracks the folder HILCAL_DATA.
"""

import hmac
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from hilcal.calibration.handover import urdf
from hilcal.cli import application, execute
from hilcal.errors import InputError
from hilcal.types import Floats
from hilcal.whole_file import replace_file
from studies.benchmark import real
from studies.benchmark.campaign import ARMS, CANDIDATES, NoiselessTask, campaign, candidates
from studies.benchmark.laws import LAWS, law
from studies.benchmark.mujoco_tasks import SHOWN, mujoco_task
from studies.benchmark.task import JOINTS, POSITION, WRENCH
from studies.benchmark.world_elastic import elastic

PUBLIC = "public"
POSES = (30, 100, 300)
STRENGTHS = (0.5, 1.0, 3.0)
LAW_STRENGTHS = (1.0, 3.0)
_DECIMALS = {**dict.fromkeys(JOINTS, 7), **dict.fromkeys(POSITION, 6)}


@dataclass(frozen=True, slots=True)
class Spec:
    """Specification of a task.

    Attributes:
        id: name of the task.
        track: "elastic", "mujoco", "law", "ur10" or "ur5".
        number: of the task within its track, from 0, in the order of cells.
        poses: number of training poses.
        strength: of each effect; 0 for none.
        count: number of hidden effects.
    """

    id: str
    track: str
    number: int
    poses: int
    strength: float = 0.0
    count: int = 0


def specs(part: str, key: str, tracks: Sequence[str], rounds: int) -> Iterator[Spec]:
    """Yield all tasks of a part, each cell of N, strength and kind `rounds` times.

    The key determines the order of the ids.
    """
    for track in tracks:
        cells: list[tuple[int, float, int]]
        if track in real.SERIES:
            cells = [(n, 0.0, 0) for n, _ in product(real.POSES, real.SERIES[track])]
        elif track == "law":
            cells = [(n, s, 0) for n, s in product(POSES, LAW_STRENGTHS)] * 2
        else:
            cells = [(n, s, k) for n, s, k in product(POSES, STRENGTHS, (1, 2))]
            cells += [(n, 0.0, 0) for n in POSES]
        cells = cells * rounds
        order = seeded(key, f"{part} {track}").permutation(len(cells))
        for number, (place, (n, strength, count)) in enumerate(zip(order, cells, strict=True)):
            yield Spec(f"{track}-{place + 1:03d}", track, number, n, strength, count)


def seeded(key: str, name: str) -> np.random.Generator:
    """Return the generator of a name under a key."""
    digest = hmac.new(key.encode(), name.encode(), "sha256").digest()
    return np.random.default_rng(int.from_bytes(digest, "big"))


def make(spec: Spec, part: str, key: str) -> dict[str, str]:
    """Return the files of a task by name.

    Raises:
        InputError: the data of a real track that are missing or damaged.
    """
    rng = seeded(key, spec.id)
    if spec.track in real.SERIES:
        task = real.real_task(spec.track, spec.number, spec.poses, rng)
        read = task.position
    else:
        task = _simulated(spec, part, key, rng)
        read = task.position + task.sigma * rng.standard_normal(task.position.shape)
    c, cell = task.campaign, task.campaign.cell
    about = {
        "id": spec.id,
        "track": spec.track,
        "n_poses": spec.poses,
        "n_train": c.n_train,
        "n_test": len(c.states) - c.n_train,
        "arm": {
            "name": cell.arm.name,
            "target_m": np.round(cell.target[:3, 3], 6).tolist(),
            "tool": {"mass_kg": cell.tool_mass, "com_m": cell.tool_com.tolist()},
            "load_point_m": cell.load_point.tolist(),
            "gravity_m_s2": cell.gravity.tolist(),
        },
        "noise": {"sigma_m": task.sigma},
        "frame": "tracker",
        **task.about,
        "candidates": candidates() if spec.track in ("elastic", "mujoco") else [],
    }
    q, wrench = c.states.q, c.states.wrench
    states = {name: q[:, j] for j, name in enumerate(JOINTS)}
    further = {name: wrench[:, j] for j, name in enumerate(WRENCH)}
    if c.states.time is not None:
        further["time_s"] = c.states.time
    further |= task.columns
    measured = {name: read[:, j] for j, name in enumerate(POSITION)}
    true = {name: task.position[:, j] for j, name in enumerate(POSITION)}
    first, last = slice(0, c.n_train), slice(c.n_train, None)
    labels = {"pose": c.pose, "load": c.load}
    return {
        "task.json": json.dumps(about, indent=1) + "\n",
        "robot.urdf": urdf(cell.arm),
        "train.csv": _csv(labels, {**states, **measured, **further}, first),
        "test.csv": _csv(labels, {**states, **further}, last),
        "truth.json": json.dumps({"part": part, **task.truth}, indent=1) + "\n",
        "truth.csv": _csv({}, true, last, decimals=7),
    }


def _simulated(spec: Spec, part: str, key: str, rng: np.random.Generator) -> NoiselessTask:
    """Make a simulated task; over the tasks of a track effects take turns, arms are random."""
    turn = seeded(key, f"{part} {spec.track} effects")
    c = campaign(str(rng.choice(ARMS)), spec.poses, rng)
    if spec.track == "law":
        number = int(turn.permutation(len(LAWS))[spec.number % len(LAWS)])
        return law(c, number, spec.strength, rng)
    names = CANDIDATES if spec.track == "elastic" else SHOWN
    order = turn.permutation(len(names))
    choice = [names[k] for k in np.roll(order, -(3 * spec.number // 2))]
    count = spec.count if spec.count < 2 else int(rng.integers(2, 4))
    hide: Callable[..., NoiselessTask] = elastic if spec.track == "elastic" else mujoco_task
    return hide(c, choice, count, spec.strength, rng)


def _csv(
    labels: dict[str, tuple[str, ...]],
    columns: dict[str, Floats],
    rows: slice,
    decimals: int | None = None,
) -> str:
    texts = [values[rows] for values in labels.values()]
    for name, values in columns.items():
        places = _DECIMALS.get(name, 3) if decimals is None else decimals
        texts.append(tuple(_short(float(v), places) for v in values[rows]))
    lines = [",".join((*labels, *columns)), *map(",".join, zip(*texts, strict=True))]
    return "\n".join(lines) + "\n"


def _short(value: float, places: int) -> str:
    text = f"{value:.{places}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def generate(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder that tasks are put into.")],
    part: Annotated[str, typer.Option("--part", help="public or private.")] = PUBLIC,
    key: Annotated[str, typer.Option("--key", help="Of the private part; keep it secret.")] = "",
    tracks: Annotated[str, typer.Option("--tracks", help="By name, commas between.")] = "",
    rounds: Annotated[int, typer.Option("--rounds", min=1, help="Tasks of each cell.")] = 1,
) -> None:
    """Make the tasks of a part; tracks that cannot be made here are named and left out."""
    if part not in (PUBLIC, "private"):
        raise InputError(f"part {part!r}; valid: public, private")
    if (part == PUBLIC) == bool(key) or key == PUBLIC:
        valid = "none" if part == PUBLIC else "--key KEY, another than that of the public part"
        raise InputError(f"key {key!r} for the {part} part; valid: {valid}")
    every = ("elastic", "mujoco", "law", *real.SERIES)
    chosen = tuple(tracks.split(",")) if tracks else every
    for track in chosen:
        if track not in every:
            raise InputError(f"track {track!r}; valid: {', '.join(every)}")
        lacks = _lacking(track)
        if lacks:
            print(f"track {track} is left out: {lacks}", file=sys.stderr)
            continue
        for spec in specs(part, key or PUBLIC, (track,), rounds):
            folder = out / spec.id
            folder.mkdir(parents=True, exist_ok=True)
            for name, text in make(spec, part, key or PUBLIC).items():
                replace_file(folder / name, text)
            print(folder)


def _lacking(track: str) -> str:
    """Return what a track lacks, as text; empty where nothing is missing."""
    if track == "mujoco" and find_spec("mujoco") is None:
        return "it needs `pip install mujoco`"
    if track in real.SERIES and not os.environ.get("HILCAL_DATA"):
        return "HILCAL_DATA names no folder with its data"
    return ""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; exit codes and messages as those of `hilcal`."""
    app: typer.Typer = application("Make tasks of the benchmark of hidden effects.")
    app.command("generate")(generate)
    execute(lambda: app, "generate", sys.argv[1:] if arguments is None else arguments)


if __name__ == "__main__":
    main()
