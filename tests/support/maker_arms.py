"""Arms with spherical wrists as four makers count their joints, made of URDFs."""

from pathlib import Path

from hilcal.robot.urdf import arm_from_urdf

EXAMPLES = Path(__file__).parents[1] / "unit" / "calibration" / "programs" / "examples"
ARMS = {
    # KR 10 R1420, as ROS-Industrial's kuka_experimental has it
    "krl": (
        ["0 0 0.45", "0.15 0 0", "0.61 0 0", "0 0 0.02", "0.66 0 0", "0 0 0"],
        ["0 0 -1", "0 1 0", "0 1 0", "-1 0 0", "0 1 0", "-1 0 0"],
        '<origin xyz="0.08 0 0" rpy="0 1.5707963267948966 0"/>',
    ),
    # IRB 120
    "rapid": (
        ["0 0 0.29", "0 0 0", "0 0 0.27", "0 0 0.07", "0.302 0 0", "0.072 0 0"],
        ["0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0"],
        '<origin xyz="0 0 0" rpy="0 1.5707963267948966 0"/>',
    ),
    # LR Mate 200iD
    "fanuc": (
        ["0 0 0", "0.05 0 0", "0 0 0.33", "0 0 0.035", "0.335 0 0", "0.08 0 0"],
        ["0 0 1", "0 1 0", "0 -1 0", "-1 0 0", "0 -1 0", "-1 0 0"],
        '<origin xyz="0 0 0" rpy="3.141592653589793 -1.5707963267948966 0"/>',
    ),
}
"""Places and axes of the joints, each in the frame before it, and the flange's place."""
ARMS["inform"] = ARMS["fanuc"]


def urdf_of(maker, limit=2.9, wrist=5.9):
    """A URDF of the maker's arm; axes 4 and 6 turn farther."""
    places, axes, tip = ARMS[maker]
    links = ["base_link", *(f"link_{k}" for k in range(1, 7)), "tool0"]
    out = [f"<robot name='{maker}'>", *(f"<link name='{name}'/>" for name in links)]
    for k, (xyz, axis) in enumerate(zip(places, axes, strict=True)):
        far = wrist if k in (3, 5) else limit
        out.append(
            f"<joint name='j{k + 1}' type='revolute'><origin xyz='{xyz}' rpy='0 0 0'/>"
            f"<parent link='{links[k]}'/><child link='{links[k + 1]}'/><axis xyz='{axis}'/>"
            f"<limit lower='{-far}' upper='{far}' effort='100' velocity='3'/></joint>"
        )
    out.append(
        f"<joint name='flange' type='fixed'>{tip}<parent link='link_6'/><child link='tool0'/>"
        "</joint>"
    )
    return "\n".join([*out, "</robot>"])


def maker_arm(maker, folder):
    path = folder / f"{maker}.urdf"
    path.write_text(urdf_of(maker), encoding="utf-8")
    return arm_from_urdf(path)
