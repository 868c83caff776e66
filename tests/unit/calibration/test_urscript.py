"""A corrected program goes where the original went, corrected; or its waypoints are left.

Programs are run before and after by `urscript_interpreter`, with lists copied and with lists
shared, since the manual does not say which of them a controller does.
"""

import random
import re

import numpy as np
import pytest

from hilcal.calibration.programs.urscript import (
    movej_program,
    program_points,
    waypoints,
    with_joints,
)
from hilcal.errors import InputError
from hilcal.robot import se3
from tests.support.refusals import refusal, refusals, refuses
from tests.support.urscript_interpreter import Machine, Pose

SIX = "[0, -1.5, 1.5, 0.25, 1, 0]"
POSE = "p[0.4, 0.2, 0.3, 0, 3, 0]"
SETUP = "set_tcp(p[0,0,0.1,0,0,0])\n"


def corrected(program):
    """The program with other joint values, these by line, and why lines are left."""
    every = waypoints(program)
    understood = [w for w in every if not w.not_corrected]
    q = np.arange(6.0 * len(understood)).reshape(-1, 6) + 100.0
    new = dict(zip((w.line for w in understood), q, strict=True))
    return (
        with_joints(program, understood, q),
        new,
        {w.line: w.not_corrected for w in every if w.not_corrected},
    )


def as_pose(six):
    return se3.matrix(se3.rotation(np.array(six[3:])), np.array(six[:3]))


def check_understood(program, seeds=4):
    """Run a program before and after; returns how many corrected motions were seen.

    Raises:
        AssertionError: a motion goes elsewhere.
    """
    again, new, left = corrected(program)
    every = {w.line: w for w in waypoints(program)}
    order = [w.line for w in every.values() if not w.not_corrected]
    count = 0
    for seed in range(seeds):
        for shared in (False, True):
            before = Machine(seed, shared).run(program)
            after = Machine(seed, shared).run(again)
            assert [t.line for t in before] == [t.line for t in after]
            at, servoed = None, False
            for old, now in zip(before, after, strict=True):
                w = every[old.line]
                assert (w.line in new) != (w.line in left)
                if w.not_corrected:
                    assert now.target == old.target
                else:
                    count += 1
                    np.testing.assert_allclose(now.target, new[w.line])
                    pose, near = old.target, None
                    if isinstance(pose, tuple):
                        _, pose, *more = pose
                        near = more[0] if more else None
                    if w.pose is None:
                        assert not isinstance(pose, Pose)
                        np.testing.assert_allclose(w.q, pose)
                    else:
                        assert isinstance(pose, Pose)
                        np.testing.assert_allclose(w.pose, as_pose(pose))
                        if near is not None:
                            np.testing.assert_allclose(w.q, near)
                        else:  # on the branch of the waypoint that stands before it in the list
                            k = order.index(w.line)
                            assert w.q is None
                            assert at == (order[k - 1] if k else None)
                            assert not servoed
                    if w.tool is None:
                        assert old.tool is None
                    else:
                        np.testing.assert_allclose(w.tool, as_pose(old.tool))
                at, servoed = old.line, old.kind == "servoj"
    return count


POLYSCOPE = f"""def Program():
  set_standard_analog_input_domain(0, 1)
  set_tool_voltage(24)
  set_standard_digital_input_action(0, "default")
  set_gravity([0.0, 0.0, 9.82])
  set_tcp(p[0.0,0.0,0.1,0.0,0.0,0.0])
  set_payload(2.0, [0.0, 0.0, 0.05])
  global Waypoint_1_p={POSE}
  global Waypoint_1_q={SIX}
  global Waypoint_2_p=p[0.4, 0.2, 0.25, 0, 3, 0]
  $ 1 "Robot Program"
  while (get_standard_digital_in(7)):
    $ 2 "MoveJ"
    $ 3 "Waypoint_1" "breakAfter"
    movej(get_inverse_kin(Waypoint_1_p, qnear=Waypoint_1_q), a=1.3962634015954636, v=1.04)
    $ 4 "MoveL"
    $ 5 "Waypoint_2" "breakAfter"
    movel(Waypoint_2_p, a=1.2, v=0.25, r=0.01)
  end
end
"""


