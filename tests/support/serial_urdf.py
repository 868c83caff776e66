"""URDFs of serial arms, a row for each joint."""

USUAL = {
    "type": "revolute", "xyz": "0 0 0", "rpy": "0 0 0", "axis": "0 0 1",
    "lower": -3.1, "upper": 3.1, "effort": 100, "mimic": "", "com": "0 0 0.1",
}  # fmt: skip


def serial_urdf(rows):
    """Joints j1, j2, ... to links l1, l2, ..., unless named; masses where given, kg."""
    out, parent = ['<robot name="arm"><link name="l0"/>'], "l0"
    for k, row in enumerate(rows, start=1):
        r = {**USUAL, "name": f"j{k}", "link": f"l{k}", **row}
        mass = (
            ""
            if "mass" not in r
            else (
                f'<inertial><origin xyz="{r["com"]}"/><mass value="{r["mass"]}"/>'
                '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
            )
        )
        out += [
            f'<joint name="{r["name"]}" type="{r["type"]}"><parent link="{parent}"/>',
            f'<child link="{r["link"]}"/><origin xyz="{r["xyz"]}" rpy="{r["rpy"]}"/>',
            f'<axis xyz="{r["axis"]}"/><limit lower="{r["lower"]}" upper="{r["upper"]}"',
            f' effort="{r["effort"]}" velocity="1"/>{r["mimic"]}</joint>',
            f'<link name="{r["link"]}">{mass}</link>',
        ]
        parent = str(r["link"])
    return "\n".join([*out, "</robot>"])
