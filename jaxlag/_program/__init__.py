"""Programs of JAX, read and rewritten.

One walk over jaxprs (`walker`), their interpretation over any scalar algebra (`interpreter`, `scalar_graph`), the structure of Jacobians,
sparse matrices and their elimination, absolute values and norms as they are written, bounds over intervals of time, and compiler options.
"""
