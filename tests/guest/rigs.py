"""The configurations of the guest's daemons."""

USB, FAST, STEPS = "FT4ABCDE", "FT4FAST0", "FT4STEPS"
"""Serial numbers of the adapters."""
COST_PORTS = (7451, 7452, 7453)
"""Where the programs listen whose processor time is compared."""

AXIS = """
[[bus.axis]]
name = "{name}"
address = {address}
model = "{model}"
unit = "mm"
counts_per_unit = 1000
velocity = 20
acceleration = 200
limits = {{ position_min = -100, position_max = 100, velocity = 50, acceleration = 1000 }}
gains = {{ kp = 350, kd = 3000, ki = 400, il = 400, ol = 250, el = 4000 }}
home = {{ method = "index", velocity = 1 }}
rates = {{ position = 3, velocity = 3, adc = 0.5, state = 3 }}
loss = {{ bus = "{loss}" }}
"""
LINE = """
[[bus]]
name = "{name}"
port = "{port}"
baud = {baud}
margin_ms = 200
overload = "skip"
start = "adopt"
adopt_fallback = "reset"
"""
STEPS_LINE = f"""
[[bus]]
name = "steps"
port = "/dev/ldcn-{STEPS}-00"
family = "smartstep"
margin_ms = 200
overload = "skip"
smartstep = {{ framing = "7e1", wiring = "4-wire", echo = "none" }}
""" + "".join(
    f"""
[[bus.axis]]
name = "{name}"
address = {address}
model = "smartstep"
unit = "rev"
counts_per_unit = 8000
rates = {{ position = 0.5, velocity = 0.5, state = 0.5 }}
"""
    for name, address in (("feed", 1), ("spool", 2))
)


def line(name: str, port: str, axes: dict[str, str], *, baud: int = 115_200) -> str:
    """Return a line of LDCN drives: models by axis name, at addresses from 1 on; y alone runs to its target unseen."""
    described = "".join(
        AXIS.format(name=axis, address=address, model=model, loss="run_to_target" if axis == "y" else "halt")
        for address, (axis, model) in enumerate(axes.items(), 1)
    )
    return LINE.format(name=name, port=port, baud=baud) + described


def rig(name: str, port: int, *lines: str) -> str:
    """Return a rig that listens to the host of the guest, too."""
    return f'rig = "{name}"\n[zenoh]\nlisten = ["tcp/10.0.2.15:{port}", "tcp/127.0.0.1:{port}"]\n' + "".join(lines)


def adapters() -> str:
    """Return the rig of all USB adapters."""
    return rig(
        "usb",
        7447,
        line("usb", f"/dev/ldcn-{USB}-00", {"x": "ls-182ap", "y": "ls-182ap", "z": "pic-servo-v4"}),
        line("fast", f"/dev/ldcn-{FAST}-00", {"s": "pic-servo-sc"}, baud=230_400),
        STEPS_LINE,
    )


def on_board(baud: int = 115_200) -> str:
    """Return the rig of the UART on board."""
    return rig("uart", 7448, line("uart", "/dev/ttyS1", {"u": "ls-182ap", "v": "pic-servo-v4"}, baud=baud))
