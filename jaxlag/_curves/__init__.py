"""Curves of solutions over a parameter: periodic motions and equilibria, followed through folds, with what happens on the way."""
