"""What instruments in a network send, damaged.

TCP and UDP have checksums of their own: what is accepted has to be possible, not a sound reading.
"""

from random import Random

import numpy as np

from hilcal.config.cell import Tracker
from hilcal.drivers import emscon, netft
from hilcal.drivers import emscon_packets as es
from hilcal.drivers import natnet_frames as nn
from hilcal.drivers.emscon import EmsconConnection, EmsconTracker
from hilcal.drivers.natnet import NatNetTracker
from hilcal.drivers.simulated.natnet_server import BODY, Cameras
from tests.fuzz.damage import bytes_damaged
from tests.fuzz.harness import Accepted, Parser
from tests.fuzz.stand_ins import Socket

TARGET = np.array([0.5, 2.8, 0.4])


class _Line(Socket):
    def settimeout(self, seconds: float) -> None: ...
    def close(self) -> None: ...


def _emscon() -> Parser:
    sound = []
    for turn in (None, np.array([0.5, 0.5, 0.5, 0.5])):
        cov = 1e-10 * np.eye(3)
        m = es.Measurement(
            TARGET, cov, turn, np.array([0.0, 1.57, 1.57]), cov, (20.0, 1013.0, 40.0)
        )
        kind, packed = es.pack_measurement(m, es.STATIONARY if turn is None else es.STATIONARY_6D)
        body = es.OK.to_bytes(4, "little") + packed
        change = es.HEADER.pack(12, es.CHANGE) + (7).to_bytes(4, "little")
        sound.append(change + es.HEADER.pack(8 + len(body), kind) + body)

    def make(by: Random) -> bytes:
        k = by.randrange(2)
        return bytes([k]) + (sound[k] if by.random() < 0.1 else bytes_damaged(sound[k], by, sound))

    def parse(data: bytes) -> bool:
        line = EmsconConnection.__new__(EmsconConnection)
        line.where, line.changes, line.open = "fuzz", [], True
        line._came, line._socket = bytearray(), _Line(data[1:])  # type: ignore[assignment]
        tracker = EmsconTracker.__new__(EmsconTracker)
        target = "pose" if data[0] else "position"
        tracker._options = emscon.EmsconOptions(target=target)  # type: ignore[arg-type]
        tracker._config, tracker._remarks, tracker._line = Tracker(), [], line
        tracker._ready = lambda seconds=0.0: np.inf  # type: ignore[method-assign]
        tracker._clock = None  # type: ignore[assignment]
        tracker._soon = tracker._ready  # type: ignore[method-assign]
        kind, status, body = line.result(until=np.inf)
        tracker._measure = lambda: tracker._sound(kind, status, body)  # type: ignore[method-assign]
        sample = tracker.measure()
        if not (np.isfinite(sample.value).all() and np.linalg.eigvalsh(sample.covariance)[0] > 0.0):
            raise Accepted("emscon: a reading that cannot be")
        return True

    return Parser("emscon", make, parse)


def _natnet() -> Parser:
    rng = np.random.default_rng(1)
    cameras = Cameras(None, rng, None, (4, 1), 0.0, np.zeros((6, 4)), 0.0)  # type: ignore[arg-type]
    cameras.paused, cameras.seen, cameras.others = True, (TARGET, np.array([0, 0, 0, 1.0])), 2
    cameras.board = type("Board", (), {"time": 1.0})()  # type: ignore[assignment]
    versions: tuple[nn.Version, ...] = ((3, 0), (4, 0), (4, 1), (4, 2))
    sound = [nn.message(nn.FRAME, cameras.frame(v)) for v in versions]
    sound += [nn.message(nn.DESCRIPTIONS, cameras.descriptions(v)) for v in versions]

    def make(by: Random) -> bytes:
        k = by.randrange(8)
        return bytes([k]) + (sound[k] if by.random() < 0.1 else bytes_damaged(sound[k], by, sound))

    def parse(data: bytes) -> bool:
        tracker = NatNetTracker.__new__(NatNetTracker)
        tracker.where, tracker._newest = "fuzz", -1
        version = versions[data[0] % 4]
        tracker._server = nn.NatNetServer("fuzz", "1", version)
        if data[0] < 4:
            bodies = tracker._next(_Line(data[1:]))  # type: ignore[arg-type]
            for body in bodies or ():
                if not np.isfinite([*body.position, *body.quaternion]).all():
                    raise Accepted("natnet: a pose that cannot be")
            return any(b.number == BODY for b in bodies or ())
        tracker._options = type("Options", (), {"rigid_body": "tool"})()  # type: ignore[assignment]
        tracker._ask = lambda request, answer: data[5:]  # type: ignore[method-assign]
        return tracker._found()[1] == "tool"

    return Parser("natnet", make, parse)


def _page() -> Parser:
    words = b"<netft><prodname>x</prodname><cfgcpf>1000000</cfgcpf><cfgcpt>1000</cfgcpt>"
    words += b"<scfgfu>N</scfgfu><scfgtu>Nmm</scfgtu><comrdtrate>7000</comrdtrate></netft>"

    def make(by: Random) -> bytes:
        return words if by.random() < 0.1 else bytes_damaged(words, by)

    def parse(data: bytes) -> bool:
        sensor = netft.sensor_format(data.decode("utf-8", "replace"), netft.NetFtOptions(), "fuzz")
        counter = sensor.losses()
        if not (np.isfinite(sensor.unit).all() and (sensor.unit > 0).all() and counter.rate >= 0):
            raise Accepted("netft: units that cannot be")
        return True

    return Parser("netft_page", make, parse)


def parsers() -> list[Parser]:
    """All of them."""
    return [_emscon(), _natnet(), _page()]
