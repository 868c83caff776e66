"""`python -m tests.fuzz [PARSER ...] [--inputs N] [--seed S] [--out FILE] [--keep DIR]`."""

import argparse
import json
import sys
import time
from pathlib import Path

from tests.fuzz import files, harness, wire


def main() -> int:
    """Run, and add the counts to a file."""
    known = {p.name: p for p in (*wire.parsers(), *files.parsers())}
    ask = argparse.ArgumentParser(prog="python -m tests.fuzz", description=harness.__doc__)
    ask.add_argument("parser", nargs="*", help="names, or all: " + ", ".join(known))
    ask.add_argument("--inputs", type=int, default=1000)
    ask.add_argument("--seed", type=int, default=0)
    ask.add_argument("--out", type=Path, help="JSON file that the counts are added to")
    ask.add_argument("--keep", type=Path, help="directory for inputs of findings")
    ask.add_argument("--replay", type=Path, help="give the parser this file instead")
    asked = ask.parse_args()
    names = list(known) if asked.parser in ([], ["all"]) else asked.parser
    if unknown := [name for name in names if name not in known]:
        ask.error(f"no parser {unknown[0]!r}; valid: {', '.join(known)}")
    if asked.replay is not None:
        print(known[names[0]].parse(asked.replay.read_bytes()))
        return 0
    any_findings = False
    for name in names:
        begun = time.process_time()
        out = harness.fuzz(known[name], asked.inputs, asked.seed, asked.keep)
        seconds = time.process_time() - begun
        print(
            f"{name}: {out.inputs} inputs, {out.read} read, {sum(out.refused.values())} refused, "
            f"{sum(out.findings.values())} findings, {out.collisions} collisions; "
            f"{out.inputs / max(seconds, 1e-9):.0f}/s of processor time, "
            f"slowest {out.slowest_s:.3f} s",
            flush=True,
        )
        for line, count in out.findings.most_common():
            print(f"  {count} x {line}  {out.kept.get(line, '')}", flush=True)
        any_findings = any_findings or bool(out.findings)
        if asked.out is not None:
            _add(asked.out, name, asked.seed, out, seconds)
        if out.stopped:
            break
    return int(any_findings)


def _add(path: Path, name: str, seed: int, out: harness.Outcome, seconds: float) -> None:
    """Add the counts of a run to those of the runs before."""
    document = json.loads(path.read_text()) if path.exists() else {}
    entry = document.setdefault(name, {"inputs": 0, "read": 0, "refused": 0, "findings": {}})
    entry["inputs"] += out.inputs
    entry["read"] += out.read
    entry["refused"] += sum(out.refused.values())
    entry["collisions"] = entry.get("collisions", 0) + out.collisions
    entry["processor_s"] = round(entry.get("processor_s", 0.0) + seconds, 1)
    entry["slowest_s"] = round(max(entry.get("slowest_s", 0.0), out.slowest_s), 3)
    entry.setdefault("seeds", []).append(seed)
    for line, count in out.findings.items():
        entry["findings"][line] = entry["findings"].get(line, 0) + count
    path.write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(main())
