"""Units of the columns of result tables."""

UNITS = {
    "dt": "s",
    "duration": "s",
    "time": "s",
    "wall_time": "s",
    "mass": "kg",
    "position": "m",
    "linear_velocity": "m/s",
    "angular_velocity": "rad/s",
    "force": "N",
    "torque": "N m",
    "gravity": "m/s^2",
    "rolling_friction": "m",
    "spinning_friction": "m",
    "field_acceleration": "m/s^2",
    "field_center": "m",
    "field_strength": "m^3/s^2",
    "field_drag": "1/s",
    "field_velocity": "m/s",
    "joint_break_force": "N",
    "joint_break_torque": "N m",
    "center_of_mass": "m",
    "top_height": "m",
    "deepest_overlap": "m",
    "drift": "m",
    "settle_time": "s",
    "kinetic_energy": "J",
    "potential_energy": "J",
    "energy": "J",
    "peak_impulse": "N s",
    "summed_impulse": "N s",
    "first_contact": "s",
    "rest_time": "s",
    "largest_overlap": "m",
}
"""Units of settings, properties, built-in metrics and observers that have one, and the same one in every scene."""


def unit_of(column: str) -> str | None:
    """Unit of a column, such as "mass[box_3]"; None if it has none, or is of the user's code."""
    return UNITS.get(column.split("[")[0])
