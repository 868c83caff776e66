"""CRC-16 as serial devices append it: reflected, one byte at a time."""

import functools


@functools.cache
def _table(polynomial: int) -> tuple[int, ...]:
    """Return the remainders of the 256 values of a byte."""
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value >> 1) ^ (polynomial if value & 1 else 0)
        table.append(value)
    return tuple(table)


def crc16(data: bytes, start: int = 0, polynomial: int = 0xA001) -> int:
    """Return the CRC-16 with a reflected polynomial; the defaults give CRC-16/ARC."""
    crc, table = start, _table(polynomial)
    for byte in data:
        crc = (crc >> 8) ^ table[(crc ^ byte) & 0xFF]
    return crc


def crc_modbus(data: bytes) -> bytes:
    """Return the two bytes of CRC-16/MODBUS: initial value FFFF."""
    return crc16(data, 0xFFFF).to_bytes(2, "little")


def crc_x25(data: bytes) -> bytes:
    """Return the two bytes of CRC-16/X-25: polynomial 1021, initial value FFFF, inverted."""
    return (crc16(data, 0xFFFF, 0x8408) ^ 0xFFFF).to_bytes(2, "little")
