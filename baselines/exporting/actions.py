"""Meaning of the four components of an action, in physical units."""

from typing import Any, NamedTuple

from quad_gym.params import checks as check


class ActionField(NamedTuple):
    """Component a of an action: `quantity = offset + scale a`, limited to `most`."""

    name: str
    offset: float
    scale: float
    unit: str
    frame: str
    """Frame. B: body; H: level, x along the body's heading, y to its left, z up; "-": none"""
    most: float | None = None

    def formula(self, number: int) -> str:
        """Formula for the quantity, such as `thrust = 7.644 (1 + a[0]) N`."""
        a = f"a[{number}]"
        value = f"{self.scale:.6g} {a}"
        if self.offset == self.scale:
            value = f"{self.scale:.6g} (1 + {a})"
        frame = "" if self.frame == "-" else f" in {self.frame}"
        limit = "" if self.most is None else f", at most {self.most:g} {self.unit}"
        return f"{self.name} = {value} {self.unit}{frame}{limit}"


def action_fields(action: str, params: Any) -> tuple[ActionField, ...]:
    """Describe the four components of an action, the keyword `action` of an environment.

    `params` are nominal parameters, one scalar PARAMS record (`packing.flight.params_record`).
    """
    check.choice("action", action, ("ctbr", "motor", "wrench", "attitude", "velocity"))
    weight = float(params["mass"] * params["gravity"])
    thrust = ActionField("thrust", weight, weight, "N", "B")
    rates = [float(rate) for rate in params["rate_scale"]]
    yaw_rate = ActionField("yaw rate", 0.0, rates[2], "rad/s", "B")
    if action == "ctbr":
        axes = zip("xyz", rates, strict=True)
        return thrust, *(ActionField(f"body rate {a}", 0.0, w, "rad/s", "B") for a, w in axes)
    if action == "motor":
        hover, most = float(params["hover_voltage"]), float(params["max_voltage"])
        return tuple(
            ActionField(f"voltage of rotor {i}", hover, hover, "V", "-", most) for i in range(1, 5)
        )
    if action == "wrench":
        axes = zip("xyz", map(float, params["torque_scale"]), strict=True)
        return thrust, *(ActionField(f"torque {a}", 0.0, t, "N m", "B") for a, t in axes)
    if action == "attitude":
        tilt = float(params["tilt_scale"])
        angles = (ActionField(name, 0.0, tilt, "rad", "B") for name in ("roll", "pitch"))
        return thrust, *angles, yaw_rate
    speed = float(params["velocity_scale"])
    names = ("velocity ahead", "velocity to the left", "velocity up")
    return *(ActionField(name, 0.0, speed, "m/s", "H") for name in names), yaw_rate
