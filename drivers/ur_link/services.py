"""What the driver needs of a UR controller, by TCP port."""

from drivers.ur_link import dashboard, probe, script_port

SERVICES = {
    dashboard.PORT: "dashboard server",
    script_port.PORT: "script port",
    probe.PORT: "real-time interface (RTDE)",
}
