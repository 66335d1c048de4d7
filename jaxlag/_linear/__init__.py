"""Systems near an equilibrium or a steady motion: where it is, how the system moves there, and whether it is stable."""
