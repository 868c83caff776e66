"""What holds of the text of every module; each is read and parsed once."""

import ast
import re
from functools import cache

from hilcal.cli.commands import COMMANDS
from tests.support.cli_cases import ok
from tests.support.effect_cases import NAMES
from tests.support.paths import ROOT


@cache
def modules():
    """Trees of all modules, by their paths below the root."""
    paths = (
        path for room in ("hilcal", "drivers", "studies") for path in (ROOT / room).rglob("*.py")
    )
    return {
        path.relative_to(ROOT).as_posix(): ast.parse(path.read_text(encoding="utf-8"))
        for path in sorted(paths)
    }


@cache
def nodes(name):
    """All nodes of a module."""
    return tuple(ast.walk(modules()[name]))


def of_hilcal():
    return [name for name in modules() if name.startswith("hilcal/")]


def test_a_class_has_a_name_of_its_own():
    """So that a reader finds it by its name alone."""
    places = {}
    for name, tree in modules().items():
        if not name.startswith("studies/"):
            for node in tree.body:
                if isinstance(node, ast.ClassDef):
                    places.setdefault(node.name, []).append(name)
    assert {name: at for name, at in places.items() if len(at) > 1} == {}


DEFAULTS = ("hilcal/effects/", "hilcal/config/")
"""Rooms that name effects: the effects themselves, and defaults that a person would write."""
OF_THE_CELL = {"load_point"}
"""Names that are also those of something in the cell."""


def test_no_module_outside_of_the_effects_asks_for_one_by_its_name():
    names = {*NAMES} - OF_THE_CELL
    uses = [
        f"{name}:{node.lineno}: {node.value}"
        for name in of_hilcal()
        if not name.startswith(DEFAULTS)
        for node in nodes(name)
        if isinstance(node, ast.Constant) and str(node.value).split(".")[0] in names
    ]
    assert not uses


# files are written whole

STRAIGHT = {
    "hilcal/whole_file.py": "it is what all others use",
    "hilcal/robot/catalogue.py": "a file in a temporary folder",
    "hilcal/doctor.py": "a file in a temporary folder",
    "hilcal/workbench/server.py": "a file in a temporary folder",
    "hilcal/cli/__init__.py": "the null device",
    "hilcal/present/live_viewer.py": "a pipe",
    "hilcal/tables/matfile.py": "a buffer in memory",
    "hilcal/present/viewer/live.py": "a recording that grows while it is looked at",
    "hilcal/store/schema.py": "SQLite has a journal of its own",
    "drivers/simulated/cell_processes.py": "a device's log, which grows",
    "drivers/simulated/blackboard.py": "memory shared by the devices of a simulated cell",
    "drivers/simulated/world_server.py": "memory shared by the devices of a simulated cell",
    "drivers/simulated/admin.py": "a socket",
    "drivers/simulated/pty_port.py": "a link to a terminal",
    "studies/corrected.py": "a log, which grows",
    "studies/discover_command.py": "a log, which grows",
    "studies/benchmark/entrants/common.py": "without hilcal, in the runner's temporary folder",
    "studies/benchmark/entrants/figaroh/entrant.py": "files in a temporary folder",
    "studies/benchmark/entrants/hilcal/entrant.py": "a file in a temporary folder",
    "studies/benchmark/entrants/run.py": "without hilcal: beside its place, and put there",
    "studies/records.py": "a log, which grows",
    "studies/discover_peers.py": "a file in a temporary folder, by a program without hilcal",
}
"""Files that write straight, and why they may."""
WRITES = {
    *("write_text", "write_bytes", "touch", "rename", "savez", "savez_compressed", "savetxt"),
    *("tofile", "to_parquet", "to_excel", "write_image", "savefig"),
    *("FileSink", "mkstemp", "NamedTemporaryFile", "copyfile", "copy2"),
    *("urlretrieve", "executescript"),
}
OWNERS = {"os", "shutil", "json", "pickle", "tempfile", "rr", "parquet"}


