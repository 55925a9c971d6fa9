"""Validation of arguments: each function returns the converted value or raises a ValueError of one line.

Numbers must also be representable in single precision: 1e39 is rejected here and does not become infinite on the
device.
"""

import difflib
import math
import warnings

import numpy as np

LARGEST = float(np.finfo(np.float32).max)
EXACT = 2.0**53
"""Up to this size double precision has all whole numbers."""
_PLAIN = frozenset({float, int, np.float64})
"""Types of numbers that need no conversion by NumPy, which takes long for the millions of numbers of a scene."""
LONGEST = 80
LONGEST_QUATERNION = 3.0
"""Length beyond which a quaternion is doubted; the numbers 0 and 1 make at most 2."""
MOST_LISTED = 8
"""Maximum number of names of a scene, or of environments, in a message."""
MOST_SUGGESTED = 3


def shown(value):
    """Format a caller's value for a message: on one line, truncated if long."""
    if isinstance(value, np.generic | np.ndarray) and value.size <= LONGEST:
        value = value.tolist()
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # an integer of thousands of digits
        return f"a {type(value).__name__} too long to show"
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


def finite_vector(name, value, length=3):
    """Check a vector.

    Args:
        name: name of the value in the message.
        value: `length` numbers.
        length: required number of components.

    Returns:
        The vector as a tuple of floats.

    Raises:
        ValueError: The value is not `length` finite numbers.
    """
    given = value.tolist() if type(value) is np.ndarray and value.shape == (length,) else value
    if type(given) in (tuple, list) and len(given) == length:
        kinds = set(map(type, given))
        if kinds == {float} and math.hypot(*given) <= EXACT:
            return tuple(given)  # a tuple is shared, as by the many bodies at rest
        if kinds <= _PLAIN and all(-EXACT <= x <= EXACT for x in given):
            return tuple(map(float, given))
    array = numbers_of(value)
    ok = array is not None and array.shape == (length,)
    if not (ok and bool((np.abs(array) <= LARGEST).all())):
        raise ValueError(f"{name}: must be {length} finite numbers, got {shown(value)}")
    return tuple(float(x) for x in array)


def box_corners(name, value):
    """Check the lower and upper corner of a box. Corners may be infinite.

    Args:
        name: name of the value in the message.
        value: two corners of three numbers each.

    Returns:
        The two corners as tuples of floats.

    Raises:
        ValueError: The value has another form, or the lower corner is not below the upper one.
    """
    array = numbers_of(value)
    if array is None or array.shape != (2, 3) or not (array[0] < array[1]).all():
        raise ValueError(f"{name}: must be (lower, upper), three numbers each, lower below upper, got {shown(value)}")
    return tuple(tuple(float(x) for x in corner) for corner in array)


def number_in(name, value, low=-math.inf, high=math.inf, *, above=None):
    """Check that a value is a finite number within a range.

    Args:
        name: name of the value in the message.
        value: one number.
        low: smallest value allowed.
        high: largest value allowed.
        above: exclusive lower bound, used instead of `low`.

    Returns:
        The number as a float.

    Raises:
        ValueError: The value is not a finite number or is outside the range.
    """
    if type(value) in _PLAIN and low <= value <= high and abs(value) <= EXACT and (above is None or value > above):
        return float(value)
    array = numbers_of(value)
    number = math.nan if array is None or array.shape != () else float(array)
    if not (abs(number) <= LARGEST and low <= number <= high and (above is None or number > above)):
        raise ValueError(f"{name}: must be {_range(low, high, above)}, got {shown(value)}")
    return number


def number_array(name, value):
    """Check that a value is an array of numbers and return it as float64; else raise ValueError.

    Any shape is accepted, and so are NaN and infinity.
    """
    array = numbers_of(value)
    if array is None:
        raise ValueError(f"{name}: must be an array of numbers, got {shown(value)}")
    return array


def numbers_of_shape(name, value, shape):
    """Check that a value is numbers that broadcast to a shape and return them so; else raise ValueError.

    Text, complex numbers and booleans are no numbers. NaN and infinity are accepted. The first axis of a shape is that
    of the environments: the message for one value per environment names the missing axis.
    """
    array = array_of(value)
    try:
        if array is None or array.dtype.kind not in "iuf":
            raise TypeError
        if array.dtype == np.float16:  # in which comparisons with the bounds of single precision would be made
            array = array.astype(np.float32)
        return np.broadcast_to(array, shape)
    except (ValueError, TypeError) as error:
        got = shown(value) if isinstance(error, TypeError) else _got_shape(value, shape)
        raise ValueError(f"{name}: must be numbers that broadcast to {shape}, got {got}") from error


def _got_shape(value, shape):
    """Format a value that does not broadcast to a shape, with the shape for one value per environment if meant."""
    per_environment = len(shape) > 1 and shape_of(value) == (shape[0], *shape[2:])
    hint = f"; one per environment has shape {(shape[0], 1, *shape[2:])}" if per_environment else ""
    return f"{brief(value)}{hint}"


