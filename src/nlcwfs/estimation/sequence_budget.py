"""How the FFTs of a frame of a sequence are spent."""

import math

from nlcwfs.errors import SettingsError
from nlcwfs.estimation.gauss_newton import ffts_per_step


def fixed_ffts(planes: int, *, inner: tuple[int, ...], oversampling: int = 2, colours: int = 1) -> int:
    """FFTs of a frame that is followed: steps, the prediction, the model at the end and the filters of the verdict.

    The verdict filters counts and residual on the frames' pixels, whose FFTs are smaller than the model's.

    Args:
        planes: Of the sensor.
        inner: Conjugate gradients of each step.
        oversampling: Cells of the model per pixel along an axis.
        colours: Wavelengths of the model.

    Examples:
        >>> fixed_ffts(4, inner=(2, 2, 1)), fixed_ffts(4, inner=(3, 3), oversampling=1)
        (97, 103)
        >>> fixed_ffts(4, inner=(2, 2, 1), colours=3)
        267
    """
    verdict = math.ceil(2 * planes / oversampling**2)
    steps = sum(ffts_per_step(planes, each, colours=colours) for each in inner)
    return steps + colours * (planes + 1) + 2 + verdict


def inner_steps(planes: int, *, budget: int, steps: int, oversampling: int = 2) -> tuple[int, ...]:
    """Conjugate gradients of each step that a budget of FFTs allows; the first steps get what is left over.

    Raises:
        SettingsError: If it does not allow one for each.

    Examples:
        >>> inner_steps(4, budget=100, steps=3), inner_steps(4, budget=100, steps=2)
        ((2, 2, 1), (3, 3))
    """
    inner = (1,) * steps
    least = fixed_ffts(planes, inner=inner, oversampling=oversampling)
    if least > budget:
        rule = f"must be at least {least} for {planes} planes and {steps} steps"
        raise SettingsError("estimation.map.ffts_per_frame", rule, budget)
    total = steps
    while fixed_ffts(planes, inner=_shared_out(total + 1, steps), oversampling=oversampling) <= budget:
        total += 1
    return _shared_out(total, steps)


def _shared_out(total: int, steps: int) -> tuple[int, ...]:
    return tuple(total // steps + (number < total % steps) for number in range(steps))
