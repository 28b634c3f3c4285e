"""Star and air: what reaches the telescope.

Leaves: the optical path difference `opd_m[y x]` of the turbulent air. Equations: phase spectrum
`0.0229 r0^(-5/3) (f^2 + 1/L0^2)^(-11/6)` rad^2 m^2 (Noll 1976; von Karman's outer scale L0);
frozen flow `opd(x, t) = opd(x - v t, 0)` (Taylor 1938).
"""
