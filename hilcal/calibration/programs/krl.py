"""KUKA KRL: a module of a `.src` and a `.dat` file.

Points are `E6POS`, `POS`, `FRAME` (X, Y, Z in mm; A, B, C about z, y', x'' in degrees; status S and
turn T) and `E6AXIS`, `AXIS` (degrees), declared with a value, or written into a motion. `S` has
bit 0 for a wrist centre behind axis 1 and bit 1 for axis 3 beyond the stretched arm, `T` a bit for
each axis at a negative angle; the controller obeys both in PTP motions and neither on paths.

Tool and base are `$TOOL` and `$BASE`, set earlier in the text by an assignment, `BAS(#TOOL, n)`,
`BAS(#BASE, n)`, by an inline form (`FDAT`), or in the motion (`WITH`). Values that are set within a
branch or a loop are unknown after its end, and both after the call of a subprogram, which may set
them. A frame is unknown if a statement changes it otherwise than as a whole. The mass at the flange
is M of `$LOAD`, which `BAS(#TOOL, n)` and an inline form set to `LOAD_DATA[n]`; a negative one is
not stated.

Source: KUKA, *KUKA System Software 8.3, Operating and Programming Instructions for System
Integrators*, chapters 10 to 12; *Expert Programming*, status and turn.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hilcal.calibration.programs.program import (
    CORRECTED,
    DECIMAL,
    JOINTS,
    MOVES,
    UNSTATED,
    Language,
    Program,
    ProgramPoint,
    ProgramReader,
    Span,
    arguments_of,
    of_euler,
    read_text,
    to_euler,
)
from hilcal.errors import InputError
from hilcal.types import Floats, Ints

KINDS = ("TOOL", "BASE")
POINTS = ("E6POS", "POS", "FRAME", "E6AXIS", "AXIS")  # types of points
POSE, AXES, TURN = ("X", "Y", "Z", "A", "B", "C"), tuple(f"A{k}" for k in range(1, 7)), "T"
OVERHEAD, ELBOW = 1, 2  # bits of S
_FIELD = re.compile(
    rf"\b([A-Za-z]\w*)\s+({DECIMAL}(?:[eE][-+]?\d+)?|'[BbHh][0-9A-Fa-f]+'|#\w+|\"[^\"]*\"|TRUE|FALSE)"
)
_TEXT = re.compile(r'"[^"]*"|;.*')
_DATA = re.compile(
    r"^\s*(?:GLOBAL\s+)?(?:DECL\s+)?(?:GLOBAL\s+)?(?:(\w+)\s+)?(\$?\w+(?:\[\s*\d+\s*\])?)\s*=\s*(\{.*)$",
    re.IGNORECASE,
)
_MOTION = re.compile(
    r"^\s*(S?PTP|S?LIN|S?CIRC|SPL|ASYPTP|S?(?:PTP|LIN|CIRC|SPL)_REL)\b(?!\s*=)", re.IGNORECASE
)
_NAME = re.compile(r"\$?[A-Za-z_]\w*(?:\s*\[\s*\d+\s*\])?")
_PLAIN = re.compile(rf"({_NAME.pattern})?\s*(C_\w+\b|WITH\b|\{{[^}}]*\}}(?!\s*:)|$)", re.IGNORECASE)
"""A target that is a name or an aggregate, at the beginning of a motion's arguments."""
_SET = re.compile(r"^\s*\$(TOOL|BASE)\s*=\s*(.+)$", re.IGNORECASE)
_LOAD = re.compile(r"^\s*\$LOAD\s*(\.\s*M\s*)?=\s*(.+)$", re.IGNORECASE)
_MASS = re.compile(rf"\bM\s+({DECIMAL}(?:[eE][-+]?\d+)?)\s*(?=[,}}]|$)", re.IGNORECASE)
_BAS = re.compile(r"^\s*BAS\s*\(\s*#(\w+)\s*(?:,\s*([^)]*))?\)", re.IGNORECASE)
_FDAT = re.compile(r"^\s*FDAT_ACT\b\s*(?:=\s*(\w+))?", re.IGNORECASE)
_CHANGED = re.compile(
    r"^\s*([A-Za-z_]\w*)\s*(\[\s*\d+\s*\]|\[[^\]]*\])?\s*(\.[\w.\s]*)?=(?!=)", re.IGNORECASE
)
_INDEX = re.compile(r"^(TOOL|BASE)_DATA\s*\[\s*(\d+)\s*\]$", re.IGNORECASE)
_OPENS = ("IF", "SWITCH", "FOR", "WHILE", "LOOP", "REPEAT", "SPLINE", "PTP_SPLINE")
_LOOPS = ("FOR", "WHILE", "LOOP", "REPEAT")
_CLOSES = ("ENDIF", "ENDSWITCH", "ENDFOR", "ENDWHILE", "ENDLOOP", "UNTIL", "ENDSPLINE")
_ELSE = ("ELSE", "CASE", "DEFAULT")
_CALL = re.compile(r"^\s*([A-Za-z_]\w*)\s*\(")
_NO_CALLS = (
    *("BAS", "IF", "WHILE", "UNTIL", "SWITCH", "FOR", "WAIT", "PULSE", "HALT", "CASE", "RETURN"),
    *("CWRITE", "CREAD", "SREAD", "SWRITE", "ANOUT", "ANIN", "TRIGGER", "INTERRUPT"),
    *("EXT", "EXTFCT", "DEF", "DEFFCT", "GLOBAL", "DECL", "SIGNAL"),
)
_DEFINITION = re.compile(
    r"^[ \t\ufeff]*(GLOBAL[ \t]+)?DEF(FCT)?\b[^\r\n]*", re.IGNORECASE | re.MULTILINE
)
_FORBIDDEN = re.compile(
    r"\$(ROBROOT|WORLD|NULLFRAME|ERSYSROOT|TOOL|BASE)\b\s*(\.\w+\s*)?=(?!=)"
    r"|\$IPO_MODE\s*=\s*#TCP|\$(CORRECTION|PRO_IP)\b",
    re.IGNORECASE,
)
_TURN_STAYS = re.compile(r"\$?\bORI_TYPE?\s*=?\s*#CONST\w*", re.IGNORECASE)
"""Straight and circular motions then end with the orientation of the point before."""
_OUTER_TOOL = re.compile(r"\$IPO_MODE\s*=\s*#TCP", re.IGNORECASE)
_INERT = re.compile(r"^\s*(\$H_POS|\$POS_RET)\s*=\s*\w+\s*$", re.IGNORECASE)
"""Statements that read a point without a motion."""
_APPROXIMATION = re.compile(r"\s*(CA|C_\w+)\b", re.IGNORECASE)
_BEFORE = "before it in the same subprogram"


