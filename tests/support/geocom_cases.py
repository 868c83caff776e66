"""A GeoCOM instrument that answers by a table, on a pseudo-terminal; and cells that name one."""

import os
import select
import threading
import tty
from contextlib import contextmanager

from hilcal.config import CellConfig


def crc16(data, crc=0):
    """CRC-16/ARC, bit by bit; of Modbus (over Serial Line V1.02, 6.2.2) where it begins at FFFF."""
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0xA001 if crc & 1 else 0)
    return crc


def line(head, body):
    """A reply with its checksum; `head` is %R1P,com,transaction."""
    return f"{head},{crc16(f'{head}:{body}'.encode())}:{body}\r\n".encode()


GREETING = {
    0: "0",
    108: "0,15",
    110: "0,1,50,0",
    5003: "0,77",
    5004: '0,"TABLE"',
    5034: "0,6,20,0",
    2008: "0",
    9021: "0,1",
}
UNKNOWN = "3081"


@contextmanager
def table_instrument(table):
    """Serve a table: request number -> body of the reply, or a function(transaction, arguments) of
    its bytes; requests that are not in it are unknown. The table may change meanwhile; yields
    the port and the numbers of the requests."""
    asked = []
    master, slave = os.openpty()
    tty.setraw(slave)
    stop, woken = os.pipe()[::-1]

    def reply(text):
        head, _, rest = text.partition(":")
        _, number, transaction = head.split(",")[:3]
        asked.append(int(number))
        answer = table.get(int(number), GREETING.get(int(number)))
        if callable(answer):
            return answer(transaction, rest)
        if answer is None:
            return line(f"%R1P,{UNKNOWN},{transaction}", "0")
        return line(f"%R1P,0,{transaction}", answer)

    def serve():
        buffer = b""
        while True:
            ready, _, _ = select.select([master, woken], [], [])
            if woken in ready:
                return
            buffer += os.read(master, 4096)
            while b"\n" in buffer:
                text, buffer = buffer.split(b"\n", 1)
                if text.strip():
                    os.write(master, reply(text.decode().strip()))

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield os.ttyname(slave), asked
    finally:
        os.write(stop, b"x")
        thread.join()
        for end in (master, slave, stop, woken):
            os.close(end)


def cell(port, scale=20.0, **tracker):
    return CellConfig.model_validate(
        {
            "robot": {"model": "ur10e"},
            "tracker": {"driver": "geocom", "port": str(port), **tracker},
            "operator": {"driver": "simulated"},
            "simulation": {"clock": scale},
        }
    )
