"""ATI Net F/T and Ethernet Axia: force and moment by UDP (Raw Data Transfer, RDT).

A request is `>HHI`: 1234 hex, command (2: send at the sensor's rate, 0: stop), count (0: endless).
Each datagram is a record `>3I6i`: number of the record, number of the measurement, status, force
and moment in counts. The sensor's web page `netftapi2.xml` gives the units, the counts per unit and
the rate.

Source: ATI Industrial Automation, Net F/T manual 9620-05-NET FT, sections 9 to 11 and 17; Ethernet
Axia manual 9610-05, table 4.7.
"""

import contextlib
import http.client
import re
import socket
import struct
import time

import numpy as np
from pydantic import Field

from hilcal.config import CellConfig
from hilcal.config.sections import Whole
from hilcal.drivers import force_stream as fs
from hilcal.drivers.force_stream import DEVICE
from hilcal.drivers.links import address, network_failures
from hilcal.errors import DeviceError, undone_by
from hilcal.measuring.devices import ForceSensorDevice
from hilcal.toml import Positive, Section, check_section
from hilcal.types import Floats

PORT = 49152
RECORD = 36
START, STOP = 2, 0
RENEW_S = 0.3
"""Silence, s, after which the request to send is repeated: it may be lost, the sensor restarted."""
_PAGE_S = 2.0
_LARGEST = 1 << 16
_BUFFER = 1 << 22
ERROR, LATCHED, SATURATED = 1 << 31, 1 << 16, 1 << 17 | 1 << 27 | 1 << 30
"""Bits of the status: any error; a threshold was once exceeded (no error); gauges over their range,
of a Net F/T (17) and of an Axia (27, 30). A sensor need not set bit 31 with them."""
_LBF, _KGF, _INCH = 4.4482216152605, 9.80665, 0.0254
_FORCE = {
    **{"1": _LBF, "2": 1.0, "3": 1e3 * _LBF, "4": 1e3, "5": _KGF},
    **{"lbf": _LBF, "n": 1.0, "klbf": 1e3 * _LBF, "kn": 1e3, "kg": _KGF, "kgf": _KGF},
}
_MOMENT = {
    **{"1": _LBF * _INCH, "2": 12 * _LBF * _INCH, "3": 1.0, "4": 1e-3, "5": 0.01 * _KGF, "6": 1e3},
    **{"lbfin": _LBF * _INCH, "lbfft": 12 * _LBF * _INCH, "nm": 1.0, "nmm": 1e-3, "knm": 1e3},
    **{"kgcm": 0.01 * _KGF, "kgfcm": 0.01 * _KGF},
}
"""N and N·m per unit. Keys: the unit's name without hyphen, or its number on the page."""


class NetFtOptions(Section):
    """[force_sensor.options]: keys of the driver "netft"."""

    web_port: Whole = Field(80, description="the port of the sensor's page, 1 to 65535")
    rate_hz: Positive | None = Field(
        None,
        description="records per second, over 0, where the sensor's page does not state it",
        examples=[1000.0],
    )


class Datagrams:
    """Records from UDP, with the interface of a port and of a deframer (`force_stream`)."""

    baudrate = 0
    skipped = 0

    def __init__(self, host: str, port: int) -> None:
        self.port = f"{host}:{port}"
        self.frames = self.corrupt = 0
        self._received = bytearray()
        self._heard = time.monotonic()
        with network_failures(DEVICE, self.port):
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            with undone_by(self._socket.close):
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
                self._socket.connect((host, port))
                self._socket.setblocking(False)
                self._ask(START)

    @property
    def in_waiting(self) -> int:
        """Number of bytes received and not yet read; repeats the request after silence."""
        while True:
            try:
                data = self._socket.recv(_LARGEST)
            except BlockingIOError:
                break
            except ConnectionRefusedError:  # nobody listens on that port
                break
            self._heard = time.monotonic()
            if data and len(data) % RECORD == 0:
                self._received += data
            else:
                self.corrupt += 1
        if time.monotonic() - self._heard > RENEW_S:
            self._heard = time.monotonic()
            with contextlib.suppress(ConnectionRefusedError):
                self._ask(START)
        return len(self._received)

    def read(self, size: int) -> bytes:
        """Return the oldest received bytes, at most `size`."""
        data = bytes(self._received[:size])
        del self._received[:size]
        return data

    def push(self, data: bytes) -> list[bytes]:
        """Split whole records, as `read` returns them."""
        self.frames += len(data) // RECORD
        return [data[at : at + RECORD] for at in range(0, len(data), RECORD)]

    def close(self) -> None:
        """Ask the sensor to stop. Never raises; may be called twice."""
        with contextlib.suppress(OSError):
            self._ask(STOP)
        self._socket.close()

    def _ask(self, command: int) -> None:
        self._socket.send(struct.pack(">HHI", 0x1234, command, 0))