def flags(q: Floats, shape: Ints) -> Ints:
    """(K, 8) bits 0 and 1 of S, and the bits of T, at joint values (K, 6)."""
    return np.column_stack([shape[:, 0], 1 - shape[:, 1], (q < 0).astype(np.int64)])


def _written(new: Ints, texts: Sequence[str]) -> list[str]:
    (text,) = texts
    turn = int(_value(text)) & ~0b111111
    return [str(turn | sum(1 << k for k, bit in enumerate(new[2:]) if bit == 1))]


KRL = Language(
    name="KRL",
    pose=of_euler,
    numbers=to_euler,
    decimals=(6, 7, 7),
    axes=((0, 0, -1), (0, 1, 0), (0, 1, 0), (-1, 0, 0), (0, 1, 0), (-1, 0, 0)),
    flags=flags,
    shape_flags=(True, True, *(False,) * JOINTS),
    motions="PTP, LIN, CIRC and their S…",
    marked=lambda text: _DEFINITION.sub(rf"\g<0>  ; {CORRECTED}", text, count=1),
    config_texts=_written,
    frames="a copy of $config.dat, or TOML",
)


def read_krl(path: Path, frames_file: Path | None, tool: Floats | None) -> Program:
    """Read a `.src` file with the `.dat` file beside it."""
    same_stem = (p for p in sorted(path.parent.glob("*")) if p.stem == path.stem)
    paths = [path, *[p for p in same_stem if p.suffix.lower() == ".dat"][:1]]
    texts, encodings = zip(*(read_text(p) for p in paths), strict=True)
    encoding = "latin-1" if "latin-1" in encodings else "utf-8"
    if len(set(encodings)) > 1:
        texts = tuple(p.read_bytes().decode(encoding) for p in paths)
    config = frames_file is not None and frames_file.suffix.lower() == ".dat"
    names = [p.name for p in paths]
    reader = _KrlReader(path, names, None if config else frames_file, tool)
    reader.text, reader.encoding = texts[0], encoding
    for k, text in enumerate(texts):
        reader.collect(text, k)
    if frames_file is not None and config:
        reader.collect(read_text(frames_file)[0], -1)
    return reader.read(texts, [p.suffix for p in paths])


