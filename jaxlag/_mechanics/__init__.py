"""Mechanics of one state at one time: Lagrange's equations, the constrained solve, projection, dry friction, power."""
