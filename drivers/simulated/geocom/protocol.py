"""GeoCOM's ASCII line: `%R1Q,<rpc>,<trid>[,<crc>]:<p>` and `%R1P,<com>,<trid>[,<crc>]:<rc>,<p>`.

Leica Geosystems, "TPS1200+ GeoCOM Reference Manual", chapter "ASCII protocol"; the checksum is
CRC-16/ARC over the line without the checksum and its comma.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

OK = 0
CANNOT_DECODE = 3080  # COM_CANT_DECODE_REQ
UNKNOWN_PROCEDURE = 3081  # COM_PROC_UNAVAIL
BAD_CHECKSUM = 3101  # COM_SRVR_RX_CHECKSUM_ERROR

_REQUEST = re.compile(r"%R1Q,(\d{1,5})(?:,(\d{1,5}))?(?:,(\d{1,5}))?:(.*)")


def crc16_arc(data: bytes) -> int:
    """Return the CRC-16/ARC: polynomial x¹⁶ + x¹⁵ + x² + 1, reflected, start 0."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc


@dataclass(frozen=True, slots=True)
class GeocomRequest:
    """One request, taken apart.

    Attributes:
        rpc: number of the procedure.
        transaction: number that the answer repeats.
        parameters: as written.
        checked: whether it came with a checksum, so the answer carries one too.
        error: code of the communication, `OK` where the request is sound.
    """

    rpc: int
    transaction: int
    parameters: tuple[str, ...]
    checked: bool
    error: int = OK


def parse(line: str) -> GeocomRequest | None:
    """Take a line apart; None where it is no request at all."""
    if not line.startswith("%R1Q,"):
        return None
    match = _REQUEST.fullmatch(line)
    if match is None:
        return GeocomRequest(-1, 0, (), False, CANNOT_DECODE)
    rpc, transaction, crc, rest = match.groups()
    parameters = tuple(rest.split(",")) if rest else ()
    error = OK
    if crc is not None:
        bare = f"%R1Q,{rpc},{transaction}:{rest}"
        error = OK if int(crc) == crc16_arc(bare.encode("ascii", "replace")) else BAD_CHECKSUM
    return GeocomRequest(int(rpc), int(transaction or 0), parameters, crc is not None, error)


def reply(
    com: int, transaction: int, code: int, parameters: Sequence[str], *, checked: bool
) -> bytes:
    """Return the line of an answer."""
    body = ",".join([str(code), *parameters])
    head = f"%R1P,{com},{transaction}"
    if checked:
        head += f",{crc16_arc(f'{head}:{body}'.encode())}"
    return f"{head}:{body}\r\n".encode()
