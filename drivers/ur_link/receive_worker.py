"""Child process that holds the receive interface of ur_rtde: `sample` and `rate`.

A reading is returned only if it is new: the controller's timestamp has to change within the `stale`
seconds of the request. That the library reports a connection proves nothing, since its getters
repeat the last values for ever; a reported disconnection is believed.
"""

import time
from typing import Any

from hilcal.drivers.ur_link.worker import answered, start, words

_NAMES = (
    "timestamp actual_q target_q actual_qd target_moment actual_current target_current "
    "joint_temperatures actual_TCP_pose actual_TCP_force robot_mode runtime_state "
    "safety_status_bits speed_scaling target_speed_fraction payload payload_cog ft_raw_wrench"
)
OUTPUTS = tuple(_NAMES.split())
"""The recorded outputs. The client library has a getter for each, e.g. `getActualTCPPose` for
`actual_TCP_pose`; a name unknown to it would shift the fields that follow."""
_POLL = 0.0005  # s
_TRIES = 20
_FIRST_S = 2.0  # longest wait for the first data, s


def _getter(output: str) -> str:
    return "get" + "".join(part[0].upper() + part[1:] for part in output.split("_"))


class StaleError(Exception):
    """No new data."""


def _next_stamp(link: Any, seconds: float) -> float:
    """Wait until the controller's timestamp changes, and return it."""
    first, end = link.getTimestamp(), time.monotonic() + seconds
    while True:
        stamp = link.getTimestamp()
        if stamp != first:
            return float(stamp)
        if not link.isConnected():
            raise StaleError("the RTDE connection is closed")
        if time.monotonic() > end:
            raise StaleError(f"no new data over RTDE for {seconds:g} s")
        time.sleep(_POLL)


def _sample(link: Any, names: list[str], stale: float) -> dict[str, Any]:
    """Return all fields, read from a single packet."""
    stamp = _next_stamp(link, stale)
    for _ in range(_TRIES):
        fields = {name: getattr(link, _getter(name))() for name in names}
        host_ns = time.monotonic_ns()
        newest = link.getTimestamp()
        if newest == stamp == fields["timestamp"]:
            return {"host_ns": host_ns, "fields": fields}
        stamp = newest
    raise StaleError("the RTDE data change faster than they can be read")


def _rate(link: Any, seconds: float, stale: float) -> dict[str, Any]:
    count, began = 0, time.monotonic()
    while time.monotonic() - began < seconds:
        _next_stamp(link, stale)
        count += 1
    return {"rate": count / (time.monotonic() - began)}


def main() -> None:
    """Connect, report it, then answer requests until the parent closes the line."""
    line, (host, hz, names_text) = start()
    names = names_text.split(",")
    try:
        import rtde_receive

        link = rtde_receive.RTDEReceiveInterface(host, float(hz), names, False, False)
        if not link.isConnected():
            raise StaleError("the controller negotiates RTDE but sends no data")
        _next_stamp(link, _FIRST_S)
    except Exception as error:  # any failure is reported to the parent
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
