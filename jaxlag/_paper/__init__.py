"""The equations of motion on paper: formulas, derivations, and programs that need nothing of this package. The home of SymPy."""
