"""Random faults at random moments: ten minutes of the soak, and any order of its actions."""

import os
from pathlib import Path
from random import Random

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule, run_state_machine_as_test

from tests.soak import soak
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
