"""A process of the real client library, led by JSON lines: [part, call, arguments]."""

import json
import os
import sys

import dashboard_client
import rtde_control
import rtde_io
import rtde_receive

UPLOAD = rtde_control.RTDEControlInterface.FLAG_UPLOAD_SCRIPT
UPPER = rtde_control.RTDEControlInterface.FLAG_UPPER_RANGE_REGISTERS


def opened(part, host, *arguments):
    if part == "control":
        return rtde_control.RTDEControlInterface(host, 125.0, UPLOAD | UPPER)
    if part == "receive":
        return rtde_receive.RTDEReceiveInterface(host, 125.0, *arguments)
    if part == "io":
        return rtde_io.RTDEIOInterface(host)
    dashboard = dashboard_client.DashboardClient(host)
    dashboard.connect()
    return dashboard


def main():
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # the library writes messages of its own
    parts = {}
    for line in sys.stdin:
        part, call, arguments = json.loads(line)
        try:
            if call == "open":
                parts[part], result = opened(part, *arguments), None
            else:
                result = getattr(parts[part], call)(*arguments)
            answer = {"result": result}
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
