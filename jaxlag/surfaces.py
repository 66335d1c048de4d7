"""What steps do where a function of the system jumps or bends by the position, the time or a state."""

from ._mechanics.surfaces import Located as Located, NotLocated as NotLocated
