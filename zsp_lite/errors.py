"""The exception that the library raises for bad input, and checks that several modules share."""

import math
import numbers
import reprlib
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

# Functions import NumPy themselves: `zsp-lite --help` imports this module and does not need it.
if TYPE_CHECKING:
    import numpy as np

# Largest coordinate, in any unit of length or in pixels. Beyond 1e150 squares overflow, and LAPACK
# may never return.
MAX_LENGTH = 1e9
# Largest entry of the difference between a rotation matrix from outside, which may have a few
# decimals or half precision, and the nearest rotation.
ROTATION_TOLERANCE = 1e-2
# Largest entry of |R @ R.T - I| for a rotation in float32, which is kept as it is.
_FLOAT32_TOLERANCE = 1e-6
_LONGEST = 1000  # characters of a message


class InputError(ValueError):
    """Bad input: one line that names the argument or file, what was given and what was expected.

    The command line prints that line on stderr and exits with code 2. Every other exception is a
    bug and shows its traceback. Of a very long message, such as one with a long path, the beginning
    and the end are kept.
    """

    def __init__(self, message: str):
        if len(message) > _LONGEST:
            message = f"{message[:600]} ... {message[-300:]}"
        super().__init__(message)


class NoPoseError(InputError):
    """Two objects whose views do not determine a pose, for instance for want of depth; all else is
    in order."""


class FatalError(ValueError):
    """An error that ends a benchmark run: a broken backbone or an unreadable frame.

    It is not an InputError: for that one, a row stores that the pair has no pose. For the pair of a
    FatalError nothing is stored.
    """


class Doubt(str):
    """A flag that says why an input is doubtful."""

    most = 0.8  # largest confidence of a pose from such an input; chosen, not fitted


class Contradiction(Doubt):
    """A flag that says that depth, colours and poses contradict each other.

    Solvers take all as measured in one world: what they find may be far off however well it fits.
    """

    most = 0.3  # chosen, too


def describe_failure(error: BaseException) -> str:
    """Describe an exception of somebody else's code in one line: where it was raised, its type and
    its message."""
    *_, last = traceback.extract_tb(error.__traceback__)
    # `str(error)` may fail itself.
    message = "".join(traceback.format_exception_only(error))
    return " ".join(f"{last.filename}, line {last.lineno}: {message}".split())


@contextmanager
def ends_the_run(what: str) -> Iterator[None]:
    """Turn an error of the block, which reads data or calls a backbone, into a FatalError."""
    try:
        yield
    except FatalError:
        raise
    except InputError as error:
        raise FatalError(str(error)) from error
    except Exception as error:  # a plug-in may raise anything
        raise FatalError(f"{what} failed: {describe_failure(error)}") from error


def check_integer(name: str, value: object, minimum: int, maximum: int | float = math.inf) -> None:
    """Raise InputError if a value is not an integer from `minimum` to `maximum`."""
    if (
        not isinstance(value, numbers.Integral)
        or isinstance(value, bool)
        or not minimum <= value <= maximum
    ):
        limits = f"of at least {minimum}" if maximum == math.inf else f"from {minimum} to {maximum}"
        raise InputError(f"{name} is {value!r}, expected an integer {limits}")


def check_number(name: str, value: object, above: float) -> None:
    """Raise InputError if a value is not a finite real number greater than `above`."""
    if (
        not isinstance(value, numbers.Real)
        or isinstance(value, bool)
        or not above < value < math.inf
    ):
        raise InputError(f"{name} is {value!r}, expected a finite number greater than {above:g}")


def check_magnitude(name: str, values: object) -> None:
    """Raise InputError if a number of an array is not finite, or above `MAX_LENGTH` in
    magnitude."""
    import numpy as np

    sizes = np.abs(values)
    if not (sizes <= MAX_LENGTH).all():  # False for NaN too
        raise InputError(
            f"{name} holds {np.max(sizes)}, expected finite numbers of at most {MAX_LENGTH:g}"
        )


def check_choice(name: str, value: object, allowed: Iterable[object]) -> None:
    """Raise InputError if a value is none of those allowed."""
    allowed = list(allowed)
    if value not in allowed:
        names = ", ".join(map(str, allowed))
        raise InputError(f"{name} is {value!r}, expected one of {names or '(none)'}")


def real_array(
    name: str, values: object, shape: tuple[int | None, ...] | None = None
) -> "np.ndarray":
    """Convert real numbers to a float64 array; InputError for texts and complex numbers, which
    NumPy would convert.

    If a `shape` is given, in which None is any length, another one is an InputError, too.
    """
    import numpy as np

    expected = "real numbers"
    if shape is not None:
        expected += f" of shape {shape}".replace("None", "n")
    array = None
    # Errors of NumPy, for instance for rows of different lengths.
    with suppress(TypeError, ValueError, RuntimeError):
        array = np.asarray(values)
    # Kinds of real numbers: booleans, integers with and without sign, floats.
    if array is None or array.dtype.kind not in "biuf":
        raise InputError(f"{name} is {reprlib.repr(values)}, expected {expected}")
    if shape is not None:
        lengths_fit = all(n in (None, m) for n, m in zip(shape, array.shape))
        if len(shape) != array.ndim or not lengths_fit:
            raise InputError(f"{name} has shape {array.shape}, expected {expected}")
    return array.astype(np.float64, copy=False)


def rotation_matrix(name: str, values: object) -> "np.ndarray":
    """Convert rotations (..., 3, 3) from outside to float64: rounded ones become the nearest
    rotations.

    InputError, which says how far off they are, for matrices that are no rotations within
    `ROTATION_TOLERANCE`.
    """
    import numpy as np

    matrix = real_array(name, values)
    if matrix.shape[-2:] != (3, 3):
        raise InputError(f"{name} has shape {matrix.shape}, expected (..., 3, 3)")
    check_magnitude(name, matrix)
    deviation = np.abs(matrix @ matrix.swapaxes(-1, -2) - np.eye(3))
    if (deviation <= _FLOAT32_TOLERANCE).all() and (np.linalg.det(matrix) > 0).all():
        return matrix.copy()
    left, _, right = np.linalg.svd(matrix)
    left[..., 2] *= np.linalg.det(left @ right)[..., None]  # of a reflection, the nearest rotation
    nearest = left @ right
    off = np.abs(nearest - matrix).max()
    if off > ROTATION_TOLERANCE:
        raise InputError(
            f"{name} is {reprlib.repr(matrix.tolist())}, {off:.2g} off the nearest rotation, "
            "expected a rotation, R @ R.T = identity and det R = 1"
        )
    return nearest


def rigid_matrix(name: str, values: object) -> "np.ndarray":
    """Convert a rigid transform (4, 4) from outside to float64, with the rotation that
    `rotation_matrix` returns."""
    import numpy as np

    matrix = real_array(name, values, (4, 4)).copy()
    check_magnitude(name, matrix)
    off = np.abs(matrix[3] - (0, 0, 0, 1)).max()
    if off > ROTATION_TOLERANCE:  # for instance a transposed matrix
        raise InputError(
            f"{name} has the last row {matrix[3].tolist()}, {off:.2g} off the expected 0 0 0 1"
        )
    matrix[:3, :3] = rotation_matrix(name, matrix[:3, :3])
    matrix[3] = 0, 0, 0, 1
    return matrix
