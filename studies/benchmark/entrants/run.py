"""Run the entrants on tasks, each in its own environment; store, score and print the results.

    python -m studies.benchmark.entrants.run TASKS -o RESULTS [--entrants a,b] [--tasks GLOB]
        [--beside KEPT]

An entrant is a folder beside this file with entrant.py and requirements.txt. Its environment is
made once. It gets a copy of the task without the truth. A failure (crash, time limit, answer with a
wrong format) is stored as {"failed": reason}. Exit code 3 means that the entrant cannot run on this
machine; it is then not tried on other tasks. Existing results are not computed again, so that a
stopped run continues.
"""

import argparse
import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import venv
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ..score import score_all
from ..task import BenchmarkError, folders, for_entrants, read_result, read_task
from .tables import block, kept, page

HERE = Path(__file__).parent
ROOT = HERE.parents[2]
CANNOT_RUN = 3
"""Exit code of an entrant that cannot run on this machine."""
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True, slots=True)
class Entrants:
    """The entrants and their environments.

    Attributes:
        home: folder with a folder for each entrant.
        envs: folder of the environments.
        environments: interpreters by entrant, instead of an environment.
        limit: time limit for a task, s.
        unable: reasons by entrant that cannot run on this machine; filled during the run.
    """

    home: Path
    envs: Path
    environments: Mapping[str, Path]
    limit: float
    unable: dict[str, str] = field(default_factory=dict)

    def names(self) -> list[str]:
        """Return all entrants."""
        return sorted(path.parent.name for path in self.home.glob("*/entrant.py"))

    def prepare(self, name: str) -> None:
        """Make the environment of an entrant, unless it exists; store the reason of a failure."""
        if name in self.environments:
            return
        needs = self.home / name / "requirements.txt"
        mark, stamp = self.envs / name / "made", hashlib.sha256(needs.read_bytes()).hexdigest()
        if mark.exists() and mark.read_text(encoding="utf-8") == stamp:
            return
        venv.create(self.envs / name, with_pip=True, clear=True)
        pip = [
            str(self.python(name)),
            "-m",
            "pip",
            "install",
            "--quiet",
            "-r",
            str(needs.absolute()),
        ]
        done = subprocess.run(pip, capture_output=True, text=True, cwd=ROOT, check=False)  # noqa: S603
        if done.returncode:
            self.unable[name] = f"its environment cannot be made: {_last(done.stderr, 'ERROR')}"
        else:
            _put(mark, stamp)

    def python(self, name: str) -> Path:
        """Return the interpreter of an entrant."""
        return self.environments.get(name, self.envs.absolute() / name / "bin" / "python")

    def run(self, name: str, task: Path, out: Path) -> None:
        """Run an entrant on a task, and store its answer or the reason of its failure."""
        reason = self.unable.get(name) or self._answer(name, task, out)
        if reason:
            _put(out, json.dumps({"failed": reason}))

    def _answer(self, name: str, task: Path, out: Path) -> str:
        env = {
            k: v for k, v in os.environ.items() if k != "PYTHONPATH" or name in self.environments
        }
        with tempfile.TemporaryDirectory() as folder:
            copy, new = Path(folder, task.name), Path(folder, "out.json")
            for_entrants(task, copy)
            command = [self.python(name), (self.home / name / "entrant.py").absolute(), copy, new]
            with subprocess.Popen(  # noqa: S603
                command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=folder,
                env=env | ONE_THREAD, start_new_session=True,
            ) as process:  # fmt: skip
                try:
                    stderr = process.communicate(timeout=self.limit)[1]
                except subprocess.TimeoutExpired:
                    os.killpg(process.pid, signal.SIGKILL)
                    return f"no answer within {self.limit:g} s"
            if process.returncode == CANNOT_RUN:
                self.unable[name] = _last(stderr)
                return self.unable[name]
            if process.returncode:
                return f"exit code {process.returncode}: {_last(stderr)}"
            try:
                read_result(new, read_task(copy))
            except BenchmarkError as error:
                return str(error).replace(f"{new}: ", "")
            _put(out, new.read_text(encoding="utf-8"))
        return ""


def scores(tasks: Path, results: Path) -> list[dict[str, Any]]:
    """Return a row of scores for each entrant and task that was run.

    Raises:
        BenchmarkError: as `score_all`.
    """
    rows = []
    for row in score_all(tasks, results)["tasks"]:
        path = results / row["entrant"] / f"{row['task']}.json"
        if path.exists():
            if row["failed"]:  # without the name of the file
                row["failed"] = row["failed"].replace(f"{path}: ", "").removeprefix("failed: ")
            rows.append(
                {n: float(f"{v:.4g}") if isinstance(v, float) else v for n, v in row.items()}
            )
    return rows


