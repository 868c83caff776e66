"""Random faults at random moments: ten minutes of the soak, and any order of its actions."""

import os
from pathlib import Path
from random import Random

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule, run_state_machine_as_test

from tests.soak import soak
from tests.support.campaign_cases import Fault
from tests.support.soak_actions import Soak

MINUTES = float(os.environ.get("HILCAL_SOAK_MINUTES", "10"))


@pytest.mark.slow
def test_ten_minutes_of_random_faults(tmp_path: Path) -> None:
    s = soak(60.0 * MINUTES, 1, tmp_path)
    assert not s.findings
    assert s.counts["faults"] > 0


@pytest.mark.slow
def test_any_order_of_faults_stops_and_recoveries(tmp_path_factory: pytest.TempPathFactory) -> None:
    class Machine(RuleBasedStateMachine):
        """One cell; after every rule all that `tests.soak` states has been checked."""

        def __init__(self) -> None:
            super().__init__()
            self.soak = Soak(Random(0), tmp_path_factory.mktemp("soak"))

        def _do(self, name: str, seed: int) -> None:
            self.soak.rng.seed(seed)
            self.soak.do(getattr(self.soak, name))
            assert not self.soak.findings

        @rule(seed=st.integers(0, 2**32))
        def one_fault(self, seed: int) -> None:
            self._do("one_fault", seed)

        @rule(seed=st.integers(0, 2**32))
        def two_faults(self, seed: int) -> None:
            self._do("two_faults", seed)

        @rule(seed=st.integers(0, 2**32))
        def fault_during_recovery(self, seed: int) -> None:
            self._do("fault_during_recovery", seed)

        @rule(seed=st.integers(0, 2**32))
        def stop(self, seed: int) -> None:
            self._do("signal", seed)

        @rule(seed=st.integers(0, 2**32))
        def check(self, seed: int) -> None:
            self._do("check", seed)

        def teardown(self) -> None:
            self.soak.close()

    run_state_machine_as_test(
        Machine,
        settings=settings(
            max_examples=4,
            stateful_step_count=6,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        ),
    )


def test_a_check_that_fails_is_kept_and_the_soak_goes_on(tmp_path: Path) -> None:
    s = Soak(Random(0), tmp_path)

    def wrong() -> str:
        raise AssertionError("a reading is lost or doubled")

    s.do(wrong)
    assert [line.split()[0].rstrip(":") for line in s.findings] == ["wrong"]
    assert s.counts["wrong"] == 1

    def starved() -> str:
        raise AssertionError("error: no new data over RTDE for 0.2 s")

    s.do(starved)
    assert len(s.findings) == 1
    assert s.starved == 1


def test_faults_are_drawn_from_the_whole_matrix(tmp_path: Path) -> None:
    s = Soak(Random(0), tmp_path)
    drawn: dict[str, Fault] = {}
    for _ in range(3000):
        for moment in ("moving", "measuring", "any"):
            fault = s._drawn(moment)
            drawn[fault.name] = fault
    from tests.wire.test_fault_matrix_arm import MOTION, REST
    from tests.wire.test_fault_matrix_serial import FORCE, OVERCOME, TRACKER

    assert {f.name for f in (*MOTION, *REST, *TRACKER, *FORCE)} <= set(drawn)
    assert {f"{d} {op}" for d, rows in OVERCOME.items() for op, *_ in rows} <= set(drawn)
