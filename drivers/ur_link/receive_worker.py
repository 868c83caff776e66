"""Child process that holds the receive interface of ur_rtde: `sample` and `rate`.

A reading is given only when it is new: the controller's timestamp has to change within the
`stale` seconds of the request. Whether the library calls itself connected proves nothing, since
its getters go on with the last values for ever; that it calls itself disconnected is believed.
"""

import time
from typing import Any

from hilcal.drivers.ur_link.worker import answered, start, words

GETTERS = {
    "timestamp": "getTimestamp",
    "actual_q": "getActualQ",
    "target_q": "getTargetQ",
    "actual_qd": "getActualQd",
    "target_moment": "getTargetMoment",
    "actual_current": "getActualCurrent",
    "target_current": "getTargetCurrent",
    "joint_temperatures": "getJointTemperatures",
    "actual_TCP_pose": "getActualTCPPose",
    "actual_TCP_force": "getActualTCPForce",
    "robot_mode": "getRobotMode",
    "runtime_state": "getRuntimeState",
    "safety_status_bits": "getSafetyStatusBits",
    "speed_scaling": "getSpeedScaling",
    "target_speed_fraction": "getTargetSpeedFraction",
    "payload": "getPayload",
    "payload_cog": "getPayloadCog",
    "ft_raw_wrench": "getFtRawWrench",
}
"""Outputs that the client library knows; another name would shift the fields behind it."""

_POLL = 0.0005  # s
_TRIES = 20
_FIRST_S = 2.0  # until the first data come, s


class StaleError(Exception):
    """No new data."""


def _next_stamp(link: Any, seconds: float) -> float:
    """Wait until the controller's timestamp changes, and return it."""
    before, end = link.getTimestamp(), time.monotonic() + seconds
    while True:
        stamp = link.getTimestamp()
        if stamp != before:
            return float(stamp)
        if not link.isConnected():
            raise StaleError("the RTDE connection is closed")
        if time.monotonic() > end:
            raise StaleError(f"no new data over RTDE for {seconds:g} s")
        time.sleep(_POLL)


def _sample(link: Any, names: list[str], stale: float) -> dict[str, Any]:
    """Return all fields of one and the same packet."""
    stamp = _next_stamp(link, stale)
    for _ in range(_TRIES):
        fields = {name: getattr(link, GETTERS[name])() for name in names}
        host_ns = time.monotonic_ns()
        again = link.getTimestamp()
        if again == stamp == fields["timestamp"]:
            return {"host_ns": host_ns, "fields": fields}
        stamp = again
    raise StaleError("the RTDE data change faster than they can be read")


def _rate(link: Any, seconds: float, stale: float) -> dict[str, Any]:
    count, begun = 0, time.monotonic()
    while time.monotonic() - begun < seconds:
        _next_stamp(link, stale)
        count += 1
    return {"rate": count / (time.monotonic() - begun)}


def main() -> None:
    """Connect, say so, then answer requests until the parent closes the line."""
    line, (host, hz, names_text) = start()
    names = names_text.split(",")
    try:
        import rtde_receive

        link = rtde_receive.RTDEReceiveInterface(host, float(hz), names, False, False)
        if not link.isConnected():
            raise StaleError("the controller negotiates RTDE but sends no data")
        _next_stamp(link, _FIRST_S)
    except Exception as error:  # whatever it is, the parent has to know
        line.answer(0, error=words(error))
        return
    line.answer(0)

    def do(request: dict[str, Any]) -> dict[str, Any]:
        if request["op"] == "sample":
            return _sample(link, names, request["stale"])
        return _rate(link, request["window"], request["stale"])

    while True:
        request = line.next(1.0)
        if request is not None:
            answered(line, request, do)


if __name__ == "__main__":
    main()
