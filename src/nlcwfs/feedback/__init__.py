r"""A wavefront estimate becomes a command.

Enters: `measured_m[mode]`, what one exposure shows of each mode of the mirror: metres of optical path difference, air
less mirror. Leaves: `command_m[mode]`, the shape that the mirror shall take, in metres; the residual is air less
command. Equations, in means over exposure :math:`n`, with :math:`a` the air, :math:`u` commands and :math:`L = d + f`
the latency in exposures, whole and part:

- the mirror, :math:`c_n = (1 - f)\,u_{n-d} + f\,u_{n-d-1}`, and what is measured, :math:`r_n = a_n - c_n` and noise.
  Without latency the command from exposure :math:`n` is on the mirror from the start of exposure :math:`n + 1`;
- the integrator, :math:`u_{n+1} = l\,u_n + g\,r_n`, or with the mirror's delay taken out of the loop,
  :math:`u_{n+1} = l\,u_n + g\,(r_n + c_n - u_n)`, where :math:`r_n + c_n` is the pseudo-open-loop measurement;
- modal gains, :math:`\min_g \int |E_g|^2 S + |N_g|^2 \sigma^2` (Gendron & Lena 1994, A&A 291, 337);
- prediction, :math:`u_{n+1} = \sum_k w_k\,(r + c)_{n-k}`, with :math:`w` by least squares from telemetry.
"""