@pytest.mark.parametrize(
    "program",
    [
        POLYSCOPE,
        f"movej({SIX})\n",
        f"movej( q = {SIX} , a=1.4)\nmovel(pose={SIX}, a=1, v=1, t=0, r=0.01)\n",
        f"def prog():\n\tglobal A={SIX}\n  movej(A, v=1)\r\n  movel({POSE})\nend",
        f'$ 1 "Robot Program"\nmovej({SIX}) # movej([1,2,3,4,5,6])\ntextmsg("movej(q) # \'")\n',
        "movej([d2r(90), -d2r(90) + 0.5, 2*3, -(1), .5, 1e-3])\n",
        f"z = 0.3\nP = p[0.4, 0.2, z + 0.1, 0, 3, 0]\nmovej({SIX})\nmovel(P)\n",
        f"movej(get_inverse_kin({POSE}, qnear={SIX}), 1, 1)\n"
        f"movej(get_inverse_kin({POSE}, {SIX}))\n",
        f"{SETUP}A={SIX}\nwhile True:\n  movej(A)\n  if get_standard_digital_in(0):\n"
        f"    sleep(1)\n  end\n  {SETUP}  movel({POSE})\nend\n",
        f"def f(x):\n  movej({SIX})\n  return x\nend\ny = f(1)\n"
        f"servoj({SIX}, t=0.1)\nmovep({SIX})\n",
        f'textmsg("é …", 1) # é\nmovej({SIX})\n',
        f"def P():\n  def calc(f):\n    return pose_add(get_target_waypoint(), f)\n  end\n"
        f"  movej({SIX})\nend\n",  # as PolyScope writes it into every program
    ],
)
def test_programs_that_are_understood_wholly(program):
    again, _, left = corrected(program)
    assert not left
    assert check_understood(program) > 0
    assert again.count("\r\n") == program.count("\r\n")


@refusals("waypoints")
def test_a_waypoint_that_is_not_understood_is_refused_by_line_or_left(case, given, tmp_path):
    path = tmp_path / "p.script"
    path.write_text(given)
    said = refuses(case, lambda: program_points(path), path)
    match = re.search(r"line (\d+): (?:the waypoint .*\((.*)\); valid|)", said)
    line, why = int(match[1]), match[2] or ""
    assert why in corrected(given)[2][line]
    if "x)" not in given:
        check_understood(given)
    path.write_text(f"{given}movej({SIX})\n")
    _, every, points, _ = program_points(path, leave=True)
    assert [w.line for w in every if w.not_corrected] == [line]
    assert points.names[-1] == f"line {given.count(chr(10)) + 1}"


@refusals("programs")
def test_what_could_change_a_waypoint_refuses_the_program_by_line(case, given, tmp_path):
    path = tmp_path / "p.script"
    path.write_text(given)
    refuses(case, lambda: program_points(path, leave=True), path)


@pytest.mark.parametrize(
    ("program", "line", "words"),
    [
        (f"ｍｏｖｅｊ({SIX})\n", 1, "'\\uff4d'"),
        (f"movej\xa0({SIX})\n", 1, "'\\xa0'"),
        (f"# a\rmovej({SIX})\n", 1, "\\u000d"),
        (f"# a\u2028movej({SIX})\n", 1, "\\u2028"),
        (f"x = 1\n# a\x85movej({SIX})\n", 2, "\\u0085"),
        (f"movej({SIX})\nx = " + "+".join("1" * 6000), 2, "12003 characters, at most 10000"),
        ("if x:\n" * 102 + "end\n" * 102, 102, "in more than 100 blocks"),
        ("x = " + "(" * 4900 + ")" * 4900 + f"\nmovej({SIX})\n", 1, "not understood"),
        ("x = " + "-" * 9000 + f"1\nmovej({SIX})\n", 1, "not understood"),
        ("x = " + "+".join("1" * 4900) + f"\nmovej({SIX})\n", 1, "not understood"),
    ],
)
def test_odd_signs_and_sizes_refuse_the_program_by_line(program, line, words, tmp_path):
    path = tmp_path / "p.script"
    path.write_bytes(program.encode())
    assert words in refusal(f"line {line}: ", program_points, path, leave=True)