def _overload(wrench: Floats, status: int) -> str:
    """The error that the status reports; that a threshold was exceeded (bit 16) is no error."""
    if status == ERROR | LATCHED or not status & (ERROR | SATURATED):
        return ""  # other bits of an Axia report a change of settings
    hint = "is it loaded over its range?" if status & SATURATED else "see the status on its page"
    return f"the sensor reports an error (status {status:#010x}); {hint}"


def page(host: str, port: int) -> str:
    """Return the sensor's web page `netftapi2.xml`."""
    where = f"{host}:{port}"
    connection = http.client.HTTPConnection(host, port, timeout=_PAGE_S)
    with network_failures(DEVICE, where), contextlib.closing(connection):
        try:
            connection.request("GET", "/netftapi2.xml")
            answer = connection.getresponse()
            xml = answer.read(_LARGEST).decode("utf-8", "replace")
            wrong = f"it has no page netftapi2.xml (HTTP status {answer.status})"
            ok = answer.status == http.client.OK
        except http.client.HTTPException as error:
            wrong, ok = f"the answer is no web page ({type(error).__name__})", False
    if not ok:
        raise DeviceError(f"{DEVICE} at {where}: {wrong}; is this a Net F/T?")
    return xml


def _value(xml: str, *names: str) -> str:
    """Return the text of the first element that the page has, else an empty string."""
    for name in names:
        match = re.search(rf"<{name}>\s*([^<]*?)\s*</{name}>", xml)
        if match:
            return match[1]
    return ""


def _number(xml: str, *names: str) -> float:
    try:
        number = float(_value(xml, *names))
    except ValueError:
        return 0.0
    return number if np.isfinite(number) and number > 0.0 else 0.0


def sensor_format(xml: str, options: NetFtOptions, where: str) -> fs.SensorFormat:
    """Return the format of the sensor's records, from its page."""
    counts = [_number(xml, name) for name in ("cfgcpf", "cfgcpt")]
    names = [_value(xml, f"s{name}", name) for name in ("cfgfu", "cfgtu")]
    units = [
        factors.get(name.lower().replace("-", ""), 0.0)
        for name, factors in zip(names, (_FORCE, _MOMENT), strict=True)
    ]
    if not all(counts) or not all(units):
        raise DeviceError(
            f"{DEVICE} at {where}: its page states no counts per unit, or in unknown units "
            f'("{names[0]}" and "{names[1]}"); set N and N-m there'
        )
    rate = options.rate_hz or _number(xml, "comrdtrate")
    if not rate:
        raise DeviceError(
            f"{DEVICE} at {where}: its page does not state its rate; give [force_sensor.options] "
            "rate_hz, records per second"
        )
    return fs.SensorFormat(
        name=_value(xml, "prodname") or "ATI Net F/T",
        frame=fs.FrameFormat(b"", RECORD, lambda record: b""),
        body=np.dtype(
            [("ticks", ">u4"), ("number", ">u4"), ("status", ">u4"), ("wrench", ">i4", 6)]
        ),
        unit=np.repeat([units[0] / counts[0], units[1] / counts[1]], 3),
        losses=lambda: fs.ByDeviceClock(1.0 / rate, 32),
        overload=_overload,
    )


def open_force_sensor(config: CellConfig) -> ForceSensorDevice:
    """Read the sensor's page, ask it to send, and wait for the first record."""
    section = fs.checked_config(config, tuple(NetFtOptions.model_fields))
    options = check_section(section.options, NetFtOptions, "[force_sensor] options")
    host, port = address("[force_sensor]", "netft", section.host, PORT)
    xml = page(host, options.web_port)
    sensor = sensor_format(xml, options, f"{host}:{options.web_port}")
    if _value(xml, "comrdte").lower() in ("disabled", "0"):
        raise DeviceError(
            f"{DEVICE} at {host}: its RDT interface is disabled; enable it (page Communications)"
        )
    facts = [("calibration", _value(xml, "cfgcalsn", "setserial"))]
    moved = _value(xml, "cfgtfx")
    if moved.strip("0;. "):
        units = f"{_value(xml, 'scfgtdu')}, {_value(xml, 'scfgtau')}"
        facts.append(
            ("tool transformation", f"{moved} ({units}): origin_m and rotvec_rad must include it")
        )
    line = Datagrams(host, port)
    stated = tuple((key, value) for key, value in facts if value)
    stream = fs.ForceStream(line, sensor, facts=stated, deframer=line, failures=network_failures)
    return stream.started()
