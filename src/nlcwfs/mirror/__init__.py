"""The deformable mirror: a command becomes a shape.

Enters: a command, one number in metres for each mode or actuator. Leaves: the optical path difference
`opd_m[y x]` that the mirror adds. Equation: `opd = sum of command * shape`, the command clipped at the stroke;
the best command for a wavefront is the least-squares fit of the shapes, weighted by the light.
"""