@dataclass(frozen=True, slots=True, eq=False)
class _Value:
    """An aggregate {…}: its place, its type, and its fields with their text and offsets."""

    file: int
    line: int
    kind: str
    fields: Mapping[str, tuple[str, int, int]]

    @classmethod
    def of(cls, code: str, offset: int, file: int, line: int, kind: str = "") -> "_Value":
        """Return the aggregate at the beginning of a text, which is at `offset` in the file.

        One that only begins an expression (`{…}:XP1`) is computed, and has no fields.
        """
        body, end, rest = code.partition("}")
        if rest.lstrip().startswith(":"):  # the geometric operator: the product of two frames
            body = ""
        matches = _FIELD.finditer(body + end)
        fields = {m[1].upper(): (m[2], offset + m.start(2), offset + m.end(2)) for m in matches}
        return cls(file, line, kind.upper(), fields)

    def numbers(self, keys: Sequence[str]) -> Floats | None:
        try:
            return np.array([_value(self.fields[k][0]) for k in keys])
        except (KeyError, ValueError):
            return None

    def spans(self, keys: Sequence[str]) -> tuple[Span, ...]:
        return tuple(Span(self.file, *self.fields[k][1:]) for k in keys)


def _code(text: str) -> Iterator[tuple[int, int, str]]:
    """Yield number, offset and code of each line, with comments and texts replaced by blanks."""
    offset = 0
    for number, line in enumerate(text.split("\n"), start=1):
        code = _TEXT.sub(lambda m: " " * len(m[0]), line.rstrip("\r"))
        if code.strip() and not code.lstrip().startswith("&"):
            yield number, offset, code
        offset += len(line) + 1


def _key(name: str) -> str:
    return re.sub(r"\s", "", name).upper()


@dataclass(frozen=True, slots=True)
class _State:
    tool: Floats | str = f"the program does not set $TOOL {_BEFORE}"
    base: Floats | str = f"the program does not set $BASE {_BEFORE}"

    def same(self, other: "_State") -> bool:
        """Whether tool and base, or the reasons why they are unknown, equal those of a state."""
        pairs = (self.tool, other.tool), (self.base, other.base)
        return all(np.array_equal(a, b) for a, b in pairs)


