"""What the drivers of streaming force sensors share: the device that they return."""

from collections.abc import Callable

from hilcal.config import CellConfig
from hilcal.config.rig import PORT
from hilcal.config.rig import ForceSensor as Section
from hilcal.drivers.force_stream import DEVICE, ForceStream, Port, SensorFormat
from hilcal.drivers.serial_line import close_port, drain, line_failures, open_port
from hilcal.errors import InputError
from hilcal.measuring.devices import Losses, Report, WrenchSample

FIRST_FRAME_S = 1.0
OLD_S = 0.05


class StreamingSensor:
    """A force sensor that sends by itself; see `hilcal.measuring.devices.ForceSensorDevice`."""

    def __init__(
        self,
        port: Port,
        stream: ForceStream,
        name: str,
        facts: tuple[tuple[str, str], ...] = (),
        before_close: Callable[[], None] = lambda: None,
    ) -> None:
        """Own an open port and the stream on it.

        Args:
            port: closed by `close`.
            stream: already running.
            name: the maker's, with the serial number where known.
            facts: for the report, besides those of the stream.
            before_close: sends the last command to the sensor; must not raise.
        """
        self._port, self._stream, self._name, self._facts = port, stream, name, facts
        self._before_close = before_close
        self._open = True

    def report(self) -> Report:
        """Say who answered, rate, temperature, counters, and every problem."""
        facts = (*self._facts, *self._stream.facts())
        fields = (*((what.replace(" ", "_"), value) for what, value in self._facts),)
        return Report(
            DEVICE,
            self._name,
            facts,
            tuple(self._stream.problems()),
            (*fields, *self._stream.fields()),
        )

    def latest(self) -> WrenchSample:
        """Return the newest frame, younger than 0.2 s.

        Raises:
            DeviceError: the stream is dead or stale, or the sensor is loaded over its range.
        """
        return self._stream.latest()

    def average(self, seconds: float) -> WrenchSample:
        """Return the mean of the frames of the next so many real seconds.

        Raises:
            DeviceError: the stream is dead, gave under half of its frames, or the sensor was
                loaded over its range meanwhile.
        """
        return self._stream.average(seconds)

    def losses(self) -> Losses:
        """Return the counters."""
        return self._stream.losses()

    def close(self) -> None:
        """Stop the stream, give the port back. Never raises, may be called twice."""
        if self._open:
            self._open = False
            self._stream.stop()
            self._before_close()
            close_port(self._port)


def open_streaming(section: Section, baud: int, sensor: SensorFormat) -> StreamingSensor:
    """Open the port of a sensor that streams from power-on, and wait for the first frame.

    Args:
        section: the configuration; its own rate comes before `baud`.
        baud: the sensor's rate as delivered, Bd.
        sensor: what it sends.

    Raises:
        DeviceError: no such port, in use, nothing or nothing sensible comes.
    """
    path = serial_port(section)
    port = open_port(DEVICE, path, section.baud or baud)
    stream: ForceStream | None = None
    try:
        with line_failures(DEVICE, path):
            drain(port, quiet=OLD_S, limit=OLD_S)  # adapters keep some of what came before
        stream = ForceStream(port, sensor)
        stream.wait_for_first(FIRST_FRAME_S)
    except BaseException:
        if stream is not None:
            stream.stop()
        close_port(port)
        raise
    return StreamingSensor(port, stream, sensor.name)


def serial_port(section: Section) -> str:
    """Return the serial port of a sensor that needs one.

    Raises:
        InputError: there is none.
    """
    if section.port is None:
        raise InputError(f'[force_sensor] driver = "{section.driver}" lacks "port": {PORT}')
    return section.port


def checked_config(config: CellConfig, options: tuple[str, ...] = ()) -> Section:
    """Return [force_sensor], with no option that the driver does not know.

    Raises:
        InputError: the section is missing, or has an unknown option.
    """
    section = config.force_sensor
    if section is None:
        raise InputError("[force_sensor] is missing; give driver and port")
    for name in section.options:
        if name not in options:
            valid = f"valid: {', '.join(options)}" if options else "it has none"
            raise InputError(
                f'[force_sensor] options: driver "{section.driver}" has no option "{name}"; {valid}'
            )
    return section