def _put(path: Path, text: str) -> None:
    """Write a file under a temporary name, and rename it when it is complete."""
    new = path.with_name(f".{path.name}.new")
    new.write_text(text, encoding="utf-8")
    new.replace(path)


def _last(text: str, word: str = "") -> str:
    """Return the last line with a word, or the last one that is not blank."""
    lines = [line for line in text.splitlines() if line.strip() and word in line]
    return lines[-1][:300] if lines else "no words"


def _pairs(options: Sequence[str]) -> dict[str, Path]:
    pairs = [text.partition("=") for text in options]
    return {name: Path(path) for name, _, path in pairs}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, score and print; exit code 2 for wrong input."""
    p = argparse.ArgumentParser(prog="run", description="Run the benchmark's entrants.")
    p.add_argument("folder", metavar="TASKS", type=Path, help="folder of tasks with their truth")
    p.add_argument("-o", "--output", metavar="RESULTS", type=Path, required=True)
    p.add_argument("--entrants", default="", help="names, by commas; all where absent")
    p.add_argument("--tasks", default="*", help='which: a pattern of their names, e.g. "law-*"')
    p.add_argument("--jobs", type=int, default=1, help="runs at the same time")
    p.add_argument("--limit", type=float, default=900.0, help="seconds for a task")
    p.add_argument("--home", type=Path, default=HERE, help="folder of the entrants")
    p.add_argument("--envs", type=Path, default=Path(".benchmark-envs"), help="of environments")
    python_help = "an interpreter for an entrant, in the place of its environment"
    p.add_argument("--python", action="append", default=[], metavar="NAME=PATH", help=python_help)
    p.add_argument("--score", action="store_true", help="run nothing, score what is there")
    p.add_argument("--keep", type=Path, help="keep the scores, JSON")
    beside_help = "scores that were kept: in the table, entrants that were not run stand beside"
    p.add_argument("--beside", metavar="KEPT", type=Path, help=beside_help)
    p.add_argument("--page", type=Path, help="write the page of tables, Markdown")
    options = p.parse_args(arguments)
    entrants = Entrants(options.home, options.envs, _pairs(options.python), options.limit)
    try:
        stored = _kept(options.beside) if options.beside else []
        valid = entrants.names()
        names = options.entrants.split(",") if options.entrants else valid
        if unknown := [*{*names, *entrants.environments} - {*valid}]:
            raise BenchmarkError(f"entrant {unknown[0]!r} is unknown; valid: {', '.join(valid)}")
        tasks = [t for t in folders(options.folder) if t.match(options.tasks)]
        if not tasks:
            raise BenchmarkError(
                f"--tasks {options.tasks}: no task of {options.folder} is called so"
            )
        attempts = [(n, t, options.output / n / f"{t.name}.json") for t in tasks for n in names]
        missing = [(n, t, out) for n, t, out in attempts if not (options.score or out.exists())]
        for name in dict.fromkeys(n for n, _, _ in missing):
            print(f"preparing {name}", file=sys.stderr, flush=True)
            entrants.prepare(name)
            (options.output / name).mkdir(parents=True, exist_ok=True)
        with ThreadPoolExecutor(max(options.jobs, 1)) as pool:
            runs = [(n, t, pool.submit(entrants.run, n, t, out)) for n, t, out in missing]
            for k, (name, task, run) in enumerate(runs, start=1):
                run.result()
                print(f"{k}/{len(runs)} {name} {task.name}", file=sys.stderr, flush=True)
        rows = scores(options.folder, options.output)
    except BenchmarkError as error:
        print(f"run: {error}", file=sys.stderr)
        return 2
    date = datetime.now(UTC).date().isoformat()
    if options.keep:
        names = list(dict.fromkeys(name for row in rows for name in row))
        lines = ",\n".join(json.dumps([row.get(name) for name in names]) for row in rows)
        head = json.dumps({"date": date, "columns": names})[:-1]
        _put(options.keep, f'{head}, "rows": [\n{lines}\n]}}\n')
    if options.page:
        _put(options.page, page(date, rows, options.home))
    ran, done = {row["entrant"] for row in rows}, {(row["task"], row["part"]) for row in rows}
    added = [r for r in stored if r["entrant"] not in ran and (r["task"], r["part"]) in done]
    print(block(rows + added))
    return 0


def _kept(path: Path) -> list[dict[str, Any]]:
    """Return the rows of stored scores.

    Raises:
        BenchmarkError: a file that holds no scores.
    """
    try:
        return kept(path)[1]
    except (OSError, ValueError, KeyError, TypeError) as error:
        why = f"cannot be read ({error}); valid: a file that --keep wrote"
        raise BenchmarkError(f"--beside {path}: {why}") from error


if __name__ == "__main__":
    sys.exit(main())