def test_values_that_double_and_chains_of_variables_take_no_time():
    doubling = "".join(f"x{k + 1} = x{k} + x{k}\n" for k in range(60))
    assert check_understood(f"x0 = 0\n{doubling}movej([x60, 0, 0, 0, 0, 0])\n")
    chain = "".join(f"x{k + 1} = x{k}\n" for k in range(3000))
    refusal("nested too deeply", waypoints, f"x0 = 0\n{chain}movej([x3000, 0, 0, 0, 0, 0])\n")


@pytest.mark.parametrize(
    ("program", "marked"),
    [
        (f"# f\ndef f():  # of Monday\r\n  movej({SIX})\nend", "def f():  # of Monday"),
        (f"sleep(1)\nmovej({SIX}, a=1)\nsleep(1)\n", "movej([0"),
        (f"movej({SIX})", "movej([0"),
    ],
)
def test_a_corrected_program_is_not_corrected_again(program, marked, tmp_path):
    path, points = tmp_path / "p.script", waypoints(program)
    again = with_joints(program, points, np.zeros((1, 6)))
    lines = again.splitlines()
    assert [line for line in lines if line.endswith("  # corrected by hilcal")] == [
        line for line in lines if line.startswith(marked)
    ]
    assert len(lines) == len(program.splitlines())
    assert len(waypoints(again)) == 1
    for text in (again, movej_program(["a"], np.zeros((1, 6)))):
        path.write_text(text, "utf-8", newline="")
        with pytest.raises(InputError, match="it is corrected already"):
            program_points(path)


def test_a_name_of_a_point_is_no_line_of_the_program():
    name = "P1\n movej([0,0,0,0,0,0], a=10, v=3)\n #\r\x85\u2028\x0b\x0c\x1e"
    text = movej_program([name, "b"], np.zeros((2, 6)))
    assert len(text.splitlines()) == 4
    assert "not checked" in text.splitlines()[0]
    assert len(waypoints(text)) == 2
    assert "# P1\\u000a movej(" in text


