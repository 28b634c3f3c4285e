"""The closed loop: air that moves, a mirror, a sensor with its reconstructor, and what they leave.

Enters: a `Config`. Leaves: a record for every exposure, and the star's image. `loop` is the step, `light` what sensor
and astronomer get, `sensor` the choice of sensors; the other files belong to one sensor or one part of the step.
"""
