"""Design of a curvature sensor for a loop: planes, flux split, pixels, window, rate, and the rms to expect.

Enters: telescope, star, air and mirror of a `Config`. Leaves: a `Config` ready for the loop, and the errors that are
expected of it. Nothing is run in time: the residuals of a loop are drawn from their statistics (`loop_residual`),
Fisher information tells what each plane shows of them (`plane_information`), and the planes are searched for the least
error of the mirror's modes (`plane_search`).
"""