class _KrlReader(ProgramReader):
    """Reader of the statements of a `.src` file, in the order of its text."""

    def __init__(self, path: Path, files: list[str], frames_file: Path | None, tool: Floats | None):
        super().__init__(path, KRL, frames_file, tool)
        self.files = files
        self.data: dict[str, list[_Value]] = {}
        self.state = _State()
        self.form: str | None = None

    def collect(self, text: str, file: int) -> None:
        """Collect all named aggregates of a file; `file` is −1 for that of --frames."""
        for line, offset, code in _code(text):
            if file >= 0 and (m := _TURN_STAYS.search(code)):
                reason = f"'{m[0]}' leaves the orientation of points aside"
                raise InputError(f"{self.files[file]}: line {line}: {reason}; valid: #VAR")
            if m := _DATA.match(code):
                value = _Value.of(m[3], offset + m.start(3), file, line, m[1] or "")
                self.data.setdefault(_key(m[2]), []).append(value)

    def read(self, texts: Sequence[str], suffixes: Sequence[str]) -> Program:
        lines = list(_code(texts[0]))
        self.other_uses = self._used_otherwise(lines)
        self.changed = _changed(lines)
        blocks: list[list[_State]] = []  # states at the beginning and after branches of open blocks
        for k, (line, offset, code) in enumerate(lines):
            word = _word(code)
            if word in ("DEF", "DEFFCT", "GLOBAL") and re.search(r"\bDEF(FCT)?\b", code, re.I):
                self.state, blocks = _State(), []
            elif word in _ELSE and blocks:
                blocks[-1].append(self.state)
                self.state = blocks[-1][0]
            elif word == "ENDSPLINE" and blocks:
                (self.state,) = blocks.pop()
            elif word in _CLOSES and blocks:
                if not all(s.same(self.state) for s in blocks.pop()):
                    self._forget(
                        f"the block that ends in line {line} sets them in some branches only"
                    )
            elif word in _OPENS:
                if word in _LOOPS and _sets(lines[k + 1 :]):
                    self._forget(f"the loop of line {line} sets them later")
                blocks.append([self.state])
                if word.endswith("SPLINE"):
                    self._with(code, line)
            elif word and re.fullmatch(r"\s*\w+\s*:\s*", code):
                self._forget(f"line {line} is a label, which may be reached from elsewhere")
            else:
                self._statement(line, offset, code)
        for key in [k for k in self.other_uses if k not in self.points]:
            if self.data[key][0].kind == "FRAME":  # rather a base than a point
                del self.other_uses[key]
        return self.program(texts, suffixes)

    def _forget(self, because: str) -> None:
        reason = f"its tool and base are not known: {because}"
        self.state = _State(reason, reason)

    def _statement(self, line: int, offset: int, code: str) -> None:
        if m := _MOTION.match(code):
            self._motion(line, offset, code, m)
        elif m := _SET.match(code):
            self._set(m[1].upper(), m[2].strip(), line)
        elif m := _LOAD.match(code):
            self._load(f"M {m[2]}" if m[1] else m[2].strip(), line)
        elif m := _FDAT.match(code):
            self.form = m[1]
        elif m := _BAS.match(code):
            topic, number = m[1].upper(), (m[2] or "").strip()
            if topic in KINDS:
                self._set(topic, f"{topic}_DATA[{number}]", line)
                if topic == "TOOL":
                    self._load(f"LOAD_DATA[{number}]", line)
            elif topic in ("PTP_PARAMS", "CP_PARAMS", "PTP_DAT", "CP_DAT", "FRAMES"):
                self._of_form(self.form, line)
            elif topic == "INITMOV":
                self._forget(f"BAS(#INITMOV) of line {line} sets them to the values of $config.dat")
        elif m := _FORBIDDEN.search(code):
            reason = f"'{m[0].strip()}' changes what points mean"
            raise self.error(line, reason, "$TOOL and $BASE as a whole, a tool on the flange")
        elif (m := _CALL.match(code)) and m[1].upper() not in _NO_CALLS:
            self._forget(f"{m[1][:40]} of line {line} may set them")

    def _of_form(self, name: str | None, line: int, kinds: Sequence[str] = KINDS) -> None:
        values = self.data.get(_key(name or ""), [])
        if changed := self._change_of(name or ""):
            self.state = _State(changed, changed)
            return
        if len(values) != 1 or "TOOL_NO" not in values[0].fields:
            reason = f"the FDAT of line {line} is not in the .dat file"
            self.state = _State(reason, reason)
            return
        fields = values[0].fields
        if fields.get("IPO_FRAME", ("#BASE",))[0].upper() != "#BASE":
            reason = f"{name} has a stationary tool (IPO_FRAME #TCP)"
            raise self.error(line, reason, "a tool on the flange")
        for kind in kinds:
            self._set(kind, f"{kind}_DATA[{fields.get(f'{kind}_NO', ('0',))[0]}]", line)
        if "TOOL" in kinds:
            self._load(f"LOAD_DATA[{fields['TOOL_NO'][0]}]", line)

    def _load(self, value: str, line: int) -> None:
        """Record the mass of a load: of an aggregate, or of a declared one by its name."""
        declared = self.data.get(_key(value), [])
        mass = declared[0].numbers(["M"]) if len(declared) == 1 else None
        if written := _MASS.search(value):
            mass = np.array([float(written[1])])
        if mass is not None and mass[0] >= 0.0:
            self.payloads[line] = float(mass[0])

    def _set(self, kind: str, value: str, line: int) -> None:
        self.state = replace(self.state, **{kind.lower(): self._frame(kind, value, line)})

    def _change_of(self, name: str) -> str:
        """Return the statement that changes a frame or form, or an element of its array, if any."""
        key = _key(name)
        line = self.changed.get(key) or self.changed.get(key.partition("[")[0])
        return f"line {line} changes {name}" if line else ""

    def _numbers(self, name: str) -> Floats | None:
        values = self.data.get(_key(name), [])
        return values[0].numbers(POSE) if len(values) == 1 else None

    def _set_later(self, name: str, line: int) -> str:
        """Return the statement after a line that sets a frame, if any: it had another value."""
        later = [v for v in self.data.get(_key(name), []) if v.file == 0 and v.line > line]
        return f"line {later[0].line} sets {name}, after its use" if later else ""

    def _frame(self, kind: str, value: str, line: int) -> Floats | str:
        if value.upper() == "$NULLFRAME":
            return np.eye(4)
        if value.startswith("{"):
            numbers = _Value.of(value, 0, 0, line).numbers(POSE)
            lack = f"${kind} of line {line} is incomplete or computed"
            return lack if numbers is None else of_euler(numbers)
        m = _INDEX.match(value)
        fixed = m is not None and m[2] == "0"  # the flange, or the world
        if not fixed and (changed := self._change_of(value) or self._set_later(value, line)):
            return changed
        if m is None or m[1].upper() != kind:
            numbers = self._numbers(value)
            return f"${kind} of line {line} is computed" if numbers is None else of_euler(numbers)
        group, name = ("tools", "bases")[kind == "BASE"], f"{kind}_DATA[{m[2]}]"
        numbers, stated = self._numbers(name), self.controller.stated(group, m[2])
        if numbers is not None and stated is None:
            return of_euler(numbers)
        if stated is not None and (assigned := [v for v in self.data.get(name, []) if not v.file]):
            return f"line {assigned[0].line} sets {name}, which --frames states, too"
        return self.controller.pose(group, m[2], name)

    def _with(self, code: str, line: int) -> None:
        """Set tool and base as a motion or a spline block does for itself."""
        settings = "".join(re.split(r"\bWITH\b", code, maxsplit=1, flags=re.I)[1:])
        if m := _OUTER_TOOL.search(settings):
            raise self.error(line, f"'{m[0]}' changes what points mean", "a tool on the flange")
        for kind in KINDS:
            setting = re.search(rf"\${kind}\s*=\s*(.+?)(?=,\s*\$|$)", settings, re.I)
            if setting:
                text = setting[1].strip()
                form = re.match(r"\w+\s*\(.*?\b(\w+)(?:\.\w+)?\s*\)", text)
                if form and _key(form[1]) in self.data:
                    self._of_form(form[1], line, [kind])
                else:
                    self._set(kind, text, line)

    def _motion(self, line: int, offset: int, code: str, m: re.Match[str]) -> None:
        word = m[1].upper()
        head = re.split(r"\bWITH\b", code[m.end() :], maxsplit=1, flags=re.I)[0]
        previous = self.state
        self._with(code, line)
        reason = ""
        if word.endswith("_REL") or word == "ASYPTP":
            reason = f"{word} is not corrected"
        elif "CIRC" in word and re.search(r"\bCA\b", head, re.I):
            reason = "a circle with CA does not end at the point that is stated"
        targets = [(b, t) for b, t in arguments_of(head) if not _APPROXIMATION.match(t)]
        for begin, target in targets[: 2 if "CIRC" in word else 1]:
            self._target(line, offset + m.end() + begin, target, word in ("PTP", "SPTP"), reason)
        self.state = previous

    def _target(self, line: int, offset: int, text: str, obeyed: bool, reason: str) -> None:
        body = re.sub(r"\s+C_(PTP|DIS|VEL|ORI|SPL)\b.*", "", text, flags=re.I).strip()
        offset += len(text) - len(text.lstrip())
        key, name, value = _key(body), f"line {line}", _Value(0, line, "", {})
        if body.startswith("{"):
            value, key = _Value.of(text.strip(), offset, 0, line), f"line {line}, {offset}"
        else:
            values = self.data.get(key, [])
            if not _NAME.fullmatch(body):
                reason = reason or f"the point '{body[:40]}' is computed while the program runs"
            elif len(values) != 1 or values[0].file < 0:
                lack = "is not in this program" if not values else "has several values"
                reason = reason or f"the point '{body[:40]}' {lack}"
            if len(values) == 1 and values[0].file >= 0:
                value = values[0]
                name = f"{body} ({self.files[value.file]} line {value.line})"
        bare = ProgramPoint(value.line if value.fields else line, name, not_corrected=reason)
        self.record(key, bare if reason else self._point(bare, value, obeyed), line, obeyed)

    def _point(self, bare: ProgramPoint, value: _Value, obeyed: bool) -> ProgramPoint:
        axes = (k for k in value.fields if re.fullmatch(r"E[1-6]", k))
        if not value.fields:
            return bare.refused("the point is computed while the program runs")
        moving = [k for k in axes if value.numbers([k]) is None or value.numbers([k]) != 0]
        if moving:
            return bare.refused(MOVES.format(moving[0]))
        keys = AXES if AXES[0] in value.fields else POSE
        numbers = value.numbers(keys)
        if numbers is None:
            names = "A1 to A6" if keys is AXES else "X, Y, Z, A, B, C"
            return bare.refused(f"not all of {names} are written")
        tool, spans = self.state.tool, value.spans(keys)
        if keys is AXES:
            return bare.at_joints(spans, numbers, tool)
        s, t = (value.numbers([k]) for k in ("S", TURN))
        status = [UNSTATED] * 2 if s is None else [int(s[0]) & OVERHEAD, int(s[0]) // ELBOW & 1]
        turn = [UNSTATED] * JOINTS if t is None else [int(t[0]) >> k & 1 for k in range(JOINTS)]
        config = () if t is None else value.spans([TURN])
        bare = replace(bare, flags=(*status, *turn), config=config, flags_obeyed=obeyed)
        return bare.at_pose(spans, numbers, tool, self.state.base)

    def _used_otherwise(self, lines: Sequence[tuple[int, int, str]]) -> dict[str, int]:
        out: dict[str, int] = {}
        keys: dict[str, list[str]] = {}
        for key in (k for k, v in self.data.items() if v[0].kind in POINTS and v[0].file >= 0):
            for name in {key, key.partition("[")[0]}:
                keys.setdefault(name, []).append(key)
        for line, _, code in lines:
            if m := _MOTION.match(code):
                targets = [t.strip() for _, t in arguments_of(code[m.end() :])]
                plain = not m[1].upper().endswith("_REL")
                texts = [t for t in targets if not (plain and _PLAIN.match(t))]
            else:
                texts = [] if _DATA.match(code) or _INERT.match(code) else [code]
            for name in (_key(n) for text in texts for n in _NAME.findall(text)):
                for key in keys.get(name, ()):
                    out.setdefault(key, line)
        return out


def _changed(lines: Sequence[tuple[int, int, str]]) -> dict[str, int]:
    """Return the lines that assign names otherwise than as a whole: a field, or what is computed.

    For an element with a computed index it is the name of the array.
    """
    out: dict[str, int] = {}
    for line, _, code in lines:
        if (m := _CHANGED.match(code)) and not _DATA.match(code):
            index = _key(m[2] or "")
            out.setdefault(_key(m[1]) + index * index[1:-1].isdigit(), line)
    return out


def _value(text: str) -> float:
    """Value of a number: 1.5, 'B010', 'H2A'."""
    if text.startswith("'"):
        return int(text[2:-1], 2 if text[1] in "Bb" else 16)
    return float(text)


def _word(code: str) -> str:
    m = _NAME.match(code.strip())
    return m[0].upper() if m else ""


def _sets(lines: Sequence[tuple[int, int, str]]) -> bool:
    """Whether a loop may set tool or base; `lines` begin with its statements."""
    depth = 0
    for _, _, code in lines:
        word = _word(code)
        depth += (word in _OPENS) - (word in _CLOSES)
        if depth < 0:
            return False
        call = _CALL.match(code)
        if _SET.match(code) or _BAS.match(code) or (call and call[1].upper() not in _NO_CALLS):
            return True
    return False