def direct_writes(tree):
    """Yield lines of calls that write to a file, but for those in a `with replacing(...)`."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.With) and any(
            isinstance(item.context_expr, ast.Call)
            and getattr(item.context_expr.func, "id", None) == "replacing"
            for item in node.items
        ):
            continue
        if isinstance(node, ast.Call) and writes(node):
            yield node.lineno
        yield from direct_writes(node)


def writes(call):
    name = getattr(call.func, "attr", getattr(call.func, "id", None))
    owner = getattr(getattr(call.func, "value", None), "id", None)
    given = (*call.args, *(k.value for k in call.keywords))
    texts = [a.value for a in given if isinstance(a, ast.Constant) and isinstance(a.value, str)]
    if name in ("open", "fdopen"):
        flags = {getattr(n, "attr", "") for a in call.args for n in ast.walk(a)}
        modes = [t for t in texts if set(t) <= set("rwaxbt+")]
        return bool(flags & {"O_WRONLY", "O_RDWR"}) or any(set(m) & set("wax+") for m in modes)
    if name == "replace":  # of a path it has one argument, of a text two
        return owner == "os" or (len(call.args) == 1 and not call.keywords)
    if name == "connect":
        return owner == "sqlite3"
    if name == "to_csv":
        return owner != "dh_table" and bool(call.args)  # else a text
    if name == "write_table":
        return owner is not None  # our own writes whole files
    if name in ("copy", "dump", "move"):
        return owner in OWNERS
    return name in WRITES


def test_no_file_is_written_straight_to_its_place():
    result = {name: lines for name, tree in modules().items() if (lines := [*direct_writes(tree)])}
    assert {name: at for name, at in result.items() if name not in STRAIGHT} == {}, "use whole_file"
    assert set(STRAIGHT) - set(result) == set(), "take them from the list"


# command lines in messages

RUN_BY_PEOPLE = re.compile(
    "hilcal (accept|add|check|compare|diagnose|export|identify|info|plan|refine|repair|report|run|"
    r"view) $|hilcal .* -o $|\S.*--(effects-from|prior|after|plan) $",
    re.DOTALL,
)


def unquoted(among):
    """Lines in which a value stands as it is in a command line that people are told to run."""
    collected = []
    for node in among:
        text = ""
        for part in node.values if isinstance(node, ast.JoinedStr) else ():
            if isinstance(part, ast.Constant):
                text += part.value
                continue
            called = getattr(getattr(part.value, "func", None), "id", "")
            if RUN_BY_PEOPLE.search(text) and called != "quoted":
                collected.append(node.lineno)
            text += "X"
    return collected


def test_values_in_command_lines_are_quoted():
    assert {name: lines for name in of_hilcal() if (lines := unquoted(nodes(name)))} == {}
    for wrong in ('f"see hilcal refine {run}"', 'f"give it: --effects-from {file}"'):
        assert unquoted(ast.walk(ast.parse(wrong))) == [1]


NAMED = re.compile(rf"\bhilcal ({'|'.join(COMMANDS)})\b")
STEP = re.compile(rf"{NAMED.pattern}((?: (?:--?[a-z][\w-]*|[A-Z.]+|\{{\}}))*)")
"""A command in a message, and the options and places behind it."""


def sentences(among):
    """Yield the strings of a module, no docstrings and no helps of options, that name a command."""
    left_out = {id(s.value) for s in among if isinstance(s, ast.Expr)}
    for node in among:
        if isinstance(node, ast.JoinedStr):
            left_out.update(id(part) for part in node.values)
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("command", "_declared"):
            left_out.update(id(given) for given in node.args)
    for node in among:
        if isinstance(node, ast.JoinedStr | ast.Constant) and id(node) not in left_out:
            parts = node.values if isinstance(node, ast.JoinedStr) else [node]
            texts = [str(p.value) if isinstance(p, ast.Constant) else "{}" for p in parts]
            if NAMED.search(text := "".join(texts)):
                yield text


def test_every_command_of_a_message_has_the_options_that_it_names(capsys):
    said = [text for name in of_hilcal() for text in sentences(nodes(name))]
    named = [matches for text in said for matches in re.findall(STEP, text)]
    helps = {name: ok(capsys, name, "--help").out for name in {name for name, _ in named}}
    assert len(named) > 80
    for name, words in named:
        for option in re.findall(r"(?<![\w-])--?[a-z][\w-]*", words):
            assert re.search(rf"(?<![\w-]){option}\b", helps[name]), (name, option)
