"""A stranger with the README goes from nothing to a calibrated simulated arm, at a terminal.

Every command is one that the README shows, the loads are hung by a person who is asked, the run is
stopped once in the middle, and no error is shown that is not the stranger's own. The wire is real;
the simulated world goes 20 times faster than the clock.
"""

import csv
import io
import re
import subprocess
import sys

import pytest

from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import load_plan
from tests.support.campaign_cases import STARVED
from tests.support.paths import ROOT
from tests.support.screen import AtTerminal

pytestmark = pytest.mark.slow

COMMANDS = 15  # a stranger may need so many
ASKED = "Enter = done, q = give up:"
HIDDEN = "joint_tilt_compliance"
ANSWERS = (
    ("Which arm?", "ur10e"),
    ("Address of its controller", ""),
    ("What pose repeatability", "0.05 mm"),
    ("Which tracker?", "geocom"),
    ("Its serial port", ""),
    ("How accurate is the tracker?", ""),
    ("Which force sensor", "ft300"),
    ("Its serial port", ""),
    ("Where does the target sit?", "60 mm, 20 mm, 120 mm"),
    ("Where do loads act?", "0.1 0 0.15"),
    ("Mass of the tool", "0.8"),
    ("Its centre of mass", "0.01 0 0.06"),
    ("Which loads are at hand?", "5 kg"),
    ("Another one", "pull x = 80, 0, 0 N"),
    ("Another one", ""),
    ("What is to be calibrated?", ""),
    ("What height", "0.05"),
    ("Where does the tracker stand", ""),
)


class Stranger:
    """Types commands, reads what stands on the screen, and never a line that is too long."""

    def __init__(self, home, columns):
        self.home, self.columns = home, columns
        self.typed = []

    def sits(self, *words):
        """Type a command; it goes on until it ends by itself, or the block ends."""
        self.typed.append(words)
        return AtTerminal(*words, columns=self.columns, lines=40, home=self.home)

    def types(self, *words, person=None, code=0):
        """Type a command, live through it, and return all that it has left on the screen."""
        with self.sits(*words) as terminal:
            if person is not None:
                person(terminal)
            found = terminal.wait_for_end()
            shown = "\n".join(terminal.lines)
            assert found == code, shown
            assert "Traceback" not in shown
            lines = shown.splitlines()
            assert any(line.startswith("error: ") for line in lines) is (code != 0), shown
            return shown

    def same_words_as_a_file(self, *words):
        """Type a command that only reads; the screen has the words of a log, and breaks none."""
        shown = self.types(*words)
        log = subprocess.run(
            [sys.executable, "-m", "hilcal", *words],
            cwd=self.home,
            env={"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            check=True,
        )
        assert plain(shown) == plain(log.stdout)
        return shown


def plain(text):
    """The words of a text, without the rules of its tables."""
    return {word for word in text.split() if set(word) != {"─"}}


def hangs_what_is_asked_for(terminal, stop=""):
    """Answer every question; press Ctrl-C when so many readings are there."""
    answered = 0
    while terminal.read_screen():
        if terminal.text.count(ASKED) > answered:
            terminal.check_words_stay(ASKED, answered + 1)
            terminal.type_keys("\n")
            answered += 1
            terminal.wait_for_words("Done: ", answered)
        elif stop and terminal.page_with(stop):
            terminal.type_keys("\x03")
            stop = ""


def run_to_the_end(stranger, *words):
    """Measure; a computer that was too busy for the devices' deadlines is no one's error."""
    while True:
        with stranger.sits(*words) as terminal:
            hangs_what_is_asked_for(terminal)
            shown = "\n".join(terminal.lines)
            if terminal.wait_for_end() == 0:
                return shown
            assert STARVED.search(terminal.text), shown
            assert f"  hilcal {' '.join(words[:4])} --resume" in terminal.lines
        stranger.typed.pop()
        words = (*words[:4], "--resume")


@pytest.mark.parametrize("columns", [80, 120])
def test_from_nothing_to_a_calibrated_arm(columns, tmp_path):
    stranger = Stranger(tmp_path, columns)

    def answers(terminal):
        for k, (question, answer) in enumerate(ANSWERS):
            terminal.wait_for_words(question, sum(q == question for q, _ in ANSWERS[: k + 1]))
            terminal.type_keys(f"{answer}\n")

    assert "Written: CELL.toml" in stranger.types("init", person=answers)
    plan = ("plan", "CELL.toml", "-o", "plan.json")
    assert "certified lower bound" in stranger.types(*plan, "--poses", "8")
    rehearsal = ("--plan", "plan.json", "--person", "--clock", "20", "--hide", HIDDEN)
    with stranger.sits("simulate", "CELL.toml", "-o", "DIR", *rehearsal) as devices:
        devices.wait_for_words("Ctrl-C stops them.")
        check = stranger.types("check", "DIR/cell.toml", "--plan", "plan.json")
        assert "All devices are ready. Nothing was moved." in check
        assert "The plan keeps every limit" in check

        run = ("run", "DIR/cell.toml", "-o", "run.hilcal")
        stopped = stranger.types(
            *(*run, "--plan", "plan.json"),
            person=lambda terminal: hangs_what_is_asked_for(terminal, stop=" 4/"),
            code=130,
        )
        with CampaignFile.open(tmp_path / "run.hilcal") as campaign:
            assert f"the arm stands, {campaign.n_readings} of" in " ".join(stopped.split())
        assert stopped.splitlines()[-1] == f"  hilcal {' '.join(run)} --resume"
        whole = run_to_the_end(stranger, *run, "--resume")
        assert "Hang the load pull x at the load point [0.1, 0, 0.15] m (flange)." in whole
        assert "readings are in run.hilcal. Go on with: hilcal refine run.hilcal" in whole

        info = stranger.same_words_as_a_file("info", "run.hilcal")
        assert "interrupted" in info
        found = stranger.types("refine", "run.hilcal")
        if "Verdict: ambiguous" in found:
            stranger.types("next", "run.hilcal", "-o", "next.json", "--quick")
            run_to_the_end(stranger, *run, "--append", "--plan", "next.json")
            found = stranger.types("refine", "run.hilcal")
        assert "Verdict: adequate" in found, found
        assert HIDDEN in found, found
        devices.type_keys("\x03")
        assert devices.wait_for_end() == 0
    stranger.same_words_as_a_file("compare", "run.hilcal")
    corrected(stranger, tmp_path)
    assert len(stranger.typed) <= COMMANDS
    shown = (ROOT / "README.md").read_text(encoding="utf-8")
    for words in stranger.typed:
        assert re.search(rf"\bhilcal +{words[0]}\b", shown), words
        assert all(word in shown for word in words if word.startswith("--")), words


def corrected(stranger, home):
    """Correct the joints of poses that were measured, under the load."""
    plan = load_plan(home / "plan.json")
    points = io.StringIO()
    rows = csv.writer(points)
    rows.writerow(["pose", *(f"q{k}_rad" for k in range(1, 7))])
    for name in plan.pose_names[1:4]:
        rows.writerow([name, *plan.joints(name)])
    (home / "points.csv").write_text(points.getvalue(), encoding="utf-8")
    load = ("--load", "pull x")
    stranger.types("compensate", "run.hilcal", "points.csv", *load, "-o", "corrected.csv")
    assert len((home / "corrected.csv").read_text(encoding="utf-8").splitlines()) >= 4
