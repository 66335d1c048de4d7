"""Programs of JAX, read and rewritten.

One walker of jaxprs (`interpreter`) over any scalar algebra (`scalar_graph`), the structure of Jacobians, nonsmooth terms as they are
written, bounds over intervals, and choices of the compiler.
"""