def refuse_others(name, values, allowed, kind):
    """Refuse an array with numbers that are not allowed, such as NaN.

    Args:
        name: name of the values in the message.
        values: array of numbers.
        allowed: mask of the same shape.
        kind: what the numbers must be, for the message.

    Raises:
        ValueError: A number is not allowed; the message has the first one.
    """
    if not allowed.all():
        raise ValueError(f"{name}: must be {kind}, got {values[~allowed].flat[0]:g}")


def flags(name, value, shape):
    """Check that a value is True and False only and return it as a boolean array of a shape; else raise ValueError."""
    array = array_of(value)
    if array is None or array.dtype != bool:
        raise ValueError(f"{name}: must be True or False, got {shown(value)}")
    try:
        return np.broadcast_to(array, shape)
    except ValueError as error:
        raise ValueError(f"{name}: must broadcast to {shape}, got {_got_shape(value, shape)}") from error


def brief(value):
    """Format a caller's value for a message: the shape of an array, or the value."""
    shape = shape_of(value)
    return f"shape {shape}" if shape else shown(value)


def shape_of(value):
    """Shape of a caller's value; () where it is no array, such as lists of unequal lengths."""
    try:
        return np.shape(value)
    except (ValueError, TypeError):
        return ()


def whole_in(name, value, low, high):
    """Check that a value is an integer with low <= value <= high and return it as an int; else raise ValueError."""
    ok = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not ok or not low <= value <= high:
        raise ValueError(f"{name}: must be a whole number from {low} to {high}, got {shown(value)}")
    return int(value)


def one_of(name, value, choices):
    """Check that a string is one of `choices` and return it; else raise ValueError."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name}: must be one of {', '.join(choices)}, got {shown(value)}")
    return value


def instance_of(name, value, kind, words):
    """Check that a value is of a type, which `words` describe, and return it; else raise ValueError."""
    if not isinstance(value, kind):
        raise ValueError(f"{name}: must be {words}, got {shown(value)}")
    return value


def suggestion(value, names, where=""):
    """Format the end of a message about an unknown name: the names that resemble it, and where all names are.

    Args:
        value: the unknown name.
        names: the known names.
        where: what lists the known names; "" to list them in the message.
    """
    near = (
        difflib.get_close_matches(value, list(dict.fromkeys(names)), MOST_SUGGESTED) if isinstance(value, str) else []
    )
    question = f"did you mean {' or '.join(near)}? All" if near else "all"
    return f"; {question} names: {where or ', '.join(names)}"


def listed(entries):
    """Format the first entries of a list for a message."""
    more = ", ..." if len(entries) > MOST_LISTED else ""
    return ", ".join(str(entry) for entry in entries[:MOST_LISTED]) + more


def unit_quaternion(name, value):
    """Check a rotation and normalise it; warn of one that is probably angles.

    Args:
        name: name of the value in the message.
        value: quaternion (x, y, z, w) of nonzero length.

    Returns:
        The unit quaternion, a tuple of floats.

    Raises:
        ValueError: The value is not four finite numbers, or all are zero.
    """
    quaternion = finite_vector(name, value, 4)
    length = math.hypot(*quaternion)
    if length < 1e-6:
        raise ValueError(f"{name}: must be a quaternion (x, y, z, w) of length > 0, got {shown(value)}")
    if length > LONGEST_QUATERNION:
        # The same text for all values: Python shows it once for each place in a program.
        text = f"a quaternion (x, y, z, w) longer than {LONGEST_QUATERNION:g} is divided by its length"
        warnings.warn(f"orientation: {text}; it is no list of angles", stacklevel=4)
    # A unit quaternion is returned bit for bit.
    return quaternion if abs(length - 1.0) <= 1e-15 else tuple(x / length for x in quaternion)


def array_of(value):
    """Convert to an array; None for what is none, such as lists of unequal lengths, and where values are masked.

    Lists of numbers and booleans are none either; NumPy takes True as 1 there.
    """
    if isinstance(value, np.ma.MaskedArray) and np.ma.getmaskarray(value).any():
        return None
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, OverflowError):
        return None
    if isinstance(value, list | tuple) and array.dtype.kind in "iuf":
        if any(isinstance(x, bool | np.bool_) for x in np.array(value, dtype=object).flat):
            return None
    return array


def numbers_of(value):
    """Convert to a float64 array; None if the value is not numeric. Complex numbers and booleans are not."""
    array = array_of(value)
    return None if array is None or array.dtype.kind not in "iuf" else array.astype(np.float64)


def _range(low, high, above):
    if above is not None and math.isinf(high):
        return f"a finite number > {above:g}"
    if above is not None:
        return f"a number with {above:g} < number <= {high:g}"
    if math.isinf(low) and math.isinf(high):
        return "a finite number"
    if math.isinf(high):
        return f"a finite number >= {low:g}"
    return f"a number from {low:g} to {high:g}"