class Writer:
    """Random programs: nesting, assignments again, shadowing, aliases, functions and threads."""

    def __init__(self, seed):
        self.random = random.Random(seed)
        self.lines = []
        self.functions = []
        self.names = list("abcdefgh")

    def number(self, depth=0):
        r = self.random
        plain = [f"{r.uniform(-2, 2):.3f}", str(r.randint(0, 3)), f"d2r({r.randint(-90, 90)})"]
        if depth < 1:
            plain += [f"({self.number(depth + 1)} {r.choice('+-*')} {self.number(depth + 1)})"]
            plain += [f"-{self.number(depth + 1)}", r.choice(["n", "m"])]
        return r.choice(plain)

    def vector(self):
        kind = self.random.choice(["", "", "", "p"])
        return f"{kind}[{', '.join(self.number(self.random.randint(0, 3)) for _ in range(6))}]"

    def target(self):
        r = self.random
        near = r.choice([f", qnear={self.pick()}", f", {self.vector()}", ""])
        computed = [
            f"get_inverse_kin({r.choice([self.pick(), self.vector()])}{near})",
            f"pose_trans({self.pick()}, {self.pick()})",
        ]
        return r.choice([self.vector(), self.vector(), *(self.pick() for _ in "abc"), *computed])

    def pick(self):
        return self.random.choice(self.names)

    def motion(self):
        r = self.random
        kind = r.choice(["movej"] * 6 + ["movel"] * 4 + ["movep", "servoj", "movec", "speedl"])
        named = r.choice(["", "", "", "q=" if kind in ("movej", "servoj") else "pose="])
        named = "" if kind in ("movec", "speedl") else named
        more = r.choice(["", ", a=1", ", a=1, v=1", ", r=0.01", ", r=n", ""])
        comment = r.choice(["", "", "  # movej([0, end"])
        return f"{kind}({named}{self.target()}{more}){comment}"

    def statement(self, depth, indent):
        r, say = self.random, lambda text: self.lines.append(f"{indent}{text}")
        condition = r.choice(["get_standard_digital_in(0)", "not get_standard_digital_in(1)"])
        where = r.choice(["", "", "global ", "local "])
        kind = r.choice(["move"] * 6 + ["bind"] * 3 + ["rest"] * 3 + ["block"] * (4 * (depth < 3)))
        if kind == "move":
            say(self.motion())
        elif kind == "bind":
            name = self.pick()
            computed = [self.pick(), f"pose_trans({name}, {name})", f"[{name}, {self.pick()}]"]
            value = r.choice([self.vector()] * 9 + [*computed, f"{self.pick()}[0]"])
            if r.random() < 0.1:
                say(f"{name}[{r.randint(0, 5)}] = {self.number()}")
            elif r.random() < 0.1:
                say(f"{where}{r.choice(['n', 'm'])} = {self.number()}")
            else:
                say(f"{where}{name} = {value}")
        elif kind == "rest":
            called = [f"{f}({', '.join(self.pick() for _ in range(n))})" for f, n in self.functions]
            called += [f"{r.choice(['', 't = '])}run {call}" for call in called]
            say(r.choice([*called, "sleep(0.1)", 'textmsg("movej(a) # end")', "# end", '$ 3 "x"']))
        else:
            self.block(depth, indent, condition)

    def block(self, depth, indent, condition):
        r, say = self.random, lambda text: self.lines.append(f"{indent}{text}")
        word = r.choice(["if", "if", "while", "def", "thread"])
        if word in ("def", "thread"):
            name = f"f{len(self.lines)}"
            given = [self.pick()] if word == "def" and r.random() < 0.4 else []
            say(f"{word} {name}({', '.join(given)}):")
            self.body(depth, indent)
            say("end")
            self.functions.append((name, len(given)))
            return
        say(f"{word} {condition}:")
        self.body(depth, indent)
        if word == "if":
            for other in r.choice([[], ["else:"], [f"elif {condition}:", "else:"]]):
                say(other)
                self.body(depth, indent)
        elif r.random() < 0.3:
            say("  break")
        say("end")

    def body(self, depth, indent):
        known = len(self.functions)
        for _ in range(self.random.randint(1, 4)):
            self.statement(depth + 1, indent + "  ")
        del self.functions[known:]

    def program(self):
        r = self.random
        self.lines += [f"{name} = {k}.5" for k, name in enumerate("nm") if r.random() < 0.9]
        if r.random() < 0.5:
            self.lines.append("set_tcp(p[0, 0, 0.1, 0, 0, 0])")
        for name in r.sample(self.names, r.randint(7, 8)):
            self.lines.append(f"global {name} = {self.vector()}")
        for _ in range(r.randint(2, 9)):
            self.statement(0, "")
            if r.random() < 0.02:
                self.lines.append("set_tcp(p[0, 0, 0.1, 0, 0, 0])")
        return "\n".join(self.lines) + "\n"


def met(seeds):
    """How many programs have motions that were seen corrected, waypoints left, or are refused."""
    understood = left = refused = 0
    for seed in seeds:
        program = Writer(seed).program()
        try:
            understood += check_understood(program, seeds=1) > 0
            left += bool(corrected(program)[2])
        except InputError:
            refused += 1
    return [understood, left, refused]


@pytest.mark.long
def test_every_target_of_a_random_program_is_corrected_or_left():
    """Corrected, left and refused ones are all met often, so that the property says something."""
    assert min(np.array(met(range(80))) / [10, 20, 3]) >= 1


@pytest.mark.slow
def test_many_random_programs():
    assert min(met(range(10**6, 10**6 + 3000))) > 100
