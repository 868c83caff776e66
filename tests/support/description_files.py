"""Descriptions of the arm `maker_arms.ARMS["krl"]` in forms of other simulators."""

from tests.support.paths import ROOT

MJCF, SDF = ((ROOT / "tests" / "data" / f"lab.{kind}").read_text() for kind in ("xml", "sdf"))
